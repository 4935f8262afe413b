"""A draw-wire alone: does the robot get as accurate at poses that nobody measured as the covariance says?

``python -m benchmarks.draw_wire [--seeds 20]``: 336 poses, 14 parameters beside the places of wire and tool, nothing
that the model does not know. Errors are those of the wire's point at 500 kept-out poses, in the wire's world (its turn,
which lengths do not tell, is held at the truth): root mean square of the nominal robot in its best cell, of the
identified one, and as predicted from the covariance.
"""

import argparse
import tempfile

import numpy as np

from benchmarks.instruments import instruments_in
from fixtures.instruments import Watcher, watch, write_watched
from fixtures.plan import Plan
from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import identify_instruments

MODEL = (
    *("axis2.x", "axis3.x", "axis4.x", "axis4.z", "axis5.y", "axis5.z", "axis2.pitch", "axis3.pitch", "axis5.pitch"),
    *("axis2.roll", "axis3.roll", "axis2.elastic_pitch", "axis3.elastic_pitch", "axis5.elastic_pitch"),
)
OPTIONS = IdentifyOptions(MODEL, statics="converged", covariance="stated")


def errors(seed: int) -> tuple[float, float, float, int]:
    """RMS errors (mm) at the kept-out poses: nominal, identified, predicted; and how many parameters were found."""
    plan = Plan(seed=seed, poses=336, verify=0, model=MODEL, kept_out=500)
    made = watch(plan, {"wire": Watcher("distances", sigma_mm=0.05)})
    with tempfile.TemporaryDirectory() as place:
        model, log, instruments = instruments_in(write_watched(place, made), made)
    placed = identify_instruments(model, log, instruments, OPTIONS).placed["wire"]
    robot = placed.robot
    assert robot is not None
    kept = made.truth.inside.poses
    true = made.truth.robot.replaced(
        world_T_base=made.world_T_base["wire"], flange_T_tool=made.flange_T_tool["wire"]
    ).world_T_tool(kept.q, kept.circumstances)[:, :3, 3]
    T, covariance = robot.predict(robot.kernel.poses(kept.q, kept.circumstances.payload))
    uncalibrated = robot.uncalibrated()
    nominal, _ = uncalibrated.predict(uncalibrated.kernel.poses(kept.q, kept.circumstances.payload))
    missed = [1e3 * float(np.sqrt(np.mean(np.sum((f[:, :3, 3] - true) ** 2, axis=1)))) for f in (nominal, T)]
    predicted = 1e3 * float(np.sqrt(np.mean(np.trace(covariance[:, :3, :3], axis1=1, axis2=2))))
    return *missed, predicted, len(set(robot.names) & set(MODEL))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    count = parser.parse_args().seeds
    print("seed  nominal  identified  predicted   ratio  parameters")
    rows = []
    for seed in range(count):
        nominal, found, predicted, parameters = errors(seed)
        rows.append((nominal, found, predicted))
        print(f"{seed:4d}  {nominal:7.3f}  {found:10.4f}  {predicted:9.4f}  {found / predicted:6.2f}  {parameters:6d}")
    square = np.mean(np.square(rows), axis=0)
    ratio = float(np.sqrt(square[1] / square[2]))
    print(f" all  {np.sqrt(square[0]):7.3f}  {np.sqrt(square[1]):10.4f}  {np.sqrt(square[2]):9.4f}  {ratio:6.2f}")


if __name__ == "__main__":
    main()
