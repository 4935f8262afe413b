"""Elimination of dependent parameters on columns whose dependence is known."""

import numpy as np
import pytest

from robcal.estimation.dependence import Eliminated, split_dependent, with_ties


def test_dependent_columns_are_named_with_their_ties() -> None:
    rng = np.random.default_rng(0)
    J = rng.normal(size=(40, 6))
    J[:, 3] = 2.0 * J[:, 0] - 0.5 * J[:, 1]
    J[:, 4] = 0.0
    J[:, 5] *= 1e-3
    kept, gone = split_dependent(J.T @ J, list("abcdef"), np.array([np.inf] * 5 + [10.0]))
    assert kept == [0, 1, 2]
    by_name = {e.name: e for e in gone}
    assert by_name["d"].reason == "dependent"
    assert by_name["d"].tied_to == pytest.approx({"a": 2.0, "b": -0.5}, abs=1e-6)
    assert by_name["e"].reason == "no influence"
    assert by_name["f"].reason == "weak"
    assert by_name["f"].sigma == pytest.approx(1e3 / np.sqrt(40), rel=0.5)
    assert split_dependent(J.T @ J, list("abcdef"))[0] == [0, 1, 2, 5]


def test_ties_name_parameters_that_were_kept_in_the_end() -> None:
    J = np.random.default_rng(5).normal(size=(40, 5))
    J[:, 3] = 2.0 * J[:, 0] - 0.5 * J[:, 1]
    J[:, 4] = 0.0
    gone = [Eliminated("d", "dependent", {"c": 9.0}, np.inf), Eliminated("e", "no influence", {}, np.inf)]
    tied, none = with_ties(J.T @ J, ["a", "b", "c", "d", "e"], 3, gone)
    assert tied.tied_to == pytest.approx({"a": 2.0, "b": -0.5})
    assert none.tied_to == {}
