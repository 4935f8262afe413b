"""The numeric inverse on its own: starts, refinement, limits, branches; and the closed form against it."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.robot.chain import Chain, chain_of, forward
from robcal.robot.inverse_analytic import solve_spherical_wrist
from robcal.robot.inverse_numeric import NumericSettings, nearest_pose, refine, search, start_configurations
from robcal.robot.structure import SphericalWrist, find_structure
from robcal.transforms import difference, retract
from tests.robot.chains import kr_like

pytestmark = pytest.mark.unit
SETTINGS = NumericSettings()


@pytest.fixture(scope="module")
def chain() -> Chain:
    free = chain_of(kr_like())
    return replace(free, lower=np.full(6, -1.5), upper=np.full(6, 1.5))


def test_starts_are_spread_within_the_limits_and_the_same_every_time(chain: Chain) -> None:
    starts = start_configurations(chain, 64)
    assert np.array_equal(starts, start_configurations(chain, 64))
    assert (starts > chain.lower).all()
    assert (starts < chain.upper).all()
    assert (np.ptp(starts, axis=0) > 0.9 * 3.0).all()
    endless = replace(chain, lower=np.full(6, -np.inf), upper=np.full(6, np.inf))
    assert np.abs(start_configurations(endless, 64)).max() <= np.pi


def test_refinement_from_nearby_comes_back_exactly(chain: Chain) -> None:
    rng = np.random.default_rng(0)
    q = rng.uniform(0.2, 1.0, (20, 6))
    found, left = refine(chain, forward(chain, q), q + rng.normal(0, 0.02, q.shape), SETTINGS)
    np.testing.assert_allclose(found, q, atol=1e-8)
    assert SETTINGS.reached(chain, left).all()


def test_nearest_pose_within_the_limits_cannot_be_bettered(chain: Chain) -> None:
    out_of_reach = forward(chain, np.full((1, 6), 0.4))[0]
    out_of_reach = retract(out_of_reach, np.array([0.0, 0.0, 2.5, 0.0, 0.0, 0.0]))
    q, left = nearest_pose(chain, out_of_reach, np.zeros(6), SETTINGS)
    weight = SETTINGS.weight(chain)
    np.testing.assert_allclose(left, difference(forward(chain, q[None])[0], out_of_reach), atol=1e-12)
    best = np.linalg.norm(weight * left)
    assert best > 0.1
    rng = np.random.default_rng(1)
    tried = np.clip(q + rng.normal(0, 1e-3, (200, 6)), chain.lower, chain.upper)
    others = np.linalg.norm(weight * difference(forward(chain, tried), out_of_reach), axis=1)
    assert others.min() > best - 1e-7


def test_search_finds_what_the_closed_form_finds(chain: Chain) -> None:
    free = replace(chain, lower=np.full(6, -np.pi), upper=np.full(6, np.pi))
    structure = find_structure(free)
    assert isinstance(structure, SphericalWrist)
    q = np.array([[0.3, -0.4, 0.7, 0.5, 0.9, -0.6]])
    T = forward(free, q)
    closed = solve_spherical_wrist(free, structure, T, q)[0]
    closed = closed[np.isfinite(closed).all(axis=1)]
    np.testing.assert_allclose(forward(free, closed), np.broadcast_to(T, (len(closed), 4, 4)), atol=1e-10)
    numeric = search(free, T, q, SETTINGS, all_branches=True)[0]
    numeric = numeric[np.isfinite(numeric).all(axis=1)]

    def turns(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.abs(np.angle(np.exp(1j * (a[:, None] - b[None])))).max(axis=-1)

    gaps = turns(closed, numeric)
    assert (gaps.min(axis=0) < 1e-6).all()  # nothing but branches of the closed form
    assert (gaps.min(axis=1) < 1e-6).mean() >= 0.75  # a search finds most of them
    assert (turns(numeric, numeric) + np.eye(len(numeric)) > 1e-5).all()  # each of them once


def test_one_row_solved_near_its_start_needs_no_search(chain: Chain) -> None:
    q = np.full((1, 6), 0.5)
    assert search(chain, forward(chain, q), q + 0.01, SETTINGS, all_branches=False).shape == (1, 1, 6)
