"""Accuracy of a survey from rendered images: coordinates, scale, and whether the stated covariance is true.

Run: ``python -m benchmarks.survey_accuracy [--images 60] [--seeds 1 2 3] [--size 1.0] [--small]``. Each row is one
campaign: a plate of 25 codes and 100 dots with a scale bar (``--body sphere``: a sphere of 0.4 m with 48 codes and 102
dots, seen from outside), photographed all around by a self-calibrating camera of 5 megapixels (``--small``: 1.3),
lamps, screws and glints lying about. Goals: RMS after alignment below 5 um, scale within
20 ppm, normalised estimation error squared per degree of freedom between 0.8 and 1.2.

Rendered images are kept in ``--cache`` (about 2.5 GB per hundred images of full size).
"""

import argparse
import csv
import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import yaml

from fixtures.bodies import target_plate
from fixtures.campaign_writer import write_image_campaign
from fixtures.image_campaign import full_campaign
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import Detections
from robcal.imaging.settings import DetectionSettings
from robcal.photogrammetry.core.network import Lengths
from robcal.photogrammetry.survey.survey import BodyTarget, SurveyImage, SurveyResult, survey_body

Array = np.ndarray


@dataclass(frozen=True)
class Accuracy:
    """What one survey reached; lengths in um."""

    images: int
    targets: int
    centroid_px: float
    rms_um: float
    stated_um: float
    scale_ppm: float
    nees: float
    sigma0: float
    detect_s: float
    survey_s: float


def rendered(
    cache: Path,
    *,
    images: int,
    size: float,
    seed: int,
    small: bool,
    start: str,
    listed: bool = True,
    body: str = "plate",
) -> Path:
    """Folder with campaign/ and truth/, rendered if it is not there yet."""
    name = f"survey-{images}-{size:g}-{seed}{'-small' if small else ''}-{start}{'' if listed else '-unlisted'}"
    name += "" if body == "plate" else f"-{body}"
    folder = cache / name
    if not (folder / "done").exists():
        camera = {"width": 1280, "height": 1024, "focal_mm": 8.0, "pixel_um": 4.8} if small else {}
        plate = target_plate(size=size, diameter=(0.014 if small else 0.010) * size, seed=seed)
        plan = full_campaign(
            seed=seed, survey_images=images, identify=0, verify=0, body=plate, sphere=body == "sphere", **camera
        )
        plan = replace(plan, surveys=tuple(survey for survey in plan.surveys if survey.name == body))
        write_image_campaign(
            replace(plan, start_values=start, bars_listed=listed), folder / "campaign", folder / "truth"
        )
        (folder / "done").touch()
    return folder


def detect(path_and_codes: tuple[Path, frozenset[int]]) -> Detections:
    """Targets of one image file."""
    path, codes = path_and_codes
    cv2.setNumThreads(1)
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return detect_targets(image, DetectionSettings(known_codes=codes))


def body_of(folder: Path) -> str:
    """Name of the surveyed body."""
    return next(iter(yaml.safe_load((folder / "campaign" / "campaign.yaml").read_text())["bodies"]))


def centroid_errors(folder: Path, detections: dict[str, Detections]) -> Array:
    """Differences (n, 2) px between detected centres and true centres of area, of wholly visible targets."""
    errors = []
    for name, found in detections.items():
        with (folder / "truth" / "survey" / body_of(folder) / f"{name}.csv").open() as stream:
            rows = [r for r in csv.DictReader(stream) if float(r["visible"]) > 0.999]
        true = np.array([[float(r["x_area_px"]), float(r["y_area_px"])] for r in rows])
        if len(true) == 0 or len(found.xy) == 0:
            continue
        gap = np.linalg.norm(found.xy[:, None] - true, axis=-1)
        hit = np.min(gap, axis=1) < 1.0
        errors.append((found.xy - true[np.argmin(gap, axis=1)])[hit])
    return np.concatenate(errors)


def survey(folder: Path, workers: int) -> tuple[SurveyResult, dict[str, Detections], float, float]:
    """Detect and adjust; seconds of both."""
    campaign = yaml.safe_load((folder / "campaign" / "campaign.yaml").read_text())["bodies"][body_of(folder)]
    entries = yaml.safe_load((folder / "campaign" / campaign["targets"]).read_text())["targets"]
    targets = [
        BodyTarget(
            id=e["id"],
            code=e["code"],
            diameter=e["diameter_mm"] and e["diameter_mm"] / 1e3,
            xyz=None if e["xyz_mm"] is None else tuple(v / 1e3 for v in e["xyz_mm"]),
            sigma=e["sigma_mm"] / 1e3 if e.get("sigma_mm") else None,
        )
        for e in entries
    ]
    bars = campaign["survey"]["scale_bars"]
    lengths = Lengths(
        np.array([b["targets"] for b in bars]),
        np.array([b["length_mm"] for b in bars]) / 1e3,
        np.array([b["sigma_mm"] for b in bars]) / 1e3,
    )
    every = bars + campaign["survey"]["check_lengths"]
    codes = frozenset(t.id for t in targets if t.code) | frozenset(i for b in every for i in b["targets"])
    paths = sorted((folder / "campaign" / campaign["survey"]["images"]).glob("*.png"))
    begin = time.perf_counter()
    with ProcessPoolExecutor(workers) as pool:
        found = dict(zip([p.stem for p in paths], pool.map(detect, [(p, codes) for p in paths]), strict=True))
    middle = time.perf_counter()
    height, width = next(iter(found.values())).shape
    result = survey_body(
        [SurveyImage(name, d) for name, d in found.items()], targets, size=(width, height), scale_bars=lengths
    )
    return result, found, middle - begin, time.perf_counter() - middle


def aligned(measured: Array, true: Array, *, scale: bool) -> tuple[Array, float]:
    """Rest (n, 3) after the best rigid (or similarity) alignment of the measured points, and its scale factor."""
    a, b = measured - measured.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    factor = float(np.sum(s * flip) / np.sum(a**2)) if scale else 1.0
    return factor * a @ (u * flip @ vt).T - b, factor


def matched(result: SurveyResult, folder: Path) -> tuple[Array, Array, Array]:
    """Rows of the network's points that are targets of the plate, measured (n, 3) and true (n, 3) coordinates.

    Codes are matched by id, dots (which the survey names itself) by their place.
    """
    body = json.loads((folder / "truth" / "truth.json").read_text())["bodies"][body_of(folder)]
    true = np.array(body["xyz_mm"]) / 1e3
    true_rows = {int(i): k for k, i in enumerate(body["ids"]) if body["coded"][k]}
    ids, points = np.asarray(result.network.ids), np.asarray(result.network.points)
    pairs = [(k, true_rows[int(i)]) for k, i in enumerate(ids) if int(i) in true_rows]
    mine, theirs = (np.array(column) for column in zip(*pairs, strict=True))
    a, b = points[mine], true[theirs]
    u, _, vt = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    turn = u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))] @ vt
    placed = (points - a.mean(axis=0)) @ turn.T + b.mean(axis=0)
    gap = np.linalg.norm(placed[:, None] - true, axis=-1)
    near = np.argmin(gap, axis=1)
    # The frame from the codes is good to a tenth of a millimetre: the nearest true target is the one.
    rows = np.flatnonzero((gap[np.arange(len(ids)), near] < 1e-3) & ~np.isin(ids, _bar_ids(folder)))
    return rows, points[rows], true[near[rows]]


def _bar_ids(folder: Path) -> list[int]:
    survey_truth = json.loads((folder / "truth" / "truth.json").read_text())["surveys"][body_of(folder)]
    return [i for bar in survey_truth["bars"] for i in bar["targets"]]


def normalised_error(covariance: Array, measured: Array, true: Array) -> float:
    """Squared error over its covariance (3n, 3n), per degree of freedom, whatever frame either is given in.

    Both are projected off the six rigid movements, so the choice of datum does not matter; the scale is judged.
    """
    # The true points are brought to the measured ones, where the covariance holds.
    b = true - true.mean(axis=0)
    a = measured - measured.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))] @ vt
    rest = a - b @ turn.T
    zero = np.zeros(len(a))
    x, y, z = a.T
    rotations = [np.column_stack(c).ravel() for c in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    shifts = [np.tile(np.eye(3)[k], len(a)) for k in range(3)]
    basis, _ = np.linalg.qr(np.column_stack([*shifts, *rotations]))
    project = np.eye(3 * len(a)) - basis @ basis.T
    values, vectors = np.linalg.eigh(project @ covariance @ project)
    kept = slice(6, None)
    amplitudes = vectors[:, kept].T @ rest.ravel()
    return float(np.mean(amplitudes**2 / values[kept]))


def judge(folder: Path, workers: int) -> Accuracy:
    """Survey one campaign and compare with its truth."""
    result, found, detect_s, survey_s = survey(folder, workers)
    rows, measured, true = matched(result, folder)
    index = (3 * rows[:, None] + np.arange(3)).ravel()
    covariance = np.asarray(result.network.points_covariance)[np.ix_(index, index)]
    rest, _ = aligned(measured, true, scale=False)
    _, factor = aligned(measured, true, scale=True)
    return Accuracy(
        images=len(result.network.image_names),
        targets=len(rows),
        centroid_px=float(np.sqrt(np.mean(centroid_errors(folder, found) ** 2))),
        rms_um=1e6 * float(np.sqrt(np.mean(rest**2))),
        stated_um=1e6 * float(np.sqrt(np.mean(np.diag(covariance)))),
        scale_ppm=1e6 * (1.0 / factor - 1.0),
        nees=normalised_error(covariance, measured, true),
        sigma0=float(result.network.sigma0),
        detect_s=detect_s,
        survey_s=survey_s,
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--size", type=float, default=1.0, help="side of the plate, m")
    parser.add_argument("--body", choices=("plate", "sphere"), default="plate")
    parser.add_argument("--small", action="store_true", help="images of 1.3 megapixels")
    parser.add_argument("--start", choices=("none", "rough"), default="none")
    parser.add_argument("--bars-unlisted", action="store_true", help="the body file does not list the scale bars")
    parser.add_argument("--cache", type=Path, default=Path("build/benchmarks"))
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    print("seed images targets  centroid  RMS    stated  scale  NEES/dof sigma0  detect  survey")
    print("                     px        um     um      ppm                    s       s")
    for seed in given.seeds:
        folder = rendered(
            given.cache,
            images=given.images,
            size=given.size,
            seed=seed,
            small=given.small,
            start=given.start,
            listed=not given.bars_unlisted,
            body=given.body,
        )
        a = judge(folder, given.workers)
        print(
            f"{seed:4d} {a.images:6d} {a.targets:7d}  {a.centroid_px:8.4f} {a.rms_um:6.2f} {a.stated_um:6.2f} "
            f"{a.scale_ppm:7.2f} {a.nees:8.3f} {a.sigma0:7.3f} {a.detect_s:7.1f} {a.survey_s:7.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
