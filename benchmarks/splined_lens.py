"""Is a lens called splined only where it is, and what does that gain at the object?

``python -m benchmarks.splined_lens [--seeds 20]``: surveys of a plate of 64 targets from 24 images (0.05 px noise) by a
lens of Brown's plus a wavy field of the given size (px, peak) that no polynomial has; ``none`` is Brown's alone.
``called`` counts surveys that got splines, ``error`` is that of the points (mm, RMS, after a similarity) without and
with them, ``sigma0`` what the residuals scatter (px).
"""

import argparse
from dataclasses import replace

import numpy as np

from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from robcal.photogrammetry.survey.splined_lens import with_splined_lens
from robcal.photogrammetry.survey.survey import BodyTarget, SurveyResult, survey_body
from robcal.transforms import Array
from tests.photogrammetry.networks import aligned_error, detections, make_network

SIZE = (2400, 1800)


def ripple(xy: Array, size_px: float, phase: Array) -> Array:
    """A wavy field (n, 2) px at pixels (n, 2)."""
    x, y = xy[:, 0] / SIZE[0], xy[:, 1] / SIZE[1]
    a, b = np.sin(9.0 * x + phase[0]) * np.cos(7.0 * y + phase[1]), np.cos(8.0 * x + phase[2]) * np.sin(6.0 * y)
    return size_px * np.stack([a, b], axis=1)


def one(seed: int, size_px: float) -> tuple[bool, float, float, float, float]:
    """Whether it got splines; errors (mm) without and with them, sigma0 (px) without and with them."""
    rng = np.random.default_rng([seed, 17])
    truth = make_network(rng, images=24, targets=64)
    m = truth.marks
    truth = replace(truth, marks=replace(m, xy=m.xy + ripple(m.xy, size_px, rng.uniform(0, 6, 3))))
    images = detections(truth, 64, rng)
    targets = [BodyTarget(100 + i, "ring12", None, None) for i in range(64)]
    bar = Lengths([[100, 163]], [float(np.linalg.norm(truth.points[0] - truth.points[63]))], [3e-6])

    def survey(camera: Camera | None) -> SurveyResult:
        return survey_body(images, targets, size=SIZE, camera=camera, scale_bars=bar)

    def missed(net: CameraNetwork) -> float:
        return 1e3 * float(
            np.sqrt(np.mean(aligned_error(net.points[np.argsort(net.ids)], truth.points, scale=True) ** 2))
        )

    done = survey(None)
    splined = with_splined_lens(done, survey)
    best = done if splined is None else splined.result
    errors = missed(done.network), missed(best.network)
    return splined is not None, *errors, done.network.sigma0_px, best.network.sigma0_px


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    print("field px  called  error mm without, with   sigma0 px without, with")
    for size in (0.0, 0.03, 0.1, 0.3, 1.0):
        count = seeds if size == 0.0 else max(3, seeds // 4)
        rows = np.array([one(seed, size) for seed in range(count)])
        _, before, after, rough, fine = rows.mean(axis=0)
        print(
            f"{size or 'none':>8}  {int(rows[:, 0].sum()):3d}/{count:<3d}  {before:9.5f}, {after:9.5f}"
            f"       {rough:7.4f}, {fine:7.4f}"
        )


if __name__ == "__main__":
    main()
