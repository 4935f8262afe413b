"""Kernels that share a graph give what kernels of their own give."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.robot.kernel import Kernel
from robcal.robot.kernel_cache import MOST, kernel_of
from robcal.robot.model import Frame, Payload, RobotModel, Term


def arm(length: float = 0.5) -> RobotModel:
    frames = (
        Frame("axis1", "z", xyz=(0.0, 0.0, 0.4), mass=10.0),
        Frame("axis2", "y", xyz=(length, 0.0, 0.0), mass=5.0, cog=(0.2, 0.0, 0.0)),
        Frame("flange", None, xyz=(0.3, 0.0, 0.0)),
    )
    return RobotModel("arm", frames, payloads={"load": Payload(3.0, (0.0, 0.1, 0.0))})


def frames_of(kernel: Kernel) -> np.ndarray:
    q = np.random.default_rng(1).uniform(-1, 1, (4, 2))
    return kernel.frames(kernel.theta0, kernel.poses(q, payload="load"))


def test_values_and_references_are_those_of_the_model() -> None:
    first = arm().with_parameters({"axis2.elastic_pitch": 1e-5})
    second = replace(
        arm().with_parameters({"axis2.elastic_pitch": 4e-5, "axis1.x": 1e-3}), world_T_base=np.diag([-1, -1, 1.0, 1])
    )
    for model in (first, second, first):
        assert np.allclose(frames_of(kernel_of(model, "converged")), frames_of(Kernel(model, "converged")), atol=1e-15)


@pytest.mark.parametrize("other", ["length", "payload", "term", "statics"])
def test_models_of_another_form_get_another_graph(other: str) -> None:
    model = arm().with_parameters({"axis2.elastic_pitch": 1e-4})
    kernel_of(model)
    statics = "converged" if other == "statics" else "one_step"
    if other == "length":
        model = replace(model, frames=arm(0.6).frames)
    if other == "payload":
        model = replace(model, payloads={"load": Payload(30.0, (0.0, 0.1, 0.0))})
    if other == "term":
        model = model.with_terms((Term("wave", "axis2", "q", "a*cos(q2)", {"a": 1e-3}),))
    assert np.allclose(frames_of(kernel_of(model, statics)), frames_of(Kernel(model, statics)), atol=1e-15)


def test_old_kernels_are_forgotten_and_come_back() -> None:
    expected = frames_of(Kernel(arm(0.5)))
    for k in range(MOST + 3):
        kernel_of(arm(0.51 + 0.01 * k))
    assert np.allclose(frames_of(kernel_of(arm(0.5))), expected, atol=1e-15)


def test_a_kernel_refuses_a_model_with_other_parameters() -> None:
    with pytest.raises(InvalidInput, match="other parameters"):
        Kernel(arm()).with_model(replace(arm(), payloads={}))
