"""The search for slips: every alternative reading is tried, and told only if it mends the miss."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from robcal.calibration.observations import FrameObservations, Observations
from robcal.calibration.slips.joints import chain_trials, joint_trials
from robcal.calibration.slips.measured import measured_trials, mirror_trials
from robcal.calibration.slips.recorded import Recorded, Slip, Trial, as_frames, miss, workspace
from robcal.calibration.slips.rows import row_trials, stray_rows
from robcal.calibration.slips.zeros import deviating
from robcal.robot.kernel import PoseInputs
from robcal.robot.model import RobotModel

SUSPICIOUS_SHARE = 0.003
"""Share of the size of the workspace that a nominal robot may miss before anything is suspected."""
ACCEPTED_SHARE = 0.02
"""Share of the size of the workspace that a nominal robot may miss after mending."""
PROOF = 0.25
"""A slip is told if mending it lowers the miss below this share, and to what nominal robots miss."""
FEWEST_POSES = 8
"""Fewer poses fit too many explanations."""
SCREENED = 24
"""Poses that alternatives are screened with."""
CONVINCING = 0.03
"""A slip that lowers the miss below this share ends the search; others are compared with what may explain more."""
AMBIGUOUS = 1.3
"""Alternatives that miss by no more than this factor of the best are candidates as well."""


def find_slips(
    model: RobotModel, poses: PoseInputs, observations: Sequence[Observations], share: float = SUSPICIOUS_SHARE
) -> list[Slip]:
    """Slips that explain why the nominal robot misses the measurements by far; best explanation first.

    ``share`` of the workspace that the nominal robot may miss before anything is suspected; zero looks in any case.
    Empty if the nominal robot fits as robots do, or if nothing known mends the miss. More than one: the data cannot
    tell which.
    """
    if len(poses) < FEWEST_POSES:
        return []
    recorded = Recorded.of(model, poses, as_frames(observations))
    before = miss(recorded)
    plain = replace(recorded, observations=tuple(observations))
    suspicious = share <= 0 or before >= max(2e-3, share * workspace(recorded))
    fast = any(isinstance(o, FrameObservations) for o in recorded.observations)
    found: list[Slip] = []
    for group in _groups(recorded, plain, before, fast, suspicious):
        found += group()
        if any(slip.rms_after < CONVINCING * slip.rms_before for slip in found):
            break
    found.sort(key=lambda slip: slip.rms_after)
    return [slip for slip in found if slip.rms_after <= AMBIGUOUS * found[0].rms_after]


def _groups(
    recorded: Recorded, plain: Recorded, before: float, fast: bool, suspicious: bool
) -> Iterator[Callable[[], list[Slip]]]:
    """The searches, simple slips first: ``fast`` where frames give base and tool in closed form."""
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
    if fast and suspicious and np.isfinite(before):
        yield lambda: deviating(few, before, as_robots_do(recorded))


def as_robots_do(recorded: Recorded) -> float:
    """What a nominal robot of this size may miss, m."""
    return max(2e-3, ACCEPTED_SHARE * workspace(recorded))


def _spread(recorded: Recorded, fast: bool) -> Recorded:
    n = len(recorded.poses)
    if n <= SCREENED or not fast:
        return recorded
    return recorded.subset(np.unique(np.linspace(0, n - 1, SCREENED).astype(np.int64)))


def _proved(trials: Iterator[Trial], recorded: Recorded, few: Recorded, unmended: Recorded | None = None) -> list[Slip]:
    """Trials that mend the miss: of a few poses first, then of all."""
    before = {robust: miss(unmended or recorded, robust) for robust in (True, False)}
    told: list[Slip] = []
    for trial in trials:
        if few is not recorded and miss(trial.mend(few), trial.robust) > 2.0 * PROOF * before[trial.robust]:
            continue
        whole = before[trial.robust]
        mended = trial.mend(recorded)
        after = miss(mended, trial.robust)
        if after < min(PROOF * whole, as_robots_do(mended)):
            proof = f"{trial.words}: mending it lowers the miss of the nominal robot from {1e3 * whole:.3g} mm to "
            text = f"{proof}{1e3 * after:.3g} mm"
            told.append(Slip(trial.kind, trial.where, text, trial.remedy, whole, after, {}))
    return told


def mirror_misses(model: RobotModel, poses: PoseInputs, observations: Sequence[Observations]) -> tuple[float, float]:
    """Miss (m) of the nominal robot with the measurements as they are, and with their mirror image."""
    plain = Recorded.of(model, poses, observations)
    mirrored = [miss(trial.mend(plain)) for trial in mirror_trials(plain)]
    return miss(replace(plain, observations=as_frames(observations))), min(mirrored, default=np.inf)
