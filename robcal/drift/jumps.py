"""Tells a jump from drift: a body that was pushed, a joint that slipped in a crash.

Temperatures change slowly, so between two tours each parameter may change by a share of its expected thermal change
only. What the tour shows beyond that is compared with what a displaced body or a slipped joint would show, by the
ratio of likelihoods (Kay 1998, Detection Theory, section 7.3), under the covariance of noise and possible drift.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg, special, stats

from robcal import transforms as tf
from robcal.drift.fit import Linearised
from robcal.drift.reference import DriftReference, Ints
from robcal.robot.kernel import PoseInputs
from robcal.transforms import Array

CRASH = float(np.radians(0.02))
"""rad; turn of a joint after a crash that a control has to tell."""
BETWEEN_TOURS = 600.0
"""s; how old a model usually is when the next tour is complete."""


@dataclass(frozen=True)
class Jump:
    """The likeliest jump.

    Attributes
    ----------
    what : 'body' or the name of a joint's frame. size : m (how far its targets moved on average) or rad.
    p_value : chance of such a sign without a jump.
    """

    what: str
    size: float
    p_value: float

    @property
    def text(self) -> str:
        """A sentence for a person."""
        if self.what == "body":
            return (
                f"all targets moved together by {1e3 * self.size:.2f} mm at once: was the body or its stand pushed? "
                "The model stays as it was; measure a new reference (drift init) when all stands firmly"
            )
        return (
            f"{self.what} turned by {np.degrees(self.size):.3f} deg at once: a crash, or a lost reference? The model "
            "stays as it was; check the mastering, then 'drift rollback' takes the control up again"
        )


def allowed_share(elapsed: float, time_constant: float) -> float:
    """Share of its expected thermal change by which a parameter may change within a time (s)."""
    return min(1.0, max(elapsed, 0.0) / time_constant)


def find_jump(reference: DriftReference, slots: Ints, linear: Linearised, elapsed: float, model: Array) -> Jump | None:
    """The jump that a tour shows against the model in force, None where drift and noise explain it.

    Parameters
    ----------
    slots : of the tour's readings, gross errors left out.
    linear : their displacements about the model in force. elapsed : s since that model's tour.
    model : (p, p) covariance of the model in force.

    Weakness: right after a long standstill the whole thermal change is possible, and a jump that looks like one is
    not told.
    """
    m, p = len(slots), len(reference.names)
    share = allowed_share(elapsed, reference.settings.time_constant)
    A = linear.A.reshape(3 * m, p)
    S = A @ (np.diag((share * reference.sizes) ** 2) + model) @ A.T
    S.reshape(m, 3, m, 3)[np.arange(m), :, np.arange(m)] += linear.C
    factor = linalg.cho_factor(S, check_finite=False)
    hypotheses = _hypotheses(reference, slots)
    every = np.concatenate(list(hypotheses.values()), axis=1)
    weighted = linalg.cho_solve(factor, every, check_finite=False)
    normals, right = weighted.T @ every, weighted.T @ linear.r.ravel()
    best, score, first = None, -np.inf, 0
    for what, H in hypotheses.items():
        at = slice(first, first := first + H.shape[1])
        normal = normals[at, at]
        estimate = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ right[at]
        gain = float(estimate @ normal @ estimate)
        way = float(np.mean(np.linalg.norm((H @ estimate).reshape(-1, 3), axis=1)))
        size = way if what == "body" else float(abs(estimate[0]))
        # a body's six numbers fit more than a joint's one by chance (Akaike 1974)
        if gain - 2 * H.shape[1] > score:
            best, score = Jump(what, size, float(special.chdtrc(H.shape[1], gain))), gain - 2 * H.shape[1]
    if best is None or best.p_value >= reference.settings.level:
        return None
    return best if best.size > reference.settings.least_jump[0 if best.what == "body" else 1] else None


def smallest_jumps(reference: DriftReference, elapsed: float = BETWEEN_TOURS) -> dict[str, float]:
    """The smallest turn (rad, m) of each joint that a tour tells from drift and noise, by the name of its frame.

    The size at which the sign of a jump reaches the level of an alarm on average, when the last model is ``elapsed``
    seconds old. What a joint hardly moves for the sensor, or what drift does as well, is large; infinite where a tour
    shows nothing of it. Weakness: readings are taken to be as certain as those of the reference.
    """
    kernel, m = reference.kernel, len(reference.q)
    given = {name: np.full(m, value) for name, value in reference.robot.defaults.items()}
    inputs = PoseInputs(reference.q, reference.load, {"index": np.zeros(m), **given})
    T, J = kernel.frames_and_jacobian(kernel.theta0, inputs, reference.columns)
    seen = tf.transform(tf.invert(T), reference.p)
    A = (T[:, :3, :3] @ (J[:, :3] - tf.skew(seen) @ J[:, 3:])).reshape(3 * m, -1)
    share = allowed_share(elapsed, reference.settings.time_constant)
    S = A @ np.diag((share * reference.sizes) ** 2) @ A.T
    S.reshape(m, 3, m, 3)[np.arange(m), :, np.arange(m)] += 2.0 * reference.covariance
    columns = reference.joint_columns.reshape(3 * m, -1)
    gain = np.sum(columns * linalg.cho_solve(linalg.cho_factor(S), columns), axis=0)
    needed = float(stats.chi2.isf(reference.settings.level, 1))
    sizes = np.sqrt(needed / np.maximum(gain, 1e-300))
    return {f.name: float(size) for f, size in zip(kernel.model.joints, sizes, strict=True)}


def unwatched_joints(reference: DriftReference) -> list[str]:
    """A sentence for each turning joint of which a jump of 0.02 deg is not told by this reference's tour."""
    smallest = {name: np.degrees(size) for name, size in smallest_jumps(reference).items() if size > CRASH}
    return [
        f"{f.name} cannot be watched by this tour: a jump has to be about {smallest[f.name]:.2g} deg to be told from "
        "drift; look at targets farther from its axis"
        for f in reference.kernel.model.joints
        if f.name in smallest and not f.prismatic
    ]


def _hypotheses(reference: DriftReference, slots: Ints) -> dict[str, Array]:
    """Columns (3m, d) of displacements per unit: the body's six, and each joint's angle."""
    moved = reference.joint_columns[slots]
    p = reference.p[slots]
    turned = -tf.skew(p - p.mean(axis=0))
    body = np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=2).reshape(-1, 6)
    joints = reference.kernel.model.joints
    return {"body": body, **{f.name: moved[:, :, k].reshape(-1, 1) for k, f in enumerate(joints)}}
