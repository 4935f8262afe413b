"""What is left of a calibrated robot in three parts: measurement, scatter of the joints, lack of fit.

Pure error is what exact repetitions scatter by, whatever the model; lack of fit is what the model misses beyond it,
tested by the ratio of both variances (Draper and Smith 1998, Applied Regression Analysis, section 2.1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.calibration.identifiability import repetitions
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    Observations,
    PointObservations,
    SensorPointObservations,
)
from robcal.transforms import Array

Source = Literal["stated", "repeats", "lengths", "residuals", "none"]

LEVEL = 0.01
DISAGREE = 3.0
"""Factor between two figures of the measurement noise from which their disagreement is told."""
LARGE = 0.7
"""Share of a stated sigma below which residuals refute it: the model can only add to the noise."""
WRONG = 10.0
"""Factor from which a stated sigma is not believed."""
CLIP = 4.0
"""Robust standard deviations beyond which a length is a wrong one."""
FEWEST = 10
"""Degrees of freedom that a figure needs to count."""


@dataclass(frozen=True)
class NoiseParts:
    """RMS length of an error at the measured place, m.

    Attributes
    ----------
    measurement : of the measurement alone; source : where that comes from. stated : what the file states.
    joint_scatter : of a joint (rad), from repetitions alone; None without them.
    lack_of_fit : what the model misses beyond the repetitions (beyond the measurement where there are none).
    repeats : poses that repeat another one. p_value : of the lack of fit, None without repetitions.
    notes : disagreements, in words.
    dimensions : of the measured place, three but for distances.
    """

    measurement: float
    source: Source
    stated: float | None
    joint_scatter: float | None
    lack_of_fit: float
    repeats: int
    p_value: float | None
    notes: tuple[str, ...] = ()
    dimensions: int = 3

    @property
    def along(self) -> float:
        """Standard deviation of the measurement along a direction, m."""
        return self.measurement / float(np.sqrt(self.dimensions))


@dataclass(frozen=True)
class _Scatter:
    """Mean square (m2) of an error vector and its degrees of freedom."""

    square: float
    freedom: int


def noise_parts(
    q: Array,
    residuals: Array,
    parameters: int,
    observations: Sequence[Observations],
    *,
    stated: bool,
    lever: float,
    weighted: float = 1.0,
    left: float = 1.0,
) -> NoiseParts:
    """Split what is left of a robot.

    Parameters
    ----------
    q : (n, N) joint angles. residuals : (m, 3) errors of the positions (or (m, 1) of lengths) that `observations`
        measured, in their order, m.
    parameters : number of fitted parameters. stated : whether the measurements state their uncertainty.
    lever : RMS way (m) of the measured place by one radian of scatter in every joint.
    weighted : factor on the stated sigmas that the observations have, which are not believed unless it is one.
    left : factor on the stated variances that everything known of the recording leaves: noise is no larger.
    """
    pose = np.concatenate([o.pose for o in observations])
    group = np.concatenate([_targets(o) for o in observations])
    labels = repetitions(q)
    pure = _within(residuals, np.column_stack([labels[pose], group]))
    repeats = int(len(np.unique(pose)) - len(np.unique(labels[pose])))
    lengths = length_scatter(observations)
    stated_rms = float(np.sqrt(stated_square(observations))) / weighted if stated else None
    measurement, source, notes = _measurement(stated_rms, pure, lengths, refuted=weighted != 1.0)
    if source == "stated" and left < LARGE**2:
        measurement, source = measurement * float(np.sqrt(left)), "residuals"
        notes.append("the stated uncertainty is larger than what is left with all that was found: that figure counts")
    dimension = residuals.shape[1]
    freedom = max(1, len(residuals) * dimension - parameters)
    total = _Scatter(float(np.sum(residuals**2)) / freedom * dimension, freedom)
    if pure is None:
        lack = float(np.sqrt(max(0.0, total.square - measurement**2)))
        return NoiseParts(measurement, source, stated_rms, None, lack, repeats, None, tuple(notes), dimension)
    square = total.square * total.freedom - pure.square * pure.freedom
    beyond = _Scatter(max(0.0, square) / max(1, total.freedom - pure.freedom), max(1, total.freedom - pure.freedom))
    p = float(stats.f.sf(beyond.square / max(pure.square, 1e-300), beyond.freedom, pure.freedom))
    lack = float(np.sqrt(max(0.0, beyond.square - pure.square))) if p < LEVEL else 0.0
    scatter = float(np.sqrt(max(0.0, pure.square - measurement**2)) / lever) if lever > 0 else None
    return NoiseParts(measurement, source, stated_rms, scatter, lack, repeats, p, tuple(notes), dimension)


def _measurement(
    stated_rms: float | None, pure: _Scatter | None, lengths: float | None, *, refuted: bool = False
) -> tuple[float, Source, list[str]]:
    """The measurement's noise from the first source that holds: stated, repetitions, lengths on the body."""
    repeated = None if pure is None else float(np.sqrt(pure.square))
    notes = []
    # repetitions hold the joints' scatter as well: they refute a stated noise only from above
    too_large = stated_rms is not None and repeated is not None and stated_rms > WRONG * repeated
    wrong = (
        refuted
        or too_large
        or (stated_rms is not None and lengths is not None and not 1 / WRONG < stated_rms / lengths < WRONG)
    )
    for other, name in ((repeated, "exact repetitions"), (lengths, "lengths on the body")):
        if stated_rms is None or other is None:
            continue
        if stated_rms > DISAGREE * other or (name != "exact repetitions" and other > DISAGREE * stated_rms):
            notes.append(
                f"the measurements state {1e3 * stated_rms:.3g} mm (RMS), {name} scatter by {1e3 * other:.3g} mm"
            )
    if stated_rms is not None and not wrong:
        return stated_rms, "stated", notes
    if wrong:
        notes.append("the stated uncertainty is far off and not believed")
    if repeated is not None and not (lengths is not None and lengths < repeated):
        return repeated, "repeats", notes
    return (lengths, "lengths", notes) if lengths is not None else (0.0, "none", notes)


def _targets(o: Observations) -> NDArray[np.int64]:
    return np.asarray(o.target if isinstance(o, PointObservations) else np.full(len(o.pose), -1), dtype=np.int64)


def _within(residuals: Array, keys: NDArray[np.int64]) -> _Scatter | None:
    """Scatter of residuals (m, d) within groups of equal keys (m, k); None with too few repetitions."""
    labels = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(labels)
    mean = np.stack([np.bincount(labels, r) for r in residuals.T], axis=1) / count[:, None]
    freedom = (len(residuals) - len(count)) * residuals.shape[1]
    if freedom < FEWEST:
        return None
    return _Scatter(float(np.sum((residuals - mean[labels]) ** 2)) / freedom * residuals.shape[1], freedom)


def stated_square(observations: Sequence[Observations]) -> float:
    """Mean square (m2) of the error vector that the measurements state."""
    parts = []
    for o in observations:
        if isinstance(o, DistanceObservations):
            parts.append(o.sigma**2)
        elif isinstance(o, FrameObservations | PointObservations | SensorPointObservations):
            parts.append(np.trace(o.covariance[:, :3, :3], axis1=1, axis2=2))
    return float(np.mean(np.concatenate(parts)))


def length_scatter(observations: Sequence[Observations]) -> float | None:
    """RMS error (m) of a point from how lengths between targets of a pose scatter over the poses; None without."""
    square, freedom = 0.0, 0
    for o in observations:
        if not isinstance(o, PointObservations) or not len(o.pose):
            continue
        ids = np.unique(o.target)
        place = np.full((int(o.pose.max()) + 1, len(ids), 3), np.nan)
        place[o.pose, np.searchsorted(ids, o.target)] = o.p_world
        for i in range(len(ids)):
            for k in range(i):
                length = np.linalg.norm(place[:, i] - place[:, k], axis=1)
                length = length[np.isfinite(length)]
                if len(length) > 1:
                    # single wrong points say nothing about the noise; a median alone would be a poor estimate of it
                    off = np.abs(length - np.median(length))
                    sound = off[off <= CLIP * 1.4826 * max(float(np.median(off)), 1e-300)]
                    square += float(np.sum(sound**2))
                    freedom += len(sound) - 1
    # a length scatters by the root of two of what a coordinate does, a point by the root of three
    return float(np.sqrt(1.5 * square / freedom)) if freedom >= FEWEST else None
