"""The search for faults: every alternative reading is tried, and reported only if it corrects the residual.

Faults of the recording that make a fit fail, reported with the proof: the residual before and after the correction.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.measurements import RobotRecording
from robcal.calibration.observations import DistanceObservations, FrameObservations, Observations, PointObservations
from robcal.calibration.recording_errors.joints import chain_trials, joint_trials
from robcal.calibration.recording_errors.measured import measured_trials, mirror_trials
from robcal.calibration.recording_errors.recorded import (
    Recorded,
    RecordingFault,
    Trial,
    as_frames,
    pose_residuals,
    residual_rms,
    trimmed,
    workspace,
)
from robcal.calibration.recording_errors.rows import row_trials, stray_rows
from robcal.calibration.recording_errors.zeros import deviating
from robcal.errors import InvalidInput
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel

SUSPICIOUS_SHARE = 0.003
"""Share of the size of the workspace that a nominal robot may miss before anything is suspected."""
ACCEPTED_SHARE = 0.02
"""Share of the size of the workspace that a nominal robot may miss after the correction."""
PROOF = 0.25
"""A fault is reported if correcting it lowers the residual below this share, and to what nominal robots miss."""
FEWEST_POSES = 8
"""Fewer poses fit too many explanations."""
SCREENED = 24
"""Poses that alternatives are screened with."""
CONVINCING = 0.03
"""A fault that lowers the residual below this share ends the search; others are compared with what may explain more."""
AMBIGUOUS = 1.3
"""Alternatives that miss by no more than this factor of the best are candidates as well."""


def _log_words(model: RobotModel) -> str:
    return "leg lengths" if model.is_hexapod else "joint angles"


def find_faults(
    model: RobotModel, poses: PoseInputs, observations: Sequence[Observations], share: float = SUSPICIOUS_SHARE
) -> list[RecordingFault]:
    """Faults that explain why the nominal robot misses the measurements by far; best explanation first.

    ``share`` of the workspace that the nominal robot may miss before anything is suspected; zero looks in any case.
    Empty if the nominal robot fits as robots do, or if nothing known corrects the residual. Several: the data cannot
    tell which.
    """
    if len(poses) < FEWEST_POSES:
        return []
    recorded = Recorded.of(model, poses, as_frames(observations))
    before = residual_rms(recorded)
    plain = replace(recorded, observations=tuple(observations))
    suspicious = share <= 0 or before >= max(2e-3, share * workspace(recorded))
    fast = any(isinstance(o, FrameObservations) for o in recorded.observations)
    found: list[RecordingFault] = []
    for group in _groups(recorded, plain, before, fast, suspicious):
        found += group()
        if any(fault.rms_after < CONVINCING * fault.rms_before for fault in found):
            break
    found.sort(key=lambda fault: fault.rms_after)
    return [fault for fault in found if fault.rms_after <= AMBIGUOUS * found[0].rms_after]


def _groups(
    recorded: Recorded, plain: Recorded, before: float, fast: bool, suspicious: bool
) -> Iterator[Callable[[], list[RecordingFault]]]:
    """The searches, simple faults first: ``fast`` where frames give base and tool in closed form."""
    few = _spread(recorded, fast)
    if suspicious:
        yield lambda: [
            *_proved(joint_trials(recorded, fast), recorded, few),
            *_proved(mirror_trials(plain), plain, _spread(plain, fast), recorded),
        ]
        yield lambda: _proved(row_trials(recorded), recorded, recorded)
        if fast:
            yield lambda: _proved(chain_trials(recorded), recorded, few)
        yield lambda: _proved(measured_trials(plain), plain, _spread(plain, fast))
    if fast:
        yield lambda: _proved(stray_rows(recorded), recorded, recorded)
    if fast and not suspicious:
        yield lambda: _proved_by_some(recorded)
    if fast and suspicious and np.isfinite(before):
        yield lambda: deviating(few, before, as_robots_do(recorded))


def _proved_by_some(recorded: Recorded) -> list[RecordingFault]:
    """Faults of joints that move in few poses only, as where one joint moves after the other: most poses fit as is."""
    residuals = pose_residuals(recorded)
    if not trimmed(residuals, 1.0) >= as_robots_do(recorded):
        return []
    spread = np.linspace(0, len(residuals) - 1, min(SCREENED, len(residuals))).astype(np.int64)
    worst = np.argsort(-np.nan_to_num(residuals))[:SCREENED]
    few = recorded.subset(np.unique(np.concatenate([spread, worst])))
    trials = (replace(trial, robust=False) for trial in chain(joint_trials(recorded, True), chain_trials(recorded)))
    return _proved(trials, recorded, few)


def as_robots_do(recorded: Recorded) -> float:
    """What a nominal robot of this size may miss, m."""
    return max(2e-3, ACCEPTED_SHARE * workspace(recorded))


def _spread(recorded: Recorded, fast: bool) -> Recorded:
    n = len(recorded.poses)
    if n <= SCREENED or not fast:
        return recorded
    return recorded.subset(np.unique(np.linspace(0, n - 1, SCREENED).astype(np.int64)))


def _proved(
    trials: Iterator[Trial], recorded: Recorded, few: Recorded, uncorrected: Recorded | None = None
) -> list[RecordingFault]:
    """Trials that correct the residual: of a few poses first, then of all."""
    before = {robust: residual_rms(uncorrected or recorded, robust) for robust in (True, False)}
    found: list[RecordingFault] = []
    for trial in trials:
        if few is not recorded and residual_rms(trial.correct(few), trial.robust) > 2.0 * PROOF * before[trial.robust]:
            continue
        whole = before[trial.robust]
        corrected = trial.correct(recorded)
        after = residual_rms(corrected, trial.robust)
        if after < min(PROOF * whole, as_robots_do(corrected)):
            proof = (
                f"{trial.words}: correcting it lowers the residual of the nominal robot from {1e3 * whole:.3g} mm to "
            )
            text = f"{proof}{1e3 * after:.3g} mm"
            found.append(RecordingFault(trial.kind, trial.where, text, trial.remedy, whole, after, {}))
    return found


def mirror_residuals(model: RobotModel, poses: PoseInputs, observations: Sequence[Observations]) -> tuple[float, float]:
    """Miss (m) of the nominal robot with the measurements as they are, and with their mirror image."""
    plain = Recorded.of(model, poses, observations)
    mirrored = [residual_rms(trial.correct(plain)) for trial in mirror_trials(plain)]
    return residual_rms(replace(plain, observations=as_frames(observations))), min(mirrored, default=np.inf)


FAILED = 10.0
"""sigma0 of the stated uncertainty above which a fit counts as failed."""
MOST_POSES = 300
MOST_NAMED = 4
"""Candidates that are listed where the data cannot tell which."""
HOPELESS, HOPELESS_SHARE = 0.01, 0.02
"""Miss (m, and as a share of the way of the tool) of an identified robot above which it is no robot's."""


def check_joint_log(
    robot: RobotModel, inputs: PoseInputs, recording: RobotRecording, kernel: Kernel
) -> list[RecordingFault]:
    """Refuse recordings in which joint angles and measurements do not belong together.

    Returns
    -------
    What the robot has every right to be (other zeros, another length) but its file does not say: to be reported.

    Raises
    ------
    InvalidInput : a fault explains the residual; the message gives the proof and the remedy, and all candidates.
    """
    _check_unit(inputs, recording, kernel)
    found = find_faults(robot, inputs, recording.observations)
    if found and not found[0].legitimate:
        raise InvalidInput(f"{_log_words(robot)} and measurements do not belong together: {described(found)}")
    return found


def check_failed_fit(
    robot: RobotModel, inputs: PoseInputs, recording: RobotRecording, kernel: Kernel, found: IdentifiedRobot
) -> None:
    """Where even the identified robot misses by many sigmas, look for smaller faults (a sign of the last joint, say).

    Raises
    ------
    InvalidInput : a fault that explains the residual was found (the message: proof, remedy), or the residual is
        beyond anything that a robot does.
    """
    if found.sigma0 < FAILED:
        return
    rows = np.arange(min(len(inputs), MOST_POSES))
    few = replace(recording, observations=recording.select(rows))
    fault = fault_of(robot, inputs.subset(rows), few, share=0.0)
    if fault:
        raise InvalidInput(f"{_log_words(robot)} and measurements do not belong together: {fault}")
    T = found.kernel.frames(found.kernel.theta0, inputs)
    residual = float(np.sqrt(np.mean(np.concatenate([o.evaluate(T)[0].ravel() ** 2 for o in recording.observations]))))
    size = float(np.linalg.norm(np.std(T[:, :3, 3], axis=0)))
    if residual > max(HOPELESS, HOPELESS_SHARE * size):
        raise InvalidInput(
            f"even the identified robot misses the measurements by {1e3 * residual:.3g} mm RMS: joint "
            "angles, robot file and measurements do not belong together, and no single fault (sign, unit, exchanged "
            "columns, shifted rows) explains it: check which recording belongs to which"
        )


def fault_of(robot: RobotModel, inputs: PoseInputs, recording: RobotRecording, share: float = SUSPICIOUS_SHARE) -> str:
    """The likeliest fault with proof and remedy; empty if there is none."""
    return described([s for s in find_faults(robot, inputs, recording.observations, share) if not s.legitimate])


def described(faults: Sequence[RecordingFault]) -> str:
    """Faults in a sentence: the likeliest with proof and remedy, then the others that explain as much."""
    if not faults:
        return ""
    others = [f"{fault.statement.split(': correcting')[0]} ({fault.remedy})" for fault in faults[1:MOST_NAMED]]
    also = f"; the recording alone cannot tell this from: {'; or '.join(others)}" if others else ""
    return f"{faults[0].statement}: {faults[0].remedy}{also}"


def _check_unit(inputs: PoseInputs, recording: RobotRecording, kernel: Kernel) -> None:
    """Coordinates in metres under a heading of millimetres: the measured ways are a thousandth of the robot's."""
    moved = kernel.with_references(np.eye(4), np.eye(4)).frames(kernel.theta0, inputs)[:, :3, 3]
    for o in recording.observations:
        if isinstance(o, FrameObservations):
            measured = o.world_T_tool[:, :3, 3]
        elif isinstance(o, PointObservations):
            measured = o.p_world
        elif isinstance(o, DistanceObservations):
            measured = o.distance[:, None]
        else:
            continue
        way, robot_way = float(np.std(measured, axis=0).max()), float(np.std(moved[o.pose], axis=0).max())
        if robot_way > 1e-3 and (way > 100 * robot_way or way < 0.01 * robot_way):
            raise InvalidInput(
                f"the measured coordinates scatter by {way * 1000:.3g} mm while the robot moved "
                f"by {robot_way * 1000:.3g} mm: columns _mm must be in millimetres, check the unit of the measurements"
            )
