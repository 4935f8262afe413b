"""Static moments against the potential energy of the weights, and their derivatives against differences."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal.robot.model import GEOMETRIC_KINDS, RobotModel
from robcal.robot.statics import local_frame, moment_names, moment_sweep, moments, static_chain
from robcal.transforms import Array, frame_from_xyzrpy, rotation_from_rpy
from tests.robot.chains import random_chain

pytestmark = pytest.mark.unit
GRAVITY = np.array([1.1, -2.3, -9.4])
LOAD = (35.0, np.array([4.0, -1.5, 6.0]))
"""Mass and first moment of what hangs on the flange."""
STEP = 1e-6


def energy(model: RobotModel, coordinates: Array) -> float:
    """Potential energy (J) of all weights; coordinates (n, 6) as x, y, z, roll, pitch, yaw of each frame."""
    T, total = np.eye(4), 0.0
    for frame, six in zip(model.frames, coordinates, strict=True):
        T = T @ frame_from_xyzrpy(six)
        total -= frame.mass * GRAVITY @ (T[:3, :3] @ np.array(frame.cog) + T[:3, 3])
    return float(total - GRAVITY @ (LOAD[0] * T[:3, 3] + T[:3, :3] @ LOAD[1]))


def compiled(model: RobotModel, W: Array) -> ca.Function:
    """(moments, derivatives of ``W moments``) by coordinates, gravity, first moment and mass."""
    c, g, mass, moment = ca.SX.sym("c", 6 * len(model.frames)), ca.SX.sym("g", 3), ca.SX.sym("m"), ca.SX.sym("f", 3)
    chain = static_chain(model, [c[6 * i : 6 * i + 6] for i in range(len(model.frames))], g, mass, moment)
    sweep = moment_sweep(model, chain, ca.DM(W))
    by_load = ca.mtimes(sweep.by_first, chain.rotations[-1])
    return ca.Function(
        "f",
        [c, g, mass, moment],
        [moments(model, chain), sweep.by_coordinate, sweep.by_gravity, by_load, sweep.by_mass],
    )


def posed(seed: int) -> tuple[RobotModel, Array, np.random.Generator]:
    """A random chain and its coordinates."""
    rng = np.random.default_rng(seed)
    model = random_chain(rng, 4)
    return model, np.array([[*f.xyz, *f.rpy] for f in model.frames]) + rng.normal(0, 0.2, (4, 6)), rng


@given(seed=st.integers(0, 10_000))
@settings(max_examples=5, deadline=None)
def test_moments_are_the_negative_derivatives_of_the_potential_energy(seed: int) -> None:
    model, coordinates, _ = posed(seed)
    found = np.array(compiled(model, np.zeros((6, len(moment_names(model)))))(coordinates.ravel(), GRAVITY, *LOAD)[0])
    by_name = dict(zip(moment_names(model), found.ravel(), strict=True))
    for i, frame in enumerate(model.frames):
        turns = {f"{frame.name}_m{kind}": 3 + k for k, kind in enumerate(("roll", "pitch", "yaw"))}
        if frame.prismatic:
            turns[f"{frame.name}_force"] = GEOMETRIC_KINDS.index(str(frame.axis))
        for name, k in turns.items():
            step = np.zeros((4, 6))
            step[i, k] = STEP
            slope = (energy(model, coordinates + step) - energy(model, coordinates - step)) / (2 * STEP)
            assert by_name[name] == pytest.approx(-slope, rel=1e-6, abs=1e-4)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=5, deadline=None)
def test_sweep_agrees_with_differences(seed: int) -> None:
    model, coordinates, rng = posed(seed)
    W = rng.normal(size=(6, len(moment_names(model))))
    function = compiled(model, W)
    at = [coordinates.ravel(), GRAVITY, np.array([LOAD[0]]), LOAD[1]]
    _, by_coordinate, by_gravity, by_load, by_mass = (np.array(a) for a in function(*at))
    for argument, derivative in ((0, by_coordinate), (1, by_gravity), (2, by_mass), (3, by_load)):
        for k in range(derivative.shape[1]):
            ends = []
            for sign in (1, -1):
                moved = [a.copy() for a in at]
                moved[argument][k] += sign * STEP
                ends.append(W @ np.array(function(*moved)[0]).ravel())
            np.testing.assert_allclose(derivative[:, k], (ends[0] - ends[1]) / (2 * STEP), rtol=1e-5, atol=2e-3)


def test_a_frames_own_lines() -> None:
    six = np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])
    local = local_frame(ca.DM(six))
    np.testing.assert_allclose(np.array(ca.DM(local.R)), rotation_from_rpy(six[3:]), atol=1e-14)
    np.testing.assert_allclose(np.array(ca.DM(local.t)).ravel(), six[:3])
    # pitch turns about the y axis that yaw has turned already
    np.testing.assert_allclose(np.array(ca.DM(local.pitch_line)).ravel(), rotation_from_rpy([0, 0, six[5]])[:, 1])
