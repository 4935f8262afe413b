"""`drift add` killed at random moments: is anything lost or doubled?

``python -m benchmarks.drift_kills [--kills 300] [--seed 0]`` takes ten files of readings in, one after the other, in
child processes that are killed (SIGKILL) after a random time, up to somewhat more than an undisturbed run takes; a
file is given again until a child has ended by itself, at most three kills a file. At the end of each round of ten
files the whole content of the state (readings and their use, models with covariances, alarms, what is in force) is
compared with that of an undisturbed state. A child starts as a copy of a process that has everything loaded, so that
kills hit the work and not the start of Python.
"""

import argparse
import os
import shutil
import signal
import sqlite3
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.drift import Cell
from pipeline.artifacts import CALIBRATED
from pipeline.drift.actions import add, start
from pipeline.json_io import write_json
from pipeline.runs import Run, StageRecord, run_file
from robcal.drift.reference import Readings

QUERIES = (
    "select cycle, pose, target, time_s, content, use from drift_reading order by 1, 2, 3",
    "select version, cycle, time_s, change, covariance from drift_model order by 1",
    "select cycle, version, reason from drift_in_force order by id",
    "select cycle, kind, text from drift_alarm order by id",
)
MOST_PER_FILE = 3


def content(state: Path) -> list[list[tuple[Any, ...]]]:
    """Everything that must not depend on how it came in, without times of writing."""
    with sqlite3.connect(state) as connection:
        return [connection.execute(query).fetchall() for query in QUERIES]


def write_readings(path: Path, tour: Readings, rows: Sequence[int]) -> Path:
    """Some rows of a tour as a table."""
    lines = ["cycle,time_s,pose,target,x_mm,y_mm,z_mm,sigma_mm," + ",".join(f"q{k}_deg" for k in range(1, 7))]
    for i in rows:
        row = [str(tour.cycle[i]), f"{tour.time[i]:.3f}", tour.pose[i], str(tour.target[i])]
        row += [f"{1e3 * v:.6f}" for v in tour.x[i]] + ["0.03"]
        lines.append(",".join(row + [f"{v:.9f}" for v in np.degrees(tour.inputs.q[i])]))
    path.write_text("\n".join(lines) + "\n")
    return path


def make_files(folder: Path, seed: int) -> tuple[Path, list[Path]]:
    """A state that knows the reference alone, and ten files: tours of a warming robot, each in two halves."""
    cell = Cell(seed, 24)
    time_s = np.arange(0, 3601, 600.0)
    deviations = cell.warming.deviations(cell.true, cell.heat(time_s, np.ones(len(time_s))), np.arange(len(time_s)))
    still = np.zeros(3), np.zeros(6)
    tours = [cell.tour(deviations[k], k, t, cell.q, *still) for k, t in enumerate(time_s)]
    run = Run(folder / "run")
    write_json(run_file(run), {"format": "robcal/run-1", "campaign": str(folder / "none")})
    run.save(CALIBRATED, cell.robot)
    run.write_record(StageRecord("diagnose", "key", {}, {}))
    reference = write_readings(folder / "reference.csv", tours[0], range(24))
    start(folder / "run", reference, folder / "cell.drift")
    halves = [(k, list(range(h, 24, 2))) for k in range(1, 6) for h in (0, 1)]
    return folder / "cell.drift", [
        write_readings(folder / f"c{n:02d}.csv", tours[k], rows) for n, (k, rows) in enumerate(halves)
    ]


def child_adds(state: Path, file: Path, kill_after: float | None) -> bool:
    """Take a file in within a child; true if a kill hit it while it worked."""
    pid = os.fork()
    if pid == 0:
        try:
            add(state, file)
        except BaseException:  # the child must not go on as a second parent
            os._exit(1)
        os._exit(0)
    if kill_after is not None:
        time.sleep(kill_after)
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    if os.WIFEXITED(status) and os.WEXITSTATUS(status):
        raise RuntimeError(f"adding {file.name} failed: run 'pipeline drift add' on it to see why")
    return os.WIFSIGNALED(status)


def main() -> None:
    """Print what became of the states."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    hit = rounds = spoiled = 0
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        empty, files = make_files(folder, chosen.seed)
        whole = Path(shutil.copy(empty, folder / "whole.drift"))
        begin = time.perf_counter()
        for file in files:
            child_adds(whole, file, None)
        usual = (time.perf_counter() - begin) / len(files)
        expected = content(whole)
        while hit < chosen.kills:
            state = Path(shutil.copy(empty, folder / "state.drift"))
            for leftover in folder.glob("state.drift-*"):
                leftover.unlink()
            for file in files:
                for _ in range(MOST_PER_FILE):
                    hit += child_adds(state, file, float(rng.uniform(0.0, 1.3 * usual)))
                child_adds(state, file, None)
            rounds += 1
            spoiled += content(state) != expected
    readings = len(expected[0])
    print(f"{hit} kills of a 'drift add' of {1e3 * usual:.0f} ms, {rounds} rounds of {len(files)} files each")
    print(f"states that differ from an undisturbed one ({readings} readings, {len(expected[1])} models): {spoiled}")


if __name__ == "__main__":
    main()
