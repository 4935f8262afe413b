"""Real recordings: is what the report says what the user gets? A campaign folder each, as ``pipeline run`` takes it.

Errors at the kept-out poses, mm RMS of the distances: of the nominal robot in its best cell and of the identified one
without diagnosis (as reported), of what ``pipeline predict`` delivers for the campaign's own table of poses, computed
here from the recorded numbers alone, and of what the report promises. Coordinates of targets that nobody stated are
the medians over the poses that are not kept out.

Usage: ``python -m benchmarks.real_recordings CAMPAIGN ... [--keep FOLDER]``. Folders that are not there are skipped.
"""

import argparse
import csv
import json
import tempfile
from pathlib import Path

import numpy as np
import yaml

from benchmarks.realistic import pipeline
from benchmarks.robots import table
from robcal import transforms as tf

POSITION, ANGLES = ("x_mm", "y_mm", "z_mm"), ("roll_deg", "pitch_deg", "yaw_deg")


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a table by the names of its columns."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def numbers(rows: list[dict[str, str]], names: tuple[str, ...]) -> np.ndarray:
    """Columns (n, k) of a table."""
    return np.array([[float(row[name]) for name in names] for row in rows])


def misses(campaign: Path, predicted: Path) -> np.ndarray:
    """Distances (m,) in mm between what was measured at kept-out poses and what a table of frames predicts there."""
    frames = {row["pose"]: row for row in rows_of(predicted)}
    kept_out = {row["pose"] for row in rows_of(campaign / "poses.csv") if row.get("set") == "verify"}
    points = campaign / "points.csv"
    measured = [r for r in rows_of(points if points.is_file() else campaign / "frames.csv") if r["pose"] in frames]
    at = [frames[row["pose"]] for row in measured]
    p, t = numbers(measured, POSITION), numbers(at, POSITION)
    away = np.array([row["pose"] in kept_out for row in measured])
    error = p - t
    if points.is_file():
        R = tf.frame_from_xyzrpy(np.concatenate([t, np.deg2rad(numbers(at, ANGLES))], axis=1))[:, :3, :3]
        local = np.einsum("nji,nj->ni", R, error)
        targets = np.array([row["target"] for row in measured])
        for target in np.unique(targets):
            own = targets == target
            place = np.median(local[own & ~away], axis=0)
            error[own] -= R[own] @ place
    return np.asarray(np.linalg.norm(error[away], axis=1))


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def run_one(campaign: Path, scratch: Path) -> list[object]:
    """One row of the table.

    Raises
    ------
    RuntimeError : a command failed; with its last message.
    """
    name = campaign.name
    bare = {**yaml.safe_load((campaign / "campaign.yaml").read_text()), "diagnosis": {"enabled": False}}
    copy = scratch / f"{name}_campaign"
    copy.mkdir(parents=True, exist_ok=True)
    for file in campaign.iterdir():
        if file.name != "campaign.yaml" and not (copy / file.name).exists():
            (copy / file.name).symlink_to(file.resolve())
    bare["robot"] = str((campaign / bare["robot"]).resolve())
    (copy / "campaign.yaml").write_text(yaml.safe_dump(bare))
    for folder, run in ((copy, scratch / f"{name}_plain"), (campaign, scratch / name)):
        _command("run", folder, "--out", run)
    predicted = scratch / f"{name}.csv"
    _command("predict", scratch / name, "--poses", campaign / "poses.csv", "--out", predicted)
    plain, full = (json.loads((scratch / r / "result.json").read_text()) for r in (f"{name}_plain", name))
    told = full["verification"]
    causes = len(full.get("diagnosis", {}).get("causes", []))
    return [
        name,
        told["poses"],
        told["nominal"]["0"]["rms"],
        plain["verification"]["delivered"]["rms"],
        rms(misses(campaign, predicted)),
        told["delivered"]["rms"],
        causes,
        full["verdict"]["grade"],
    ]


def _command(*arguments: str | Path) -> None:
    code, message = pipeline(*arguments)
    if code:
        raise RuntimeError(f"{' '.join(map(str, arguments))}: {message}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaigns", type=Path, nargs="+")
    parser.add_argument("--keep", type=Path, help="folder for the runs")
    options = parser.parse_args()
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory(prefix="real-recordings-") as scratch:
        for campaign in options.campaigns:
            if not (campaign / "campaign.yaml").is_file():
                print(f"{campaign}: not there, skipped")
                continue
            rows.append(run_one(campaign.resolve(), options.keep or Path(scratch)))
    if rows:
        table(
            "Real recordings: RMS error at kept-out poses, mm",
            ["recording", "kept out", "nominal", "identified", "delivered", "as reported", "causes", "verdict"],
            rows,
        )


if __name__ == "__main__":
    main()
