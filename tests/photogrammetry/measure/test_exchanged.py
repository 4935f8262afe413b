"""Numbers of targets exchanged in some poses, whatever their share, and nothing said where there is none."""

import numpy as np
import pytest

from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.exchanged import exchanged_back, find_exchanges
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.transforms import frame_from_xyzrpy, transform

PLATE = np.array([[0, 0, 0], [0.4, 0.02, 0], [0.38, 0.3, 0.02], [-0.03, 0.33, 0.05], [0.2, 0.12, 0.11], [0.1, 0.3, 0]])
IDS = np.array([7, 11, 19, 23, 37, 40])
POSES = 30


def recorded(poses: set[int], pair: tuple[int, int] = (11, 23), gross: int | None = None) -> MeasuredPoints:
    rng = np.random.default_rng(4)
    frames = frame_from_xyzrpy(rng.normal(size=(POSES, 6)))
    world = transform(frames[:, None], PLATE[None]) + rng.normal(0, 5e-5, (POSES, len(IDS), 3))
    if gross is not None:
        world[gross, 4] += [0.02, -0.03, 0.01]
    target = np.tile(IDS, POSES)
    pose = np.repeat(np.arange(POSES), len(IDS))
    inside = np.isin(pose, sorted(poses))
    first, second = inside & (target == pair[0]), inside & (target == pair[1])
    target[first], target[second] = pair[1], pair[0]
    return MeasuredPoints.from_table(pose, target, world.reshape(-1, 3))


BODY = Body("plate", IDS, PLATE)


@pytest.mark.parametrize("count", [1, 2, 14])
def test_exchange_is_told_and_undone_in_any_share_of_the_poses(count: int) -> None:
    poses = set(range(3, 3 + count))
    points = recorded(poses)
    (found,) = find_exchanges(points, BODY)
    assert (found.targets, set(found.poses)) == ((11, 23), poses)
    assert found.after < 0.1 * found.before
    assert np.array_equal(exchanged_back(points, (found,)).target, recorded(set()).target)


def test_right_numbers_and_gross_errors_are_left_alone() -> None:
    assert find_exchanges(recorded(set()), BODY) == ()
    assert find_exchanges(recorded(set(), gross=5), BODY) == ()


def test_a_gross_error_beside_hides_no_exchange() -> None:
    (found,) = find_exchanges(recorded({5, 9}, gross=5), BODY)
    assert set(found.poses) == {5, 9}


def test_numbers_wrong_in_most_poses_are_left_to_the_body() -> None:
    assert find_exchanges(recorded(set(range(20))), BODY) == ()
