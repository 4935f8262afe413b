"""A survey's scale against its check lengths."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.diagnosis.images.lens_findings import scale_findings
from robcal.photogrammetry.bundle.lengths import distances, length_results
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from tests.diagnosis.image_scenes import survey

SIGMA = 5e-6


@pytest.fixture(scope="module")
def network() -> CameraNetwork:
    return survey(seed=12)[0].network


def _checked(network: CameraNetwork, ppm: float, seed: int, wrong: float = 0.0, count: int = 4) -> CameraNetwork:
    """The network with check lengths from which it differs by ppm; the first one is wrong by so many m besides."""
    rng = np.random.default_rng(seed)
    ids = np.asarray(network.ids)
    pairs = np.stack([ids[:count], ids[count : 2 * count]], axis=1)
    measured, J = distances(network.points, network.index_of(pairs.ravel()).reshape(-1, 2))
    drawn = rng.multivariate_normal(np.zeros(count), J @ network.points_covariance @ J.T + SIGMA**2 * np.eye(count))
    stated = measured / (1.0 + 1e-6 * ppm) + drawn
    stated[0] += wrong
    lengths = Lengths(pairs, stated, np.full(count, SIGMA))
    checks = length_results(lengths, ids, network.points, network.points_covariance, "check")
    return replace(network, check_lengths=checks)


def test_a_wrong_scale_bar_shows_in_all_check_lengths(network: CameraNetwork) -> None:
    (found,) = scale_findings(_checked(network, 300.0, 1), "plate")
    assert (found.name, found.stage, found.where) == ("scale_error", "camera", "station")
    assert abs(found.parameters["ppm"] - 300.0) < 4.0 * found.sigma["ppm"]
    assert 0.0 < found.sigma["ppm"] < 60.0
    assert "too long" in found.statement
    assert "too short" in scale_findings(_checked(network, -300.0, 1), "plate")[0].statement


def test_right_scales_are_hardly_ever_doubted(network: CameraNetwork) -> None:
    assert not any(scale_findings(_checked(network, 0.0, seed), "plate") for seed in range(200))


def test_one_wrong_check_length_is_no_scale(network: CameraNetwork) -> None:
    assert scale_findings(_checked(network, 0.0, 2, wrong=5e-4), "plate") == ()
    assert scale_findings(_checked(network, 300.0, 2, count=1), "plate") == ()
