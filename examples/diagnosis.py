"""Which physics does the model lack? A robot with backlash in one axis, and what its recording says of it."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import robcal
from examples.robot_from_tracker import LOADS
from fixtures.campaigns import make_campaign


def main() -> tuple[str, ...]:
    """Diagnose; returns a sentence for every cause found."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        make_campaign(folder, robot="kr150", level="frames", effects=["backlash"], poses=60, verify=15, seed=5)
        model = replace(robcal.read_any_robot(folder / "robot.yaml"), payloads=LOADS)
        log = robcal.read_joint_log(folder / "poses.csv", model)
        recording = robcal.read_recording(folder / "frames.csv", log)

    found = robcal.identify_robot(model, log, recording)
    result = robcal.diagnose_robot(found, log)
    if result is None:
        return ()
    before, after, floor = (1e3 * value for value in result.diagnosis.heldout)
    for finding in result.diagnosis.findings:
        print(finding.statement)
    print(f"kept-out poses: {before:.3f} mm before, {after:.3f} mm after, noise {floor:.3f} mm")
    return tuple(finding.statement for finding in result.diagnosis.findings)


if __name__ == "__main__":
    main()
