"""Denavit-Hartenberg tables against their own closed form."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal.errors import InvalidInput
from robcal.robot.chain import chain_of, forward
from robcal.robot.dh import DHRow, dh_matrix, frames_from_dh
from robcal.robot.model import RobotModel

lengths = st.floats(-1.5, 1.5)
angles = st.floats(-3.1, 3.1)
rows = st.builds(
    DHRow,
    theta=angles,
    d=lengths,
    a=lengths,
    alpha=angles,
    beta=st.sampled_from([0.0, 0.01, -0.3]),
    prismatic=st.booleans(),
    sign=st.sampled_from([1, -1]),
)


@pytest.mark.parametrize("convention", ["standard", "modified"])
@given(table=st.lists(rows, min_size=1, max_size=7), seed=st.integers(0, 2**16))
@settings(max_examples=60, deadline=None)
def test_chain_moves_as_the_table_says(convention, table, seed):
    rng = np.random.default_rng(seed)
    model = RobotModel("dh", frames_from_dh(table, convention))
    q = rng.uniform(-2, 2, len(table))
    expected = np.eye(4)
    for row, value in zip(table, q, strict=True):
        expected = expected @ dh_matrix(row, value, convention)
    assert forward(chain_of(model), q)[0] == pytest.approx(expected, abs=1e-12)


def test_ur10_table_reaches_the_published_zero_position():
    half = np.pi / 2
    table = [
        DHRow(d=0.1273, alpha=half),
        DHRow(a=-0.612),
        DHRow(a=-0.5723),
        DHRow(d=0.163941, alpha=half),
        DHRow(d=0.1157, alpha=-half),
        DHRow(d=0.0922),
    ]
    T = forward(chain_of(RobotModel("ur10", frames_from_dh(table))), np.zeros(6))[0]
    assert T[:3, 3] == pytest.approx([-0.612 - 0.5723, -0.163941 - 0.0922, 0.1273 - 0.1157], abs=1e-12)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ([], "no rows"),
        ([DHRow(a=float("nan"))], "row 1"),
        ([DHRow(), DHRow(alpha=90.0)], "row 2.*degrees"),
        ([DHRow(d=612.0)], "millimetres"),
    ],
)
def test_bad_tables_are_refused(table, words):
    with pytest.raises(InvalidInput, match=words):
        frames_from_dh(table)


def test_factory_tables_with_offsets_that_cancel_are_read_and_kept_near_the_robot():
    """UR's own calibration: axes 2 and 3 nearly parallel, d of hundreds of metres."""
    columns = {
        "theta": (-1e-5, -1.437, 2.0254, -0.5883, 4e-5, 8e-6),
        "a": (0.00028, -0.0567, -0.3265, 0.0, 0.0, 0.0),
        "d": (0.0889, 574.24, -507.36, -66.77, 0.09497, 0.08256),
        "alpha": (1.57034, -0.000734, 0.003256, 1.5704, -1.57101, 0.0),
    }
    table = [DHRow(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]
    q = np.random.default_rng(2).uniform(-3, 3, 6)
    frames = frames_from_dh(table)
    expected = np.eye(4)
    for row, value in zip(table, q, strict=True):
        expected = expected @ dh_matrix(row, value)
    assert forward(chain_of(RobotModel("ur5", frames)), q)[0] == pytest.approx(expected, abs=1e-10)
    assert max(np.linalg.norm(f.xyz) for f in frames) < 1.0
    in_millimetres = [replace(row, d=1e3 * row.d, a=1e3 * row.a) for row in table]
    with pytest.raises(InvalidInput, match="millimetres"):
        frames_from_dh(in_millimetres)
