"""Sub-pixel centres against the Cramer-Rao bound and against simpler methods, on rendered images; and speed.

Run: ``python -m benchmarks.centroids [--scenes 3] [--no-speed]``. Tables:

1. isolated dots over size, tilt, noise and shading: RMS error by the bound for the ellipse fit, the grey centroid and
   the half-height contour (scikit-image), mean bias along the shading, normalised squared error per degree of freedom;
2. full scenes from ``fixtures``: a plate and a sphere with codes, dots, lamps, screws and glints: found, codes read,
   wrong codes, RMS, normalised squared error;
3. seconds for one image of 12 megapixels with 150 targets on one core, and for images with nothing to find.

Goals: 1.5 times the bound, 0.02 px RMS in full scenes, bias below 0.01 px under 10 % shading, no wrong code, 0.5 s.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from fixtures.bodies import TargetBody, target_plate, target_sphere
from fixtures.optics import Sensor, typical_camera
from fixtures.render import RenderedImage, render_image
from fixtures.ring_codes import smallest_reading
from fixtures.scene import Lighting
from fixtures.survey_scene import SurveyPlan, place_bars, survey_jobs
from robcal.imaging.cramer_rao import centre_bound
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import Detections
from robcal.imaging.noise import NoiseModel
from robcal.imaging.other_centroids import contour_centres, crop_around
from robcal.imaging.settings import DetectionSettings

Array = NDArray[np.float64]

_BLUR = 0.7
_SUB = 8
_CODED_BELOW = 1000  # ids of uncoded dots in fixtures begin there


def grey_centroids(image: NDArray, xy: Array, semi_axes: Array, background: Array) -> Array:
    """(n, 2) centres of gravity of the grey values above a tenth of the contrast.

    Parameters
    ----------
    image : (h, w), bright dots. xy : (n, 2) places. semi_axes : (n, 2). background : (n,) grey values.
    """
    result = np.full((len(xy), 2), np.nan)
    for row, place in enumerate(np.asarray(xy, dtype=float)):
        crop, x0, y0 = crop_around(image, place, int(np.ceil(semi_axes[row].max() + 3.0)))
        weight = crop - background[row]
        weight = np.where(weight > 0.1 * weight.max(), weight, 0.0)
        total = weight.sum()
        if total > 0:
            rows, columns = np.indices(crop.shape)
            result[row] = x0 + (weight * columns).sum() / total, y0 + (weight * rows).sum() / total
    return result


@dataclass(frozen=True)
class Isolated:
    """One row of the first table."""

    radius: float
    ratio: float
    contrast: float
    read_noise: float
    gain: float
    shading: float  # relative change over the dot's diameter, along x


CASES = (
    *(Isolated(radius, ratio, 180.0, 1.0, 0.05, 0.0) for radius in (1.0, 2.0, 4.0, 8.0, 16.0) for ratio in (1.0, 0.5)),
    *(Isolated(radius, 1.0, 80.0, 3.0, 0.1, 0.0) for radius in (2.0, 4.0, 8.0)),
    *(Isolated(radius, 1.0, 150.0, 1.0, 0.05, 0.1) for radius in (4.0, 8.0, 16.0)),
)


def _field(case: Isolated, rng: np.random.Generator, side: int) -> tuple[NDArray[np.uint8], Array]:
    """Image of side x side isolated dots and their centres, by supersampling."""
    pitch = int(3 * case.radius + 14)
    fine = (np.arange(pitch * _SUB) + 0.5) / _SUB - 0.5
    image = np.zeros((pitch * side, pitch * side))
    centres = []
    for row in range(side):
        for column in range(side):
            x, y = pitch / 2 + rng.uniform(-0.5, 0.5, 2)
            angle = rng.uniform(0, np.pi)
            dx, dy = fine[None] - x, fine[:, None] - y
            u = (np.cos(angle) * dx + np.sin(angle) * dy) / case.radius
            v = (-np.sin(angle) * dx + np.cos(angle) * dy) / (case.radius * case.ratio)
            shape = np.clip(0.5 - (np.hypot(u, v) - 1) * case.radius * case.ratio * _SUB, 0, 1)
            shape = shape * (1 + case.shading * dx / (2 * case.radius))
            shape = gaussian_filter(shape, _BLUR * _SUB, mode="nearest")
            cell = shape.reshape(pitch, _SUB, pitch, _SUB).mean(axis=(1, 3))
            image[row * pitch : (row + 1) * pitch, column * pitch : (column + 1) * pitch] = cell
            centres.append((column * pitch + x, row * pitch + y))
    grey = 15.0 + case.contrast * image
    grey += rng.normal(size=grey.shape) * np.sqrt(case.read_noise**2 + case.gain * grey)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), np.array(centres)


def isolated_table(side: int = 12) -> None:
    """Prints the first table."""
    print("isolated dots: RMS by Cramer-Rao bound (ellipse fit / grey centroid / contour), bias in px along shading")
    print(
        "  a px ratio contrast noise shading | found    bound px | fit   grey  contour | bias fit  grey  contour | nees"
    )
    for number, case in enumerate(CASES):
        rng = np.random.default_rng(100 + number)
        image, true = _field(case, rng, side)
        found = detect_targets(image)
        distance, row = cKDTree(found.xy).query(true)
        hit = distance < 1.0
        row, true = row[hit], true[hit]
        variance = case.read_noise**2 + 15.0 * case.gain + 1 / 12
        bound = centre_bound(
            (case.radius, case.radius * case.ratio),
            0.0,
            _BLUR,
            case.contrast,
            15.0,
            NoiseModel(variance, case.gain, 15.0),
        )
        limit = np.sqrt(np.trace(bound) / 2)
        xy, axes, ground = found.xy[row], found.semi_axes[row], found.background[row]
        errors = [
            xy - true,
            grey_centroids(image, xy, axes, ground) - true,
            contour_centres(image, xy, axes, ground, found.contrast[row]) - true,
        ]
        rms = [np.sqrt(np.nanmean(e**2)) / limit for e in errors]
        bias = [np.nanmean(e[:, 0]) for e in errors]
        nees = np.einsum("ni,nij,nj->n", errors[0], np.linalg.inv(found.covariance[row]), errors[0]).mean() / 2
        print(
            f"{case.radius:6.1f} {case.ratio:5.2f} {case.contrast:8.0f} {case.read_noise:5.1f} {case.shading:7.2f} |"
            f" {hit.mean():5.1%} {limit:11.4f} | {rms[0]:4.2f} {rms[1]:6.2f} {rms[2]:7.2f}  |"
            f" {bias[0]:+8.4f} {bias[1]:+7.4f} {bias[2]:+7.4f} | {nees:4.2f}"
        )


def _scenes(body: TargetBody, count: int, lighting: Lighting, bits: int, seed: int) -> Iterator[RenderedImage]:
    """Survey images of five megapixels, spread over the stations of a survey of seven times as many."""
    camera = typical_camera(2448, 2048, focal_mm=12.0, pixel_um=3.45, seed=seed, sensor=Sensor(bits=bits))
    plan = SurveyPlan(body.name, body, camera, 7 * count, bars=(0.6,), check_bars=(0.4,), lighting=lighting, seed=seed)
    bars, checks = place_bars(plan, skip_ids=frozenset())
    jobs, _ = survey_jobs(plan, bars + checks, Path("unused"), None)
    for job in jobs[::7][:count]:
        yield render_image(job.scene, job.camera, job.world_T_camera, seed=job.seed)


def scene_table(count: int) -> None:
    """Prints the second table."""
    print("\nfull scenes of 5 megapixels (all codes allowed, none known beforehand)")
    print("scene                 images targets  found  codes read  wrong  strangers   RMS px  nees   s/image")
    for name, body, lighting, bits, seed in (
        ("plate", target_plate(size=0.6, seed=1), Lighting(), 8, 1),
        ("plate, 10 % shading", target_plate(size=0.6, seed=2), Lighting(target_shading=(0.1, 0.05)), 8, 2),
        ("plate, 16 bit", target_plate(size=0.6, seed=3), Lighting(), 16, 3),
        ("large plate, far", target_plate(size=1.0, diameter=0.008, seed=4), Lighting(), 8, 4),
        ("sphere", target_sphere(seed=1), Lighting(), 8, 5),
    ):
        rows = [_score(image) for image in _scenes(body, count, lighting, bits, seed)]
        total = {key: sum(row[key] for row in rows) for key in rows[0]}
        print(
            f"{name:21s} {count:6d} {total['targets']:7.0f} {total['found'] / total['targets']:6.1%}"
            f" {total['read'] / max(total['coded'], 1):10.1%} {total['wrong']:6.0f} {total['strangers']:10.0f}"
            f" {np.sqrt(total['squares'] / (2 * total['found'])):8.4f} {total['nees'] / total['found']:5.2f}"
            f" {total['seconds'] / count:8.2f}"
        )


def _score(rendered: RenderedImage) -> dict[str, float]:
    truth = rendered.truth
    begin = time.process_time()
    found: Detections = detect_targets(rendered.image)
    seconds = time.process_time() - begin
    # dots that shine at least as much above the ground as the settings ask for
    whole = (truth.visible > 0.999) & (truth.light > 0.05) & (truth.semi_axes[:, 1] > 1.0)
    distance, row = cKDTree(found.xy).query(truth.area_centre)
    hit = whole & (distance < 1.0)
    error = found.xy[row[hit]] - truth.area_centre[hit]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance[row[hit]]), error) / 2
    coded = truth.ids < _CODED_BELOW
    nearest, target = cKDTree(truth.area_centre).query(found.xy)
    wrong = (found.code >= 0) & ((nearest > 2.0) | (truth.ids[target] != found.code))
    return {
        "targets": float(whole.sum()),
        "found": float(hit.sum()),
        "coded": float((whole & coded).sum()),
        "read": float((hit & coded & (found.code[row] == truth.ids)).sum()),
        "wrong": float(wrong.sum()),
        "strangers": float((nearest > 2.0).sum()),
        "squares": float((error**2).sum()),
        "nees": float(nees.sum()),
        "seconds": seconds,
    }


def _twelve_megapixels(rng: np.random.Generator, targets: int = 150, coded: int = 50) -> NDArray[np.uint8]:
    """4000 x 3000 px with targets of 5 to 10 px radius on a grid."""
    light = np.zeros((3000, 4000), np.float32)
    columns = 15
    for k in range(targets):
        x, y = 130 + 265 * (k % columns), 130 + 290 * (k // columns)
        radius = rng.uniform(5, 10)
        half = int(3.2 * radius + 4)
        fine = (np.arange((2 * half + 1) * 4) + 0.5) / 4 - 0.5 - half
        dx, dy = fine[None] - rng.uniform(-0.5, 0.5), fine[:, None] - rng.uniform(-0.5, 0.5)
        dy = dy / rng.uniform(0.6, 1.0)
        rho = np.hypot(dx, dy) / radius
        shape = (rho < 1).astype(float)
        if k < coded:
            bits = smallest_reading(int(rng.integers(1, 4095)))
            segment = (np.floor(np.arctan2(dy, dx) / (np.pi / 6)) % 12).astype(int)
            shape = np.where((rho > 2) & (rho < 3), (bits >> (11 - segment)) & 1, shape)
        cell = gaussian_filter(shape, 2.8).reshape(2 * half + 1, 4, 2 * half + 1, 4).mean(axis=(1, 3))
        light[y - half : y + half + 1, x - half : x + half + 1] = cell
    grey = 15 + 180 * light + rng.normal(size=light.shape).astype(np.float32)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def speed_table() -> None:
    """Prints the third table; processor seconds, best of five."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(7)
    noise = rng.integers(0, 256, (3000, 4000)).astype(np.uint8)
    texture = sum(
        cv2.resize(rng.normal(size=(3000 // s, 4000 // s)).astype(np.float32), (4000, 3000)) * 25 for s in (4, 16, 64)
    )
    images = {
        "150 targets, 50 coded": _twelve_megapixels(rng),
        "black": np.zeros((3000, 4000), np.uint8),
        "saturated": np.full((3000, 4000), 255, np.uint8),
        "noise": noise,
        "texture everywhere": np.clip(128 + np.asarray(texture), 0, 255).astype(np.uint8),
    }
    print("\n12 megapixels on one core      targets  codes  seconds")
    for name, image in images.items():
        found = detect_targets(image, DetectionSettings())
        seconds = []
        for _ in range(5 if len(found) < 1000 else 1):
            begin = time.process_time()
            detect_targets(image, DetectionSettings())
            seconds.append(time.process_time() - begin)
        print(f"{name:29s} {len(found):8d} {(found.code >= 0).sum():6d} {min(seconds):8.2f}")


def main() -> None:
    """All tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=3, help="images per kind of scene; 0: none")
    parser.add_argument("--no-speed", action="store_true")
    arguments = parser.parse_args()
    isolated_table()
    if arguments.scenes:
        scene_table(arguments.scenes)
    if not arguments.no_speed:
        speed_table()


if __name__ == "__main__":
    main()
