"""The CasADi graph of a Stewart platform for one pose: tool frame and exact right-twist Jacobians.

The forward kinematics is a fixed number of Newton steps from the platform's home, written out; its derivatives come
from the implicit function at the solution, ``A xi + df/dz dz = 0`` with length residuals f, the platform's twist xi and
A as in :mod:`robcal.robot.legs`. Inputs and outputs are those of a chain's graph, so that everything that works on
poses of actuators with derivatives works on both. Weights have no effect: legs are stiff.
"""

import casadi as ca

from robcal.robot.hexapod import legs_of
from robcal.robot.kernel_graph import Inputs, PoseGraph, tool_chain
from robcal.robot.legs import LARGEST_STEP, LEG_KINDS, Legs
from robcal.robot.model import GEOMETRIC_KINDS, RobotModel
from robcal.robot.terms import graph

STEPS = 12
"""Newton steps; they converge within six anywhere in a usual workspace."""


def hexapod_graph(model: RobotModel, derivatives: bool = True) -> PoseGraph:
    """Build the graph of a Stewart platform.

    Raises
    ------
    InvalidInput : a term whose expression names something unknown.
    """
    x = Inputs.of(model)
    legs = legs_of(model)
    base, platform, length = _geometry(model, x, legs)
    R, t = ca.SX(ca.DM(legs.home[:3, :3])), ca.SX(ca.DM(legs.home[:3, 3]))
    for _ in range(STEPS):
        f, A = _residuals(R, t, (base, platform, length))
        xi = -ca.solve(A, f)
        longest = ca.fmax(ca.norm_2(xi[:3]) / legs.size, ca.norm_2(xi[3:]))
        xi = xi * ca.fmin(1.0, LARGEST_STEP / ca.fmax(longest, 1e-30))
        t = t + ca.mtimes(R, xi[:3])
        R = ca.mtimes(R, _cayley(xi[3:]))
    ends = ca.vertcat(*(x.theta[x.index[f"{end}.{k}"]] for end in ("base", "tool") for k in GEOMETRIC_KINDS))
    F0 = ca.horzcat(ca.mtimes(R, x.flange_T_tool[:, :3]), ca.mtimes(R, x.flange_T_tool[:, 3]) + t)
    tool = tool_chain(ends, 0, x.world_T_base, F0)
    world_T_tool = ca.horzcat(tool.tool_R_world.T, -ca.mtimes(tool.tool_R_world.T, tool.world_origin))
    no_moments, no_torques = ca.SX.zeros(0, 1), ca.SX.zeros(6, 1)
    if not derivatives:
        empty = ca.SX()
        return PoseGraph(x.all, x.covariate_names, world_T_tool, empty, empty, empty, no_moments, empty)
    unknowns = ca.vertcat(x.theta, x.q)
    of_ends = ca.mtimes(tool.columns, ca.jacobian(ends, unknowns))
    # residuals at the solution, which stands still: only the legs depend on the unknowns
    Rs, ts = ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3)
    f, _ = _residuals(Rs, ts, (base, platform, length))
    by_unknowns = ca.substitute([ca.jacobian(f, unknowns)], [Rs, ts], [R, t])[0]
    platform_twist = -ca.solve(_residuals(R, t, (base, platform, length))[1], ca.densify(by_unknowns))
    J = of_ends + ca.mtimes(_tool_by_platform(x, ends[6:]), platform_twist)
    p = x.theta.numel()
    return PoseGraph(x.all, x.covariate_names, world_T_tool, J[:, :p], J[:, p:], J[:, p:], no_moments, no_torques)


def _geometry(model: RobotModel, x: Inputs, legs: Legs) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Joints of base and platform (3, 6) and true lengths (6,), deviations and terms included."""
    off = [[x.theta[x.index[f"{f.name}.{k}"]] for f in model.frames] for k in LEG_KINDS]
    base = ca.DM(legs.base.T) + ca.vertcat(*(ca.horzcat(*row) for row in off[:3]))
    platform = ca.DM(legs.platform.T) + ca.vertcat(*(ca.horzcat(*row) for row in off[3:]))
    added = ca.vertcat(*(x.theta[x.index[f"{f.name}.offset"]] for f in model.frames))
    length = x.q + ca.DM(legs.offset) + added
    known = {f"q{k + 1}": x.q[k] for k in range(6)} | {f"torque{k + 1}": ca.SX(0) for k in range(6)}
    known |= {name: x.covariates[k] for k, name in enumerate(x.covariate_names)} | {"payload_mass": ca.SX(0)}
    for term in model.terms:
        own = {short: x.theta[x.index[f"{term.name}.{short}"]] for short in term.parameters}
        length[[f.name for f in model.frames].index(term.frame)] += graph(term.expression, {**known, **own})
    return base, platform, length


def _residuals(R: ca.SX, t: ca.SX, geometry: tuple[ca.SX, ca.SX, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Length residuals (6,) and their derivative (6, 6) by the platform's right twist."""
    base, platform, length = geometry
    f, rows = [], []
    for i in range(6):
        d = t + ca.mtimes(R, platform[:, i]) - base[:, i]
        size = ca.norm_2(d)
        w = ca.mtimes(R.T, d) / size
        f.append(size - length[i])
        rows.append(ca.horzcat(w.T, ca.cross(platform[:, i], w).T))
    return ca.vertcat(*f), ca.vertcat(*rows)


def _cayley(omega: ca.SX) -> ca.SX:
    """A rotation that is Exp(omega) up to third order, without a singular point."""
    K = ca.skew(omega / 2.0)
    return ca.SX.eye(3) + 2.0 / (1.0 + ca.dot(omega, omega) / 4.0) * (K + ca.mtimes(K, K))


def _tool_by_platform(x: Inputs, tool_six: ca.SX) -> ca.SX:
    """Right twist (6, 6) of the tool by that of the platform: the adjoint of tool_T_platform."""
    eye = ca.SX.eye(3)
    chain = tool_chain(ca.vertcat(ca.SX.zeros(6), tool_six), 0, ca.horzcat(eye, ca.SX.zeros(3)), x.flange_T_tool)
    R, o = chain.tool_R_world, chain.world_origin  # of the platform, seen from the tool
    return ca.vertcat(ca.horzcat(R, ca.mtimes(ca.skew(o), R)), ca.horzcat(ca.SX(3, 3), R))
