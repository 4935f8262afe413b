"""Gains over blocked folds: what pays, what is clear, what is neither."""

import numpy as np
import pytest

from robcal.diagnosis.gain.delivered import gain_of

FOLD = np.repeat(np.arange(8), 12)


def errors(scale: float, seed: int) -> np.ndarray:
    return np.abs(np.random.default_rng(seed).normal(0.0, scale, len(FOLD)))


def test_a_true_gain_pays_and_a_large_one_is_clear() -> None:
    before = errors(1e-4, 1)
    assert gain_of(before, 0.9 * before, FOLD).pays
    assert not gain_of(before, 0.95 * before, FOLD).clear
    assert gain_of(before, 0.5 * before, FOLD).clear


def test_chance_does_not_pay_more_often_than_chance_does() -> None:
    pays = [gain_of(errors(1e-4, 2 * k), errors(1e-4, 2 * k + 1), FOLD).pays for k in range(200)]
    assert np.mean(pays) < 0.25


def test_a_pose_of_great_leverage_does_not_hide_what_all_others_gain() -> None:
    before = errors(1e-4, 3)
    after = 0.5 * before
    before[-1], after[-1] = 150e-4, 12e-4
    found = gain_of(before, after, FOLD)
    assert found.before - found.after < 2.0 * found.sigma
    assert found.pays


def test_a_pose_of_great_leverage_alone_does_not_pay() -> None:
    before, after = errors(1e-4, 5), errors(1e-4, 6)
    before[-1], after[-1] = 150e-4, 12e-4
    assert not gain_of(before, after, FOLD).pays


def test_a_gain_bought_in_one_part_does_not_pay() -> None:
    before = errors(1e-4, 3)
    after = np.where(FOLD == 2, 1.5 * before, 0.7 * before)
    found = gain_of(before, after, FOLD)
    assert found.before - found.after > found.sigma
    assert not found.even
    assert not found.pays


def test_standard_error_is_that_of_repeated_draws() -> None:
    drawn = [gain_of(b := errors(1e-4, k), b * (1 + errors(0.3, 900 + k)), FOLD) for k in range(300)]
    gains = np.array([g.before - g.after for g in drawn])
    assert np.sqrt(np.mean([g.sigma**2 for g in drawn])) == pytest.approx(gains.std(), rel=0.25)
