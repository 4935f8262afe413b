"""Operators of closed loops: derivatives against differences, and what a loop tells of a robot."""

import numpy as np
import pytest

from robcal.calibration.closed_loops import KINDS, loop_observations, loop_world
from robcal.errors import InvalidInput
from robcal.transforms import frame_from_xyzrpy, retract, transform

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives(kind: str) -> None:
    rng = np.random.default_rng(1)
    T = frame_from_xyzrpy(rng.uniform(-1, 1, (4, 6)))
    seen = loop_observations(kind, np.arange(4), np.full(4, 0.6), np.full(4, 1e-4))
    _, B = seen.evaluate(T)
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        ahead, behind = (seen.evaluate(retract(T, s * step))[0] for s in (1, -1))
        np.testing.assert_allclose(B[..., k], -(ahead - behind) / 2e-6, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_the_world_of_a_loop_is_found_from_the_tips(kind: str) -> None:
    rng = np.random.default_rng(2)
    turn = frame_from_xyzrpy([0.5, -0.3, 0.8, 0.4, -0.2, 1.0])
    away = rng.standard_normal((12, 3))
    local = {
        "point": 0.0 * away,
        "plane": away * [1, 1, 0],
        "length": 0.6 * away / np.linalg.norm(away, axis=1, keepdims=True),
    }[kind]
    tips = transform(turn, local)
    T = np.tile(np.eye(4), (12, 1, 1))
    T[:, :3, 3] = transform(loop_world(kind, tips), tips)
    value = np.full(12, 0.6 if kind == "length" else 0.0)
    r, _ = loop_observations(kind, np.arange(12), value, np.full(12, 1e-4)).evaluate(T)
    np.testing.assert_allclose(r, 0.0, atol=1e-12)


def test_bad_loops_are_refused() -> None:
    with pytest.raises(InvalidInput, match="of the kind point, plane, length, not 'line'"):
        loop_observations("line", [0], [0.0], [1e-4])
    with pytest.raises(InvalidInput, match="sigma must be above zero"):
        loop_observations("plane", [0], [0.0], [0.0])
    with pytest.raises(InvalidInput, match="not positive"):
        loop_observations("length", [0], [-1.0], [1e-4])
