"""Real recordings of a UR10: what the diagnosis finds in each series, and whether its predictions know their errors.

The normalised error at kept-out poses is the position error over its predicted covariance, root mean square per
coordinate: one if the covariance holds. First with the parameters alone, then with the scatter of the joints that the
diagnosis estimates for what it leaves unexplained.

Usage: ``python -m benchmarks.real_ur10_diagnosis FOLDER [--series abcd]``; FOLDER as for :mod:`benchmarks.real_ur10`.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from benchmarks.real_ur10 import read_chain, read_series
from benchmarks.robots import table
from robcal import transforms as tf
from robcal.calibration.identification import identify
from robcal.calibration.observations import FrameObservations
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Diagnosis
from robcal.diagnosis.diagnose import diagnose
from robcal.robot.kernel import Kernel


def recording(q: np.ndarray, T: np.ndarray, C: np.ndarray, rows: np.ndarray) -> tuple[Recording, FrameObservations]:
    """Some poses of a series as the diagnosis takes them; without approach directions, which were not recorded."""
    frames = FrameObservations(np.arange(len(rows)), T[rows], C[rows])
    covariates = {"index": rows.astype(float)}
    return Recording(q[rows], (None,) * len(rows), covariates, tuple(f"row {i}" for i in rows), frames), frames


def normalised(reported: Diagnosis, kept_out: Recording, measured: FrameObservations) -> tuple[float, float, float]:
    """Normalised error without and with the scatter of the joints, and the median of the latter against its median."""
    kernel = Kernel(reported.model, "converged")
    inputs = kept_out.inputs(kernel)
    columns = np.array([kernel.index[name] for name in reported.free])
    T, J = kernel.frames_and_jacobian(kernel.theta0, inputs, columns)
    moved = reported.joint_sigma * kernel.joint_jacobian(kernel.theta0, inputs)
    error = (tf.invert(T) @ measured.world_T_tool)[:, :3, 3]
    known = J @ reported.covariance @ J.swapaxes(1, 2) + measured.covariance * reported.noise_estimated**2
    out = []
    for V in (known, known + moved @ moved.swapaxes(1, 2)):
        square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(V[:, :3, :3]), error)
        out.append(float(np.sqrt(np.mean(square) / 3.0)))
    return out[0], out[1], float(np.sqrt(np.median(square) / 2.366))


def main() -> None:
    """Print the table and the statements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--series", default="abcd")
    options = parser.parse_args()
    model = read_chain(options.folder / "robot.yaml")
    own = {f"{joint.name}.elastic_{joint.joint_kind}" for joint in model.joints}
    rows: list[list[object]] = []
    for series in options.series:
        q, T, C, inside = read_series(options.folder / f"series_{series}")
        (train, frames), (kept_out, measured) = (recording(q, T, C, np.flatnonzero(mask)) for mask in (inside, ~inside))
        clock = time.process_time()
        kernel = Kernel(model)
        found = identify(model, kernel.poses(train.q), [frames], kernel=kernel)
        tied = (*found.eliminated, *(n for n in found.rejected_elasticities if n in own))
        across = tuple(n for n in found.names if ".elastic_" in n and n not in own)
        reported = diagnose(found.model, train, found.names, tied, kept_out, optional=across)
        seconds = time.process_time() - clock
        before, after, _ = (1e3 * v for v in reported.heldout)
        rows.append(
            [
                series.upper(),
                len(train.q),
                len(kept_out.q),
                before,
                after,
                1e6 * reported.joint_sigma,
                *normalised(reported, kept_out, measured),
                seconds,
            ]
        )
        print(f"Series {series.upper()}:")
        for finding in reported.findings:
            mm = " -> ".join(f"{1e3 * v:.3f}" for v in finding.heldout)
            print(f"  {finding.statement}; kept-out error {mm} mm")
    table(
        "UR10: diagnosis of each series; RMS position error at its kept-out poses, and normalised by its prediction",
        [
            "series",
            "poses",
            "kept out",
            "identified mm",
            "diagnosed mm",
            "joint scatter urad",
            "normalised, parameters",
            "+ scatter",
            "median of it",
            "CPU s",
        ],
        rows,
    )


if __name__ == "__main__":
    main()
