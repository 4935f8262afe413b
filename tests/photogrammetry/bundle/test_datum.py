"""Inner constraints and the choice of a datum."""

import numpy as np
import pytest

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.bundle.datum import InnerOver, resolve_datum, spans_triangle
from robcal.photogrammetry.core.network import Lengths
from robcal.transforms import exp_so3

POINTS = np.random.default_rng(0).normal(size=(8, 3))
IDS = np.arange(10, 18)
BARS = Lengths([[10, 11], [12, 13]], [1.0, 1.0], [1e-5, 1e-5])


@pytest.mark.parametrize(("lengths", "defect"), [(Lengths.none(), 7), (BARS, 6)])
def test_null_space_is_what_no_distance_ratio_notices(lengths: Lengths, defect: int) -> None:
    datum, note = resolve_datum("free", IDS, POINTS, lengths)
    assert note == ""
    N = datum.null_space(POINTS)
    assert N.shape == (24, defect) and datum.defect == defect  # noqa: PT018
    h = 1e-6
    moves = [POINTS + h * np.eye(3)[i] for i in range(3)]
    centre = POINTS.mean(axis=0)
    moves += [(POINTS - centre) @ exp_so3(h * np.eye(3)[i]).T + centre for i in range(3)]
    if defect == 7:
        moves.append(centre + (1 + h) * (POINTS - centre))
    for moved in moves:
        d = (moved - POINTS).ravel() / h
        # every such move lies in the span of the null space
        residual = d - N @ np.linalg.lstsq(N, d, rcond=None)[0]
        np.testing.assert_allclose(residual, 0.0, atol=1e-5)
    B = datum.constraints(POINTS)
    np.testing.assert_allclose(B.T @ B, np.eye(defect), atol=1e-12)


def test_constraints_over_some_targets_only() -> None:
    datum, _ = resolve_datum(InnerOver((10, 12, 15)), IDS, POINTS, BARS)
    B = datum.constraints(POINTS).reshape(8, 3, -1)
    np.testing.assert_allclose(B[[1, 3, 4, 6, 7]], 0.0, atol=1e-14)
    bars, _ = resolve_datum("bars", IDS, POINTS, BARS)
    assert bars.rows.tolist() == [0, 1, 2, 3]


def test_one_bar_cannot_carry_the_frame() -> None:
    datum, note = resolve_datum("bars", IDS, POINTS, BARS.select([0]))
    assert "one line" in note
    assert len(datum.rows) == 8


def test_refusals() -> None:
    with pytest.raises(InvalidInput, match="unknown"):
        resolve_datum("loose", IDS, POINTS, BARS)
    with pytest.raises(InvalidInput, match="99"):
        resolve_datum((10, 11, 99), IDS, POINTS, BARS)
    line = np.outer(np.arange(8.0), [1.0, 2.0, 3.0])
    with pytest.raises(DegenerateGeometry, match="triangle"):
        resolve_datum((10, 11, 12), IDS, line, BARS)
    with pytest.raises(DegenerateGeometry, match="triangle"):
        resolve_datum(InnerOver((10, 11)), IDS, POINTS, BARS)
    datum, _ = resolve_datum("free", IDS, line, BARS)
    with pytest.raises(DegenerateGeometry, match="one line"):
        datum.constraints(line)
    assert not spans_triangle(line)
