"""Scale from bars, contradictions, check lengths."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.photogrammetry.bundle.lengths import bars_scale, distances, length_results, rows_of
from robcal.photogrammetry.core.network import Lengths

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(6, 3))
IDS = np.arange(6)
ROOT = RNG.normal(size=(18, 18)) * 1e-5
Q = ROOT @ ROOT.T


def bars(factor: float = 1.0) -> Lengths:
    pairs = [[0, 1], [2, 3], [4, 5], [0, 5]]
    true = [factor * float(np.linalg.norm(POINTS[i] - POINTS[j])) for i, j in pairs]
    return Lengths(pairs, true, [1e-5] * 4)


def test_distances_and_their_derivatives() -> None:
    rows = rows_of(bars(), IDS)
    d, J = distances(POINTS, rows)
    h = 1e-7
    for k in range(18):
        step = np.zeros(18)
        step[k] = h
        ahead, _ = distances(POINTS + step.reshape(6, 3), rows)
        np.testing.assert_allclose(J[:, k], (ahead - d) / h, atol=1e-5)


def test_scale_of_consistent_bars() -> None:
    factor, note = bars_scale(bars(2.5), IDS, POINTS, Q, scale_free=True, limit=6.0)
    assert factor == pytest.approx(2.5)
    assert note == ""
    assert bars_scale(bars(), IDS, POINTS, Q, scale_free=False, limit=6.0)[0] == 1.0


@pytest.mark.parametrize("culprit", range(4))
def test_the_contradicting_bar_is_named_with_its_size(culprit: int) -> None:
    good = bars()
    wrong = good.length.copy()
    wrong[culprit] += 5e-3
    name = "-".join(map(str, good.ids[culprit].tolist()))
    with pytest.raises(InvalidInput, match=f"worst {name};") as caught:
        bars_scale(replace(good, length=wrong), IDS, POINTS, Q, scale_free=True, limit=6.0)
    assert "check length_mm" in str(caught.value)
    with pytest.raises(InvalidInput, match=r"the fixed targets by 5\.0"):
        bars_scale(replace(good, length=wrong), IDS, POINTS, Q, scale_free=False, limit=6.0)


def test_doubtful_bars_are_mentioned() -> None:
    good = bars()
    _, J = distances(POINTS, rows_of(good, IDS))
    sigma = np.sqrt((J @ Q @ J.T)[1, 1] + 1e-10)
    length = good.length.copy()
    length[1] += 5.0 * sigma
    _, note = bars_scale(replace(good, length=length), IDS, POINTS, Q, scale_free=True, limit=20.0)
    assert "contradict" in note


def test_check_lengths_with_unknown_sigma_or_target() -> None:
    checks = Lengths([[0, 1], [2, 3], [0, 99]], [*(bars().length[:2] - [1e-3, 0.0]), 1.0], [np.nan, 1e-4, 1e-4])
    first, second = length_results(checks, IDS, POINTS, Q, "check")
    assert first.error == pytest.approx(1e-3)
    assert first.w == pytest.approx(first.error / first.sigma)
    _, J = distances(POINTS, np.array([[2, 3]]))
    assert second.sigma == pytest.approx(float(np.sqrt((J @ Q @ J.T)[0, 0] + 1e-8)))


def test_impossible_lengths_are_refused() -> None:
    with pytest.raises(InvalidInput, match="above zero"):
        Lengths([[0, 1]], [-1.0], [1e-5])
    with pytest.raises(InvalidInput, match="itself"):
        Lengths([[4, 4]], [1.0], [1e-5])
    with pytest.raises(InvalidInput, match="2 pairs"):
        Lengths([[0, 1], [1, 2]], [1.0], [1e-5])
    with pytest.raises(InvalidInput, match="99"):
        rows_of(Lengths([[0, 99]], [1.0], [1e-5]), IDS)
