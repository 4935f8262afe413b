"""What was commanded: the poses of a recording in the order in which they were driven."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robcal.robot.kernel import Kernel, PoseInputs
from robcal.transforms import Array

RESTING = np.radians(1e-4)
"""A joint that moved less than this (rad or m) from one pose to the next did not move."""


@dataclass(frozen=True)
class JointLog:
    """The joint log of a recording.

    Attributes
    ----------
    names : (n,) pose ids.
    q : (n, joints) rad or m, as commanded.
    payload : (n,) name of the load, None without.
    verify : (n,) true for poses that are kept out of the identification.
    approach : (n, joints) -1, 0, +1; inferred : joints (from 0) of which it was taken from the order of the poses.
    covariates : further numeric columns by name (``time_s``, ``temp_<place>_c``, any other).
    """

    names: tuple[str, ...]
    q: Array = field(repr=False)
    payload: tuple[str | None, ...] = field(repr=False)
    verify: NDArray[np.bool_] = field(repr=False)
    approach: Array = field(repr=False)
    inferred: tuple[int, ...] = ()
    covariates: Mapping[str, Array] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.names)

    def as_stated(self) -> "JointLog":
        """The log without what was inferred: approach 0 where no column states it, as for poses to predict."""
        approach = self.approach.copy()
        approach[:, list(self.inferred)] = 0.0
        return replace(self, approach=approach, inferred=())

    def stated(self) -> dict[str, Array]:
        """All numeric columns (n,): covariates, approach directions, and each joint's last move (`moveK`, rad or m).

        Moves follow from the order of the rows; they are zero where no approach is known, as for poses to predict
        that state none.
        """
        columns = {name: np.asarray(values, dtype=float) for name, values in self.covariates.items()}
        columns.update({f"approach{k + 1}": self.approach[:, k] for k in range(self.q.shape[1])})
        moves = np.diff(self.q, axis=0, prepend=self.q[:1]) * bool(np.any(self.approach))
        columns.update({f"move{k + 1}": moves[:, k] for k in range(self.q.shape[1])})
        return columns

    def recorded(self) -> dict[str, Array]:
        """The columns of :meth:`stated`, and ``index``: the row of each pose, which only a recording knows."""
        return {**self.stated(), "index": np.arange(len(self), dtype=float)}

    def inputs(self, kernel: Kernel) -> PoseInputs:
        """Inputs of the kernel at the recorded poses."""
        return kernel.poses(self.q, self.payload, self.recorded())


def approach_from_order(q: Array) -> Array:
    """Direction (n, joints) in which each joint last moved when the poses were driven one after the other.

    The first pose of a joint that has not moved yet gets 0. Weakness: the way between two poses is not known, only
    its ends.
    """
    step = np.diff(q, axis=0, prepend=q[:1])
    direction = np.where(np.abs(step) > RESTING, np.sign(step), 0.0)
    for i in range(1, len(direction)):
        still = direction[i] == 0
        direction[i, still] = direction[i - 1, still]
    return direction
