"""Hand-eye calibration against the truth, an oracle that knows the noise, and OpenCV's methods on the same marks.

``python -m benchmarks.hand_eye [--seeds 200] [--workers 2]`` prints the tables of docs/results.md. OpenCV's methods are
compared where its Python module has them: 4.x does (``pip install --target DIR 'opencv-contrib-python-headless<5'`` and
DIR first in PYTHONPATH), 5.0 does not.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from scipy import stats

from fixtures.hand_eye import Scene, exchanged, place, scene, turn
from robcal.errors import NotIdentifiable
from robcal.handeye.calibration import Options, calibrate
from robcal.handeye.data import HandEyeData
from robcal.handeye.problem import Problem
from robcal.handeye.result import HandEye
from robcal.handeye.unknowns import Layout, State, Variances
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.transforms import Array, difference, frame, invert

METHODS = (
    {}
    if not hasattr(cv2, "calibrateHandEye")
    else {
        "Tsai": cv2.CALIB_HAND_EYE_TSAI,
        "Park": cv2.CALIB_HAND_EYE_PARK,
        "Horaud": cv2.CALIB_HAND_EYE_HORAUD,
        "Andreff": cv2.CALIB_HAND_EYE_ANDREFF,
        "Daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
    }
)
POSES, SIGMA_PX = 30, 0.1
ROBOTS = {"0.1 mm, 0.01 deg": (1e-4, np.radians(0.01)), "exact": (0.0, 0.0), "2 mm, 0.2 deg": (2e-3, np.radians(0.2))}


@dataclass(frozen=True)
class Outcome:
    """Errors (6,) of the camera's frame (m, rad) by method, ours in standard deviations, seconds."""

    error: dict[str, Array]
    normalised: Array
    statistic: float
    seconds: dict[str, float]


def data_of(seen: Scene) -> HandEyeData:
    """What is known of a scene: marks, flanges as commanded, the board, and a blank camera of the image's size."""
    body = Body("board", np.arange(len(seen.board)), seen.board)
    covariance = np.broadcast_to(seen.sigma_px**2 * np.eye(2), (len(seen.image), 2, 2)).copy()
    camera = Camera.from_size(seen.lens.width, seen.lens.height)
    return HandEyeData(camera, seen.mounted, seen.commanded, body, seen.image, seen.target, seen.xy, covariance)  # type: ignore[arg-type]


def oracle(data: HandEyeData, seen: Scene, scatter: tuple[float, float]) -> Array:
    """Maximum likelihood with the true noise, started at the truth: camera frame (4, 4)."""
    lens = seen.lens
    true = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    none = np.zeros(data.n, dtype=np.int64)
    layout = Layout(none, none, np.arange(9), np.zeros(0, dtype=np.int64))
    problem = Problem(data, layout, np.ones(len(data.image), dtype=bool))
    start = State(true, seen.X[None], seen.Z[None], np.zeros(4), np.zeros(0), np.zeros((data.n, 6)))
    return problem.solve(start, Variances(1.0, *scatter)).state.X[0]


def opencv(seen: Scene) -> tuple[dict[str, Array], dict[str, float]]:
    """Camera frames by OpenCV: its camera calibration, then each of its five methods; and their seconds."""
    clock = time.perf_counter()
    rows = [np.flatnonzero(seen.image == i) for i in range(len(seen.commanded))]
    use = [i for i, r in enumerate(rows) if len(r) >= 6]
    points = [seen.board[seen.target[rows[i]]].astype(np.float32) for i in use]
    pixels = [seen.xy[rows[i]].astype(np.float32) for i in use]
    size = (seen.lens.width, seen.lens.height)
    _, _, _, turns, shifts = cv2.calibrateCamera(points, pixels, size, None, None)  # type: ignore[call-overload]
    views = np.array([frame(cv2.Rodrigues(r)[0], np.ravel(t)) for r, t in zip(turns, shifts, strict=True)])
    A = seen.commanded[use] if seen.mounted == "hand" else invert(seen.commanded[use])
    before = time.perf_counter() - clock
    out, seconds = {}, {}
    for name, method in METHODS.items():
        clock = time.perf_counter()
        try:
            R, t = cv2.calibrateHandEye(A[:, :3, :3], A[:, :3, 3], views[:, :3, :3], views[:, :3, 3], method=method)
            out[name] = frame(R, np.ravel(t)) if np.isfinite(R).all() else np.full((4, 4), np.nan)
        except cv2.error:
            out[name] = np.full((4, 4), np.nan)
        seconds[name] = before + time.perf_counter() - clock
    return out, seconds


def one(seed: int, mounted: str, scatter: tuple[float, float]) -> Outcome:
    """One scene by all methods; the lens is self-calibrated by all."""
    seen = scene(np.random.default_rng(seed), mounted, POSES, SIGMA_PX, scatter)
    data = data_of(seen)
    clock = time.perf_counter()
    found = calibrate(data, Options(start_camera=False))
    seconds = {"robcal": time.perf_counter() - clock}
    frames = {"robcal": found.X, "oracle": oracle(data, seen, scatter)}
    others, times = opencv(seen)
    error = {name: difference(seen.X, T) for name, T in (frames | others).items()}
    own = error["robcal"]
    statistic = float(own @ np.linalg.solve(found.covariance[:6, :6], own))
    return Outcome(error, own / found.sigma[:6], statistic, seconds | times)


def rms(outcomes: Sequence[Outcome], name: str) -> tuple[float, float]:
    """Root mean square of place (mm) and turn (deg)."""
    e = np.array([o.error[name] for o in outcomes])
    place = np.sqrt(np.mean(np.sum(e[:, :3] ** 2, axis=1)))
    angle = np.sqrt(np.mean(np.sum(e[:, 3:] ** 2, axis=1)))
    return 1e3 * float(place), float(np.degrees(angle))


def accuracy(seeds: int, run: Callable[[Callable[[int], Outcome], Sequence[int]], list[Outcome]]) -> None:
    """The table of accuracy and coverage."""
    print("| camera | robot | robcal | by oracle | coverage | 6-dim | best of OpenCV | its error | robcal / it | s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for robot, scatter in ROBOTS.items():
        for mounted in ("hand", "world"):
            outcomes = run(partial(one, mounted=mounted, scatter=scatter), range(seeds))
            own, best = rms(outcomes, "robcal"), rms(outcomes, "oracle")
            inside = np.mean(np.abs(np.array([o.normalised for o in outcomes])) <= stats.norm.ppf(0.975))
            region = np.mean([o.statistic <= stats.chi2.ppf(0.95, 6) for o in outcomes])
            theirs = {name: rms(outcomes, name) for name in METHODS} or {"-": (float("nan"), float("nan"))}
            place = min(theirs, key=lambda n: np.nan_to_num(theirs[n][0], nan=np.inf))
            angle = min(theirs, key=lambda n: np.nan_to_num(theirs[n][1], nan=np.inf))
            seconds = np.median([o.seconds["robcal"] for o in outcomes])
            second = np.median([o.seconds.get(place, np.nan) for o in outcomes])
            print(
                f"| {mounted} | {robot} | {own[0]:.3f} mm, {own[1]:.4f} deg | {own[0] / best[0]:.3f}, "
                f"{own[1] / best[1]:.3f} | {100 * inside:.1f} % | {100 * region:.1f} % | {place}, {angle} | "
                f"{theirs[place][0]:.3f} mm, {theirs[angle][1]:.4f} deg | {own[0] / theirs[place][0]:.2f}, "
                f"{own[1] / theirs[angle][1]:.2f} | {seconds:.1f} ({second:.1f}) |",
                flush=True,
            )


def told(seed: int, case: str, mounted: str) -> bool:
    """Whether a scene of a special kind is told rightly."""
    rng = np.random.default_rng(1000 + seed)
    push = place(turn(np.array([0, 0, 0.02])), np.array([0.003, 0.002, 0.0]))
    bump = (POSES // 2, push) if case == "board pushed by 3.6 mm" else None
    seen = scene(rng, mounted, 2 if case == "two poses" else POSES, SIGMA_PX, (1e-4, np.radians(0.01)), bump=bump)
    if case == "one axis":
        axis = np.eye(3)[seed % 3]
        spun = [
            seen.commanded[0] @ place(turn(a * axis), rng.uniform(-0.1, 0.1, 3)) for a in np.linspace(-0.8, 0.8, POSES)
        ]
        seen = replace(seen, commanded=np.array(spun))
    if case == "two images exchanged":
        seen = exchanged(seen, 4, 17)
    try:
        found = calibrate(data_of(seen), Options(start_camera=False))
    except NotIdentifiable as error:
        words = {"one axis": "about one direction only", "two poses": "three or more"}
        return case in words and words[case] in str(error)
    return _right(found, case)


def _right(found: HandEye, case: str) -> bool:
    if case == "two images exchanged":
        return found.moved is None and {r.image for r in found.rejected} == {4, 17}
    if case.startswith("board pushed"):
        return found.moved is not None and found.moved.kind == "board" and found.moved.image == POSES // 2
    return case == "nothing wrong" and found.moved is None and not found.rejected and not found.shape


CASES = ("nothing wrong", "one axis", "two poses", "board pushed by 3.6 mm", "two images exchanged")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", choices=["accuracy", "told"])
    given = parser.parse_args()
    with ProcessPoolExecutor(given.workers) as pool:

        def run(task: Callable, seeds: Sequence[int]) -> list:  # type: ignore[type-arg]
            return list(pool.map(task, seeds, chunksize=4))

        if given.only != "told":
            accuracy(given.seeds, run)
        if given.only != "accuracy":
            print("\n| case | in the hand | in the world |\n|---|---|---|")
            count = max(1, given.seeds // 8)
            for case in CASES:
                cells = [run(partial(told, case=case, mounted=m), range(count)) for m in ("hand", "world")]
                print(f"| {case} | " + " | ".join(f"{sum(c)} of {count}" for c in cells) + " |", flush=True)


if __name__ == "__main__":
    main()
