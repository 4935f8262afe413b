"""Corners and circles of printed boards against the Cramer-Rao bound, beside OpenCV's, on rendered images.

Run: ``python -m benchmarks.boards [--images 4]``. Every row is one kind of board under one condition: marks that could
be seen whole, share of them found, wrong ids (farther than a pixel from where that id is), RMS error of a coordinate by
the bound for ours and for OpenCV's on the same images, mean error of the worse coordinate, normalised squared error
per degree of freedom, processor seconds for an image.

The bound of a corner counts the pixels nearer to it than to the next one, with its place, the directions of its edges,
blur and two grey levels unknown, and the true noise of the sensor; of a circle, those of its rim. OpenCV's corners are
``cornerSubPix`` from the true places, the better of a window of 5 px and of the largest without another corner; its
circles are ``findCirclesGrid``'s. Ours of circles are corrected for eccentricity with the true pose; beside it without.
"""

import argparse
import time
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fixtures.board_pattern import BoardPattern
from fixtures.board_scene import BoardImage, BoardLight, render_board
from fixtures.optics import Sensor, TrueCamera
from fixtures.rigid import frame, rotation
from fixtures.scene import Spot
from robcal.imaging.corner_model import blurred_corner
from robcal.imaging.cramer_rao import centre_bound
from robcal.imaging.detections import Detections
from robcal.imaging.noise import NoiseModel
from robcal.photogrammetry.boards.detect import find_board
from robcal.photogrammetry.boards.layout import Board
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.eccentricity import centre_shift

Array = NDArray[np.float64]

CAMERA = TrueCamera(640, 480, 800.0, 800.0, 322.0, 237.0, k1=-0.08, psf_px=0.7)
PATTERNS = {
    "charuco": BoardPattern("charuco", 8, 6, square=0.03, marker=0.022),
    "chessboard": BoardPattern("chessboard", 9, 6, square=0.028),
    "aprilgrid": BoardPattern(
        "aprilgrid", 6, 4, marker=0.036, spacing=0.0108, dictionary="DICT_APRILTAG_36h11", border_bits=2, tag_turns=2
    ),
    "circles": BoardPattern("circles", 8, 6, spacing=0.03, diameter=0.017),
    "asymmetric_circles": BoardPattern("asymmetric_circles", 4, 11, spacing=0.02, diameter=0.016),
}


@dataclass(frozen=True)
class Condition:
    """What is varied; ``tilt`` in degrees, ``distance`` in m."""

    name: str
    tilt: float = 10.0
    distance: float = 0.45
    psf: float = 0.7
    light: BoardLight = field(default_factory=BoardLight)
    full_well: float = 10000.0
    covered: bool = False
    spots: int = 0


CONDITIONS = (
    Condition("plain"),
    Condition("tilted by 30 deg", tilt=30.0),
    Condition("tilted by 55 deg", tilt=55.0),
    Condition("twice as far", distance=0.9),
    Condition("blur 0.4 px", psf=0.4),
    Condition("blur 1.5 px", psf=1.5),
    Condition("dim, noisy", light=BoardLight(white=0.2, black=0.03, ground=0.1), full_well=3000.0),
    Condition("light falls by half", light=BoardLight(gradient=(0.7, 0.3))),
    Condition("partly covered", covered=True, tilt=20.0),
    Condition("reflections", spots=8, tilt=20.0),
)


def layout(pattern: BoardPattern) -> Board:
    """The same board as the library knows it."""
    sizes = {name: getattr(pattern, name) or None for name in ("square", "marker", "spacing", "diameter")}
    dictionary = pattern.dictionary if pattern.marker else None
    return Board(pattern.kind, pattern.columns, pattern.rows, dictionary=dictionary, **sizes)  # type: ignore[arg-type]


def _pose(pattern: BoardPattern, condition: Condition, rng: np.random.Generator) -> Array:
    left, top, right, bottom = pattern.sheet()
    around = rng.uniform(0, 2 * np.pi)
    lean = rotation(np.radians([condition.tilt * np.cos(around), condition.tilt * np.sin(around), 0.0]))
    turn = lean @ rotation([0.0, 0.0, np.radians(rng.uniform(-25, 25))])
    middle = np.array([0.5 * (left + right), 0.5 * (top + bottom), 0.0])
    return frame(turn, np.array([*rng.uniform(-0.02, 0.02, 2), condition.distance]) - turn @ middle)


def _light(condition: Condition, rng: np.random.Generator) -> BoardLight:
    light = condition.light
    if condition.covered:
        x, y = rng.uniform(200, 440), rng.uniform(150, 330)
        side = 1 if rng.random() < 0.5 else -1
        hand = np.array([[x, y], [x + side * 60, y - 30], [x + side * 500, y - 120], [x + side * 500, y + 200]])
        light = replace(light, covers=(hand,))
    spots = tuple(
        Spot(
            (rng.uniform(120, 520), rng.uniform(90, 390)),
            rng.uniform(0.2, 0.9),
            (rng.uniform(2, 14), rng.uniform(2, 14)),
            rng.uniform(0, np.pi),
        )
        for _ in range(condition.spots)
    )
    return replace(light, spots=spots)


def _projected(pattern: BoardPattern, camera: TrueCamera, pose: Array, places: Array) -> Array:
    points = np.column_stack([places, np.zeros(len(places))]) @ pose[:3, :3].T + pose[:3, 3]
    return camera.project_unchecked(points)


def _noise(condition: Condition) -> NoiseModel:
    """Variance of grey values at the black level, and its growth."""
    sensor = Sensor(full_well=condition.full_well)
    per_light = 255.0
    read = (sensor.read_noise / sensor.full_well * per_light) ** 2 + 1 / 12
    return NoiseModel(read, per_light / sensor.full_well, sensor.black_level * per_light)


def _gain(camera: TrueCamera, condition: Condition, xy: Array) -> Array:
    """Light (n,) at pixels (n, 2) by that in the middle."""
    share = xy / (camera.width - 1, camera.height - 1) - 0.5
    return camera.relative_brightness(xy) * (1 + share @ condition.light.gradient)


def corner_bounds(pattern: BoardPattern, camera: TrueCamera, pose: Array, condition: Condition) -> Array:
    """(t, 2, 2) bounds of all corners."""
    marks = pattern.marks()
    reach = 0.5 * (pattern.square or pattern.spacing)
    step = 1e-5
    at = _projected(pattern, camera, pose, marks)
    axes = [(_projected(pattern, camera, pose, marks + step * np.eye(2)[k]) - at) / step for k in range(2)]
    light, noise, gain = condition.light, _noise(condition), _gain(camera, condition, at)
    bounds = np.empty((len(marks), 2, 2))
    for k in range(len(marks)):
        jacobian = np.stack([axes[0][k], axes[1][k]], axis=1)
        half = int(np.ceil(np.abs(jacobian).sum(axis=1).max() * reach)) + 1
        offset = np.arange(-half, half + 1.0)
        x, y = (v.ravel() for v in np.meshgrid(offset, offset))
        q = np.linalg.inv(jacobian) @ (np.stack([x, y]) - (at[k] - np.rint(at[k]))[:, None])
        own = (np.abs(q) < reach).all(axis=0)
        normals = [np.array([-axes[1][k][1], axes[1][k][0]]), np.array([-axes[0][k][1], axes[0][k][0]])]
        angles = [np.arctan2(n[1], n[0]) for n in normals]
        shape = np.array([[*(at[k] - np.rint(at[k])), *angles, 0.5 * np.log(condition.psf**2 + 1 / 12)]])
        profile, by_shape = blurred_corner(shape, np.zeros((1, 2)), x[None, own], y[None, own])
        level = 255 * (0.5 * gain[k] * (light.white + light.black) + 0.012)
        amplitude = 255 * 0.5 * gain[k] * (light.white - light.black)
        columns = np.column_stack([amplitude * by_shape[0].T, np.ones(own.sum()), profile[0]])
        weight = 1.0 / noise.at(level + amplitude * profile[0])
        bounds[k] = np.linalg.inv((columns * weight[:, None]).T @ columns)[:2, :2]
    return bounds


def circle_bounds(semi_axes: Array, angle: Array, gain: Array, condition: Condition) -> Array:
    """(n, 2, 2) bounds of circles with these images; ``gain`` (n,) of the light there."""
    light, noise = condition.light, _noise(condition)
    return np.array(
        [
            centre_bound(
                (a[0], a[1]),
                float(t),
                condition.psf,
                255 * g * (light.black - light.white),
                255 * (g * light.white + 0.012),
                noise,
            )
            for a, t, g in zip(semi_axes, angle, gain, strict=True)
        ]
    )


def opencv_corners(image: NDArray[np.uint8], true: Array, reach: float) -> list[Array]:
    """``cornerSubPix`` with a window of 5 px, and with the largest that sees no other corner."""
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    results = []
    for half in (5, max(2, int(0.7 * reach))):
        start = np.rint(true).astype(np.float32).reshape(-1, 1, 2)
        found = cv2.cornerSubPix(image, start, (half, half), (-1, -1), criteria)
        results.append(np.asarray(found, dtype=float).reshape(-1, 2))
    return results


def opencv_circles(image: NDArray[np.uint8], pattern: BoardPattern) -> Array | None:
    """``findCirclesGrid`` with its defaults."""
    symmetric = pattern.kind == "circles"
    flags = cv2.CALIB_CB_SYMMETRIC_GRID if symmetric else cv2.CALIB_CB_ASYMMETRIC_GRID
    found, centres = cv2.findCirclesGrid(image, (pattern.columns, pattern.rows), flags=flags)
    return np.asarray(centres, dtype=float).reshape(-1, 2) if found else None


@dataclass
class Score:
    """Sums over the images of a row."""

    visible: int = 0
    found: int = 0
    wrong: int = 0
    seconds: float = 0.0
    images: int = 0

    def __post_init__(self) -> None:
        self.ratios: list[Array] = []
        self.errors: list[Array] = []
        self.nees: list[Array] = []
        self.raw: list[Array] = []
        self.theirs: list[list[Array]] = [[], []]


def score_image(score: Score, pattern: BoardPattern, condition: Condition, seed: int) -> None:
    """Adds one image."""
    rng = np.random.default_rng(seed)
    camera = replace(CAMERA, psf_px=condition.psf, sensor=Sensor(full_well=condition.full_well))
    pose = _pose(pattern, condition, rng)
    picture = render_board(pattern, camera, pose, _light(condition, rng), seed=seed)
    begin = time.process_time()
    found = find_board(picture.image, layout(pattern))
    score.seconds += time.process_time() - begin
    score.images += 1
    score.visible += int(picture.visible.sum())
    error = found.xy - picture.xy[found.code]
    wrong = np.linalg.norm(error, axis=1) > 1.0
    score.wrong += int(wrong.sum())
    score.found += int((picture.visible[found.code] & ~wrong).sum())
    if len(found) == 0:
        return
    if pattern.diameter:
        _score_circles(score, pattern, condition, camera, pose, picture, found, error)
        return
    bound = np.sqrt(np.trace(corner_bounds(pattern, camera, pose, condition), axis1=1, axis2=2) / 2)
    score.ratios.append(error / bound[found.code, None])
    score.errors.append(error)
    score.nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error) / 2)
    scale = np.sqrt(abs(np.linalg.det(pose[:3, :3]))) * camera.fx / pose[2, 3] * np.cos(np.radians(condition.tilt))
    theirs = opencv_corners(picture.image, picture.xy[found.code], scale * 0.5 * (pattern.square or pattern.spacing))
    for k, places in enumerate(theirs):
        score.theirs[k].append((places - picture.xy[found.code]) / bound[found.code, None])


def _score_circles(
    score: Score,
    pattern: BoardPattern,
    condition: Condition,
    camera: TrueCamera,
    pose: Array,
    picture: BoardImage,
    found: Detections,
    error: Array,
) -> None:
    known = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.k1)
    marks = pattern.marks()[found.code]
    centre = np.column_stack([marks, np.zeros(len(marks))]) @ pose[:3, :3].T + pose[:3, 3]
    normal = np.tile(-pose[:3, 2], (len(centre), 1))
    shift = centre_shift(known, centre, normal, np.full(len(centre), 0.5 * pattern.diameter))
    bound = np.sqrt(
        np.trace(
            circle_bounds(found.semi_axes, found.angle, _gain(camera, condition, found.xy), condition), axis1=1, axis2=2
        )
        / 2
    )
    score.raw.append(error / bound[:, None])
    error = error - shift
    score.ratios.append(error / bound[:, None])
    score.errors.append(error)
    score.nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error) / 2)
    theirs = opencv_circles(picture.image, pattern)
    if theirs is not None:
        nearest = np.linalg.norm(theirs[None] - picture.xy[found.code][:, None], axis=2).argmin(axis=1)
        score.theirs[0].append((theirs[nearest] - picture.xy[found.code]) / bound[:, None])


def _rms(parts: list[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) if parts else float("nan")


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=4, help="per kind and condition")
    parser.add_argument("--kinds", default=",".join(PATTERNS), help="comma-separated")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    total = wrong = 0
    print("board              condition            seen  found wrong |  ours  raw  OpenCV |  bias px  nees  s/image")
    for kind in arguments.kinds.split(","):
        for number, condition in enumerate(CONDITIONS):
            score = Score()
            for k in range(arguments.images):
                score_image(score, PATTERNS[kind], condition, 1000 * number + k)
            total, wrong = total + score.found + score.wrong, wrong + score.wrong
            errors = np.concatenate(score.errors) if score.errors else np.full((1, 2), np.nan)
            nees = np.concatenate(score.nees).mean() if score.nees else np.nan
            theirs = min((_rms(part) for part in score.theirs if part), default=float("nan"))
            print(
                f"{kind:18s} {condition.name:19s} {score.visible:5d} {score.found / max(score.visible, 1):6.1%}"
                f" {score.wrong:5d} | {_rms(score.ratios):5.2f} {_rms(score.raw):5.1f} {theirs:6.2f} |"
                f" {np.abs(errors.mean(axis=0)).max():8.4f} {nees:5.2f} {score.seconds / score.images:7.2f}",
                flush=True,
            )
    print(f"{total} marks, {wrong} with a wrong id")


if __name__ == "__main__":
    main()
