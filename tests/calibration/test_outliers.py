"""The rule that tells blunders from misfit."""

import numpy as np

from robcal.calibration.outliers import suspicious

COUNT = np.full(300, 6)


def test_plain_scatter_has_no_suspects_whatever_its_size() -> None:
    for seed in range(20):
        square = np.random.default_rng(seed).chisquare(6, 300) / 6
        assert suspicious(25.0 * square, COUNT, np.ones(300)) == []


def test_blunders_stand_out_also_next_to_one_another() -> None:
    square = np.random.default_rng(1).chisquare(6, 300) / 6
    square[[4, 5, 200]] = 60.0, 400.0, 1e5
    assert suspicious(square, COUNT, np.ones(300)) == [4, 5, 200]


def test_long_tails_of_a_misfit_are_no_blunders_but_what_leaves_them_far_behind_is() -> None:
    rng = np.random.default_rng(2)
    square = np.exp(1.1 * rng.normal(size=300)) * rng.chisquare(6, 300)
    assert suspicious(square, COUNT, np.ones(300)) == []
    square[17] = 5e3 * np.median(square)
    assert suspicious(square, COUNT, np.ones(300)) == [17]


def test_few_poses_are_not_judged() -> None:
    assert suspicious(np.array([1.0, 1.0, 1.0, 1e6]), np.full(4, 6), np.ones(4)) == []
