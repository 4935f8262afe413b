"""Numbers of targets exchanged, from distances alone."""

import numpy as np

from robcal.calibration.observations import PointObservations
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.noise.swaps import find_swaps, relabelled
from robcal.transforms import frame_from_xyzrpy, transform

BODY = np.array([[0, 0, 0], [0.4, 0.02, 0], [0.38, 0.3, 0.02], [-0.03, 0.33, 0.05], [0.2, 0.12, 0.11]])
IDS = np.array([7, 11, 19, 23, 37])


def recording(order: list[int], sigma: float = 5e-5) -> Recording:
    rng = np.random.default_rng(1)
    frames = frame_from_xyzrpy(rng.normal(size=(12, 6)))
    world = transform(frames[:, None], BODY[None]) + rng.normal(0, sigma, (12, 5, 3))
    pose = np.repeat(np.arange(12), 5)
    obs = PointObservations(
        pose,
        np.tile(BODY[order], (12, 1)),
        world.reshape(-1, 3),
        np.tile(sigma**2 * np.eye(3), (60, 1, 1)),
        np.tile(IDS[order], 12),
    )
    return Recording(np.zeros((12, 6)), (None,) * 12, {"index": np.arange(12.0)}, tuple("abcdefghijkl"), obs)


def test_right_numbers_are_left_alone() -> None:
    assert find_swaps(recording([0, 1, 2, 3, 4])) == ()


def test_exchange_is_found_and_undone() -> None:
    swapped = recording([0, 3, 2, 1, 4])
    pairs = find_swaps(swapped)
    assert [set(pair) for pair in pairs] == [{11, 23}]
    assert find_swaps(relabelled(swapped, pairs)) == ()


def test_single_targets_tell_nothing_of_numbers() -> None:
    full = recording([0, 3, 2, 1, 4])
    one_each = full.without_observations(np.setdiff1d(np.arange(60), 5 * np.arange(12) + np.arange(12) % 5))
    assert find_swaps(one_each) == ()
