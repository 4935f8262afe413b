"""What a diagnosis says, as data."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from robcal.physics.cause import Array, Constants, LinearCause
from robcal.robot.model import RobotModel


@dataclass(frozen=True)
class Rival:
    """Another cause that the recording cannot (or hardly) tell from the one named.

    Attributes
    ----------
    probability : posterior probability within the library, all causes of equal prior weight; NaN where the
        recording cannot decide.
    overlap : share of the named cause's projected signature that the rival can reproduce, 0 to 1.
    """

    cause: LinearCause
    constants: Constants
    probability: float
    overlap: float


@dataclass(frozen=True)
class Finding:
    """One cause that was accepted.

    Attributes
    ----------
    values, covariance : amplitudes in SI, in the order of the cause's names.
    parameters, sigma : as reported, in the units of diagnosis.json.
    p_value : family-wise probability of the scan in which it was found.
    log_evidence : logarithm of the Bayes factor against leaving it out.
    rivals : the rest of the 95 % set and every cause with the same signature.
    explained : its share, 0 to 1, of the drop of the whitened sum of squares by all causes, added in their order.
    poses : names of the poses that carry most of it.
    heldout : position error on kept-out poses in metres, before and after adding it.
    names : parameters of the diagnosed model that are its amplitudes; empty for displacements of the measurement.
    waits : why it is not in force in the robot that is delivered; empty where it is, or where nobody has decided.
    """

    cause: LinearCause
    constants: Constants
    values: Array
    covariance: Array
    parameters: Mapping[str, object]
    p_value: float
    log_evidence: float
    heldout: tuple[float, float]
    statement: str
    sigma: Mapping[str, object] = field(default_factory=dict)
    rivals: tuple[Rival, ...] = ()
    explained: float = 1.0
    poses: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    waits: str = ""

    @property
    def full_statement(self) -> str:
        """The statement, and that it is not in force where that is so."""
        return f"{self.statement} (not in force in the delivered robot)" if self.waits else self.statement


@dataclass(frozen=True)
class Diagnosis:
    """Outcome for one recording.

    Attributes
    ----------
    p_value : family-wise probability of the largest mismatch if nothing were missing.
    findings : accepted causes, in the order in which they were accepted.
    blunders : poses or points left out as isolated gross errors, with a word on each.
    noise_stated, noise_estimated : factor by which the data scatter against their covariance; `joint_sigma` is the
        repeatability of the joints (rad) that the covariance did not know.
    unexplained_p, unexplained_pattern : what the last scan says.
    heldout : (before, after, noise floor) in metres; `heldout_kind` 'verify' or 'cross-validation'.
    region : (before, after) in metres, at one end of the measured space predicted from all other poses that were used
        to identify; None for short recordings.
    model, free : robot with everything accepted, and its fitted parameters.
    covariance : (p, p) of these, m and rad; the joints' scatter, which no parameter explains, comes on top of it.
    """

    p_value: float
    findings: tuple[Finding, ...]
    blunders: tuple[str, ...]
    noise_estimated: float
    joint_sigma: float
    unexplained_p: float
    unexplained_pattern: str | None
    heldout: tuple[float, float, float]
    heldout_kind: str
    model: RobotModel
    free: tuple[str, ...]
    covariance: Array
    next_poses: tuple[Mapping[str, float], ...] = ()
    seconds: float = 0.0
    notes: tuple[str, ...] = field(default=())
    region: tuple[float, float] | None = None

    @property
    def mismatch(self) -> bool:
        """Whether anything is missing in the model."""
        return bool(self.findings)
