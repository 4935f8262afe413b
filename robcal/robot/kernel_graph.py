"""The CasADi graph of a robot for one pose: tool frame, moments, and exact right-twist Jacobians.

Each frame (base, chain, tool) has six coordinates ``c = nominal + deviation + sign q + elasticity * moment + terms``.
A change of a coordinate moves the tool by a geometric twist column G; what a parameter does to the coordinates is
D directly and S dm by way of the moments. So ``J = G D + (G S) dm/dtheta``: only D and S (small and sparse) come from
automatic differentiation, G and the moments' derivatives from mechanics. That keeps the graph ten times smaller than
differentiating the chain.

Where joints turn further frames (:mod:`robcal.robot.loops`), the coordinates c follow from free ones by the joints'
true angles, deviations and elasticities included. A joint then carries, by virtual work, the moments of all frames that
it turns, each times the slope of the coupling; four-bars take it at the undeflected angle.

Statics 'one_step': moments of the undeflected chain. 'converged': the fixed
point, unrolled; each round gains the factor elasticity * load, about 1e-2 for soft robots.
"""

from dataclasses import dataclass

import casadi as ca

from robcal.errors import InvalidInput
from robcal.robot.loops import FOUR_BAR_LENGTHS, rocker_angle
from robcal.robot.model import ELASTIC_KINDS, GEOMETRIC_KINDS, Frame, RobotModel, parameter_names
from robcal.robot.statics import StaticChain, local_frame, moment_names, moment_sweep, moments, static_chain
from robcal.robot.terms import graph, identifier, names_in

CONVERGED_ROUNDS = 8
_SIX = {kind: k for k, kind in enumerate(GEOMETRIC_KINDS)}


@dataclass(frozen=True)
class PoseGraph:
    """Graphs of one pose.

    Attributes
    ----------
    inputs : theta, q (sense of q), load (one-hot over payloads), covariates, world_T_base (12,), flange_T_tool (12,).
    covariates : names of the covariates that the terms need, in order.
    world_T_tool : (3, 4).
    jacobian : (6, p) by all parameters; joint_jacobian (6, N).
    basis : (6, coordinates) tool twist per coordinate of base, frames and tool, and per crank angle of each four-bar.
    moments : entries as :func:`robcal.robot.statics.moment_names`.
    torques : (N,) what the weights exert on each joint, in the sense of q.
    """

    inputs: list[ca.SX]
    covariates: tuple[str, ...]
    world_T_tool: ca.SX
    jacobian: ca.SX
    joint_jacobian: ca.SX
    basis: ca.SX
    moments: ca.SX
    torques: ca.SX


def chain_graph(model: RobotModel, statics: str = "one_step", derivatives: bool = True) -> PoseGraph:
    """Build the graph of a chain.

    Raises
    ------
    InvalidInput : unknown statics, or a term whose expression names something unknown.
    """
    if statics not in ("one_step", "converged"):
        raise InvalidInput(f"statics must be one_step or converged, not '{statics}'")
    x = Inputs.of(model)
    pull = _Pull.of(model, x)
    m = ca.SX.sym("m", len(moment_names(model)))
    torques, on_cranks = _torques(model, x, m)
    free = _coordinates(model, x, m, (torques, on_cranks), pull.mass)
    coordinates = _coupled(model, x, free)
    at_rest = ca.substitute(coordinates, m, ca.SX.zeros(m.shape))
    chain = pull.chain(at_rest)
    moment = moments(model, chain)
    coupled = bool(ca.depends_on(coordinates, m))
    if statics == "converged" and coupled:
        for _ in range(CONVERGED_ROUNDS):
            chain = pull.chain(ca.substitute(coordinates, m, moment))
            moment = moments(model, chain)
    deflected = ca.substitute(coordinates, m, moment) if coupled else coordinates
    tool = tool_chain(deflected, len(model.frames), x.world_T_base, x.flange_T_tool)
    world_T_tool = ca.horzcat(tool.tool_R_world.T, -ca.mtimes(tool.tool_R_world.T, tool.world_origin))
    if not derivatives:
        empty = ca.SX()
        return PoseGraph(x.all, x.covariate_names, world_T_tool, empty, empty, empty, moment, empty)
    G = tool.columns
    unknowns = ca.vertcat(x.theta, x.q)
    D = ca.jacobian(coordinates, unknowns)
    if not coupled:
        J, basis = ca.mtimes(G, D), G
    else:
        S = ca.substitute(ca.jacobian(coordinates, m), m, moment)
        D, D_rest = ca.substitute(D, m, moment), ca.substitute(D, m, ca.SX.zeros(m.shape))
        base_six = (at_rest if statics == "one_step" else deflected)[:6]  # those for which the moments were taken
        if statics == "one_step":
            K, L = pull.feedback(chain, base_six, ca.mtimes(G, S), unknowns.numel())
            J, basis = ca.mtimes(G, D) + ca.mtimes(K, D_rest) + L, G + K
        else:
            basis = G
            for _ in range(CONVERGED_ROUNDS):
                K, L = pull.feedback(chain, base_six, ca.mtimes(basis, S), unknowns.numel())
                basis = G + K
            J = ca.mtimes(basis, D) + L
    if model.has_loops:  # a joint's coordinate takes along the frames that it turns
        basis = ca.mtimes(basis, ca.substitute(_propagation(model, x, free), m, moment))
    p = x.theta.numel()
    torques = ca.substitute(torques, m, moment)
    return PoseGraph(x.all, x.covariate_names, world_T_tool, J[:, :p], J[:, p:], basis, moment, torques)


@dataclass(frozen=True)
class Inputs:
    """Symbols of all inputs; ``index`` of the parameters in ``theta``."""

    theta: ca.SX
    q: ca.SX
    load: ca.SX
    covariates: ca.SX
    world_T_base: ca.SX
    flange_T_tool: ca.SX
    index: dict[str, int]
    covariate_names: tuple[str, ...]

    @classmethod
    def of(cls, model: RobotModel) -> "Inputs":
        names, covariates = parameter_names(model), _covariates(model)
        return cls(
            ca.SX.sym("theta", len(names)),
            ca.SX.sym("q", model.n_joints),
            ca.SX.sym("load", len(model.payloads)),
            ca.SX.sym("covariates", len(covariates)),
            ca.SX.sym("world_T_base", 3, 4),
            ca.SX.sym("flange_T_tool", 3, 4),
            {name: k for k, name in enumerate(names)},
            covariates,
        )

    @property
    def all(self) -> list[ca.SX]:
        """In the order of :class:`PoseGraph`."""
        return [self.theta, self.q, self.load, self.covariates, self.world_T_base, self.flange_T_tool]


@dataclass(frozen=True)
class _Pull:
    """Gravity (in its own frame) and the load's mass and first moment, with derivatives by their own parameters."""

    model: RobotModel
    world_T_base: ca.SX
    gravity: ca.SX
    tilt_columns: dict[int, ca.SX]
    mass: ca.SX
    moment: ca.SX
    load_columns: dict[int, tuple[ca.SX, ca.SX]]

    @classmethod
    def of(cls, model: RobotModel, x: Inputs) -> "_Pull":
        return cls(model, x.world_T_base, *_gravity(model, x.theta, x.index), *_load(model, x.theta, x.index, x.load))

    def _base_R(self, base_six: ca.SX) -> ca.SX:
        """Rotation of the base in the frame of gravity."""
        if self.model.gravity_frame != "world":
            return ca.SX.eye(3)
        return ca.mtimes(self.world_T_base[:, :3], local_frame(base_six).R)

    def chain(self, c: ca.SX) -> StaticChain:
        """The loaded chain at coordinates of base, every frame, and tool."""
        g = ca.mtimes(self._base_R(c[:6]).T, self.gravity) if self.model.gravity_frame == "world" else self.gravity
        frames = [c[6 * (i + 1) : 6 * (i + 2)] for i in range(len(self.model.frames))]
        return static_chain(self.model, frames, g, self.mass, self.moment)

    def feedback(self, chain: StaticChain, base_six: ca.SX, W: ca.SX, unknowns: int) -> tuple[ca.SX, ca.SX]:
        """K: derivative of ``W moments`` by all coordinates; L: by the unknowns at fixed coordinates."""
        sweep = moment_sweep(self.model, chain, W)
        K_base = ca.SX(6, 6)
        if self.model.gravity_frame == "world":
            turned = [ca.mtimes(sweep.by_gravity, ca.cross(chain.g, line)) for line in _base_lines(base_six)]
            K_base = ca.horzcat(ca.SX(6, 3), *turned)
        base_R = self._base_R(base_six)
        L = ca.SX(6, unknowns)
        for k, dg in self.tilt_columns.items():
            L[:, k] = ca.mtimes(sweep.by_gravity, ca.mtimes(base_R.T, dg))
        for k, (d_mass, d_moment) in self.load_columns.items():
            L[:, k] = sweep.by_mass * d_mass + ca.mtimes(sweep.by_first, ca.mtimes(chain.rotations[-1], d_moment))
        return ca.horzcat(K_base, sweep.by_coordinate, ca.SX(6, 6)), L


def expression_variables(model: RobotModel) -> frozenset[str]:
    """Names that the kernel supplies to expressions; all others are covariates."""
    joints = range(1, model.n_joints + 1)
    return frozenset(
        [f"q{k}" for k in joints] + [f"torque{k}" for k in joints] + moment_names(model) + ["payload_mass"]
    )


def _covariates(model: RobotModel) -> tuple[str, ...]:
    known = expression_variables(model)
    found: dict[str, None] = {}
    for term in model.terms:
        for name in sorted(names_in(term.expression) - set(term.parameters) - known):
            found[name] = None
    return tuple(found)


def _load(model: RobotModel, theta: ca.SX, index: dict[str, int], load: ca.SX) -> tuple:
    """Mass and first moment of what hangs on the flange, and their derivatives by each payload parameter."""
    mass, moment = ca.SX(0), ca.SX.zeros(3)
    columns: dict[int, tuple[ca.SX, ca.SX]] = {}
    for k, (name, payload) in enumerate(model.payloads.items()):
        at = index[f"payload.{name}.mass"]
        own_mass = payload.mass + theta[at]
        cog = ca.DM(payload.cog) + theta[at + 1 : at + 4]
        mass = mass + load[k] * own_mass
        moment = moment + load[k] * own_mass * cog
        columns[at] = (load[k], load[k] * cog)
        for axis in range(3):
            columns[at + 1 + axis] = (ca.SX(0), load[k] * own_mass * ca.SX.eye(3)[:, axis])
    return mass, moment, columns


def _gravity(model: RobotModel, theta: ca.SX, index: dict[str, int]) -> tuple[ca.SX, dict[int, ca.SX]]:
    """Gravity ``Rx(tilt_x) Ry(tilt_y) g0`` in its own frame and its derivatives by the two tilts."""
    tilt = [index["gravity.tilt_x"], index["gravity.tilt_y"]]
    cx, sx, cy, sy = ca.cos(theta[tilt[0]]), ca.sin(theta[tilt[0]]), ca.cos(theta[tilt[1]]), ca.sin(theta[tilt[1]])
    Rx = ca.vertcat(ca.horzcat(1, 0, 0), ca.horzcat(0, cx, -sx), ca.horzcat(0, sx, cx))
    Ry = ca.vertcat(ca.horzcat(cy, 0, sy), ca.horzcat(0, 1, 0), ca.horzcat(-sy, 0, cy))
    g = ca.mtimes(Rx, ca.mtimes(Ry, ca.DM(model.gravity)))
    by_x = ca.cross(ca.DM([1, 0, 0]), g)
    by_y = ca.mtimes(Rx, ca.cross(ca.DM([0, 1, 0]), ca.mtimes(Ry, ca.DM(model.gravity))))
    return g, {tilt[0]: by_x, tilt[1]: by_y}


def _coordinates(
    model: RobotModel, x: Inputs, m: ca.SX, loads: tuple[ca.SX, dict[str, ca.SX]], load_mass: ca.SX
) -> ca.SX:
    """Free coordinates: six of base, every frame, and tool, then the crank angle of each four-bar.

    ``loads``: torques of the joints and on the cranks, as graphs of the moments m. What joints turn besides their own
    frame is not in yet.
    """
    theta, q, index = x.theta, x.q, x.index
    torques, on_cranks = loads
    at = {"base": 0, "tool": 6 * (len(model.frames) + 1)} | {f.name: 6 * (i + 1) for i, f in enumerate(model.frames)}
    values: list[ca.SX] = [theta[index[f"base.{k}"]] for k in GEOMETRIC_KINDS]
    cranks: dict[str, ca.SX] = {}
    joint = 0
    for i, f in enumerate(model.frames):
        direct = f.is_joint and f.fourbar is None
        for k, (kind, nominal) in enumerate(zip(GEOMETRIC_KINDS, (*f.xyz, *f.rpy), strict=True)):
            value = nominal + theta[index[f"{f.name}.{kind}"]]
            moment = m[3 + 3 * i + k - 3] if k >= 3 else ca.SX(0)
            if direct and kind == f.joint_kind:
                value = value + f.sign * q[joint]
                moment = f.sign * torques[joint]
            if k >= 3:
                value = value + theta[index[f"{f.name}.{ELASTIC_KINDS[k - 3]}"]] * moment
            values.append(value)
        if f.fourbar is not None:
            own = q[joint] if f.is_joint else ca.SX(0)
            gives = theta[index[f"{f.name}.elastic_crank"]] * on_cranks[f.name]
            cranks[f.name] = f.fourbar.crank_zero + theta[index[f"{f.name}.crank_angle"]] + gives + own
        joint += f.is_joint
    values += [theta[index[f"tool.{k}"]] for k in GEOMETRIC_KINDS]

    if model.terms:
        covariates = {name: x.covariates[k] for k, name in enumerate(x.covariate_names)}
        symbols = _symbols(model, q, m, torques, load_mass) | covariates
        for term in model.terms:
            own_values = {short: theta[index[f"{term.name}.{short}"]] for short in term.parameters}
            value = graph(term.expression, {**symbols, **own_values})
            kind = term.kind
            if kind == "q":
                f = model.frame(term.frame)
                if f.fourbar is not None:
                    cranks[f.name] += value
                    continue
                kind, value = str(f.joint_kind), f.sign * value
            values[at[term.frame] + _SIX[kind]] += value
    return ca.vertcat(*values, *cranks.values())


def _coupled(model: RobotModel, x: Inputs, free: ca.SX) -> ca.SX:
    """Six coordinates of base, every frame, and tool: the free ones, and what the joints turn along."""
    size = 6 * (len(model.frames) + 2)
    if not model.has_loops:
        return free
    out = free[:size]
    cranks = _crank_rows(model)
    turned: list[ca.SX] = []  # true angle of each joint in the sense of q
    for i, f in enumerate(model.frames):
        if f.is_joint:
            k = GEOMETRIC_KINDS.index(str(f.joint_kind))
            plain = f.sign * (free[6 * (i + 1) + k] - (*f.xyz, *f.rpy)[k])
            turned.append(plain if f.fourbar is None else free[cranks[f.name]] - f.fourbar.crank_zero)
    for i, f in enumerate(model.frames):
        if not f.in_loop:
            continue
        row = 6 * (i + 1) + GEOMETRIC_KINDS.index(str(f.joint_kind))
        for k, coefficient in f.follows:
            out[row] += coefficient * turned[k]
        if f.fourbar is not None:
            phi = free[cranks[f.name]] + (ca.SX(0) if f.is_joint else turned[f.fourbar.driver])
            out[row] += f.sign * rocker_angle(f.fourbar, phi, _lengths(x, f))
    return out


def _propagation(model: RobotModel, x: Inputs, free: ca.SX) -> ca.SX:
    """Derivative of all coordinates by the free ones."""
    symbols = ca.SX.sym("free", free.shape)
    return ca.substitute(ca.jacobian(_coupled(model, x, symbols), symbols), symbols, free)


def _crank_rows(model: RobotModel) -> dict[str, int]:
    """Row of each four-bar's crank angle among the free coordinates, by the name of its frame."""
    driven = [f.name for f in model.frames if f.fourbar is not None]
    return {name: 6 * (len(model.frames) + 2) + k for k, name in enumerate(driven)}


def _lengths(x: Inputs, f: Frame) -> ca.SX:
    """Crank, coupler, rocker and ground with their deviations."""
    own = [x.theta[x.index[f"{f.name}.{kind}"]] for kind in FOUR_BAR_LENGTHS]
    nominal = f.fourbar.lengths if f.fourbar is not None else ()
    return ca.vertcat(*(length + deviation for length, deviation in zip(nominal, own, strict=True)))


def _torques(model: RobotModel, x: Inputs, m: ca.SX) -> tuple[ca.SX, dict[str, ca.SX]]:
    """What the weights exert on each joint (N,), in the sense of q: the moments of all frames that it turns; and what
    they exert on the crank of each four-bar."""
    names = moment_names(model)
    torques: list[ca.SX] = []
    offsets: list[ca.SX] = []
    on_cranks: dict[str, ca.SX] = {}
    for f in model.joints:
        own = f"{identifier(f.name)}_force" if f.prismatic else f"{identifier(f.name)}_m{f.joint_kind}"
        torques.append(ca.SX(0) if f.fourbar is not None else f.sign * m[names.index(own)])
        offsets.append(ca.SX(0) if f.fourbar is not None else f.sign * x.theta[x.index[f.zero_name]])
    for f in model.frames:
        if not f.in_loop:
            continue
        moment = m[names.index(f"{identifier(f.name)}_m{f.joint_kind}")]
        for k, coefficient in f.follows:
            torques[k] += coefficient * moment
        if f.fourbar is not None:
            k = f.fourbar.driver
            phi = ca.SX.sym("phi")
            slope = ca.jacobian(rocker_angle(f.fourbar, phi, _lengths(x, f)), phi)
            at = f.fourbar.crank_zero + x.theta[x.index[f"{f.name}.crank_angle"]] + x.q[k] + offsets[k]
            on_cranks[f.name] = f.sign * ca.substitute(slope, phi, at) * moment
            torques[k] += on_cranks[f.name]
    return ca.vertcat(*torques), on_cranks


def _symbols(model: RobotModel, q: ca.SX, m: ca.SX, torques: ca.SX, load_mass: ca.SX) -> dict[str, ca.SX]:
    symbols = {name: m[k] for k, name in enumerate(moment_names(model))}
    for k in range(model.n_joints):
        symbols[f"q{k + 1}"] = q[k]
        symbols[f"torque{k + 1}"] = torques[k]
    symbols["payload_mass"] = load_mass
    return symbols


@dataclass(frozen=True)
class ToolChain:
    tool_R_world: ca.SX
    world_origin: ca.SX
    columns: ca.SX


def tool_chain(c: ca.SX, n: int, W0: ca.SX, F0: ca.SX) -> ToolChain:
    """From the tool inwards, all in tool coordinates: ``rho = o x z`` for a turn about z through o, ``omega = z``."""
    R, o = ca.SX.eye(3), ca.SX.zeros(3)  # rotation and origin of the frame reached, seen from the tool
    blocks: list[ca.SX] = []
    for i in reversed(range(n + 2)):
        local = local_frame(c[6 * i : 6 * i + 6])
        R_parent = ca.mtimes(R, local.R.T)
        lines = ca.horzcat(R[:, 0], ca.mtimes(R_parent, local.pitch_line), R_parent[:, 2])
        turning = ca.horzcat(*(ca.cross(o, lines[:, k]) for k in range(3)))
        blocks.append(ca.horzcat(ca.vertcat(R_parent, ca.SX(3, 3)), ca.vertcat(turning, lines)))
        o = o - ca.mtimes(R_parent, local.t)
        R = R_parent
        reference = F0 if i == n + 1 else W0 if i == 0 else None
        if reference is not None:
            R = ca.mtimes(R, reference[:, :3].T)
            o = o - ca.mtimes(R, reference[:, 3])
    return ToolChain(R, o, ca.horzcat(*reversed(blocks)))


def _base_lines(six: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Directions, in base coordinates, about which roll, pitch, yaw of the base turn."""
    local = local_frame(six)
    return ca.SX.eye(3)[:, 0], ca.mtimes(local.R.T, local.pitch_line), local.R[2, :].T
