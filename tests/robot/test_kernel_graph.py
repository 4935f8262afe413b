"""The graph of one pose against a chain of plain frames, a fixed point of its statics, and refusals."""

import casadi as ca
import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.robot.kernel_graph import PoseGraph, chain_graph, expression_variables
from robcal.robot.model import GEOMETRIC_KINDS, RobotModel, Term, parameter_names
from robcal.transforms import Array, frame_from_xyzrpy
from tests.robot.chains import kr_like, random_chain, random_theta

pytestmark = pytest.mark.unit


def evaluated(graph: PoseGraph, theta: Array, q: Array, outputs: list[ca.SX], covariates: Array | None = None) -> list:
    """Outputs of a graph with the first payload hung on, base and tool references at identity."""
    function = ca.Function("graph", graph.inputs, outputs)
    reference = np.eye(4)[:3]
    load = np.eye(graph.inputs[2].numel())[0]
    given = np.zeros(0) if covariates is None else covariates
    return [np.array(a) for a in function.call([theta, q, load, given, reference, reference])]


def rigid(model: RobotModel, theta: Array, q: Array) -> Array:
    """Tool frame (4, 4) of the chain without any elasticity or term."""
    value = dict(zip(parameter_names(model), theta, strict=True))
    T, joint = np.eye(4), 0
    for name, frame in [("base", None), *((f.name, f) for f in model.frames), ("tool", None)]:
        six = np.array([value[f"{name}.{kind}"] for kind in GEOMETRIC_KINDS])
        if frame is not None:
            six += [*frame.xyz, *frame.rpy]
        if frame is not None and frame.axis is not None:
            six[GEOMETRIC_KINDS.index(str(frame.joint_kind))] += frame.sign * q[joint]
            joint += 1
        T = T @ frame_from_xyzrpy(six)
    return T


@pytest.mark.parametrize("seed", range(4))
def test_without_elasticity_the_graph_is_a_product_of_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = random_chain(rng)
    names = parameter_names(model)
    theta = np.where(["elastic" in n for n in names], 0.0, random_theta(rng, names, 10.0))
    q = rng.uniform(-1, 1, model.n_joints)
    graph = chain_graph(model)
    np.testing.assert_allclose(
        evaluated(graph, theta, q, [graph.world_T_tool])[0], rigid(model, theta, q)[:3], atol=1e-12
    )


def test_converged_statics_are_a_fixed_point() -> None:
    model = kr_like()
    names = parameter_names(model)
    theta = np.array([2e-6 if "elastic" in n else 0.0 for n in names])
    q = np.array([0.3, -0.6, 0.9, 0.4, -0.5, 0.2])
    graph = chain_graph(model, "converged")
    T, m = evaluated(graph, theta, q, [graph.world_T_tool, graph.moments])
    # deflections of these very moments put into the rigid chain as deviations give the same tool frame
    bent = dict(zip(names, theta, strict=True))
    for i, frame in enumerate(model.frames):
        for k, kind in enumerate(("roll", "pitch", "yaw")):
            bent[f"{frame.name}.{kind}"] = bent[f"{frame.name}.elastic_{kind}"] * m[3 + 3 * i + k, 0]
    np.testing.assert_allclose(T, rigid(model, np.array([bent[n] for n in names]), q)[:3], atol=1e-12)
    one_step = chain_graph(model)
    assert np.abs(evaluated(one_step, theta, q, [one_step.world_T_tool])[0] - T).max() > 1e-7


def test_terms_bring_their_covariates_and_act_on_their_frame() -> None:
    term = Term("drift", "axis2", "x", "rate*time_s + slope*temp_c", {"rate": 1e-6, "slope": 2e-6})
    model = kr_like(terms=(term,))
    graph = chain_graph(model, derivatives=False)
    assert graph.covariates == ("temp_c", "time_s")
    assert graph.jacobian.numel() == 0
    theta = np.array([{"drift.rate": 1e-6, "drift.slope": 2e-6}.get(n, 0.0) for n in parameter_names(model)])
    (T,) = evaluated(graph, theta, np.zeros(6), [graph.world_T_tool], np.array([10.0, 500.0]))
    (still,) = evaluated(graph, 0 * theta, np.zeros(6), [graph.world_T_tool], np.array([10.0, 500.0]))
    np.testing.assert_allclose(T[:, 3] - still[:, 3], [5.2e-4, 0.0, 0.0], atol=1e-12)


def test_names_that_expressions_may_use() -> None:
    names = expression_variables(kr_like())
    assert {"q1", "torque6", "axis2_mpitch", "base_mx", "payload_mass"} <= names
    assert "time_s" not in names


def test_unknown_statics_are_refused() -> None:
    with pytest.raises(InvalidInput, match="one_step or converged, not 'rigid'"):
        chain_graph(kr_like(), "rigid")
