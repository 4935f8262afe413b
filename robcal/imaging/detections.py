"""What one image yields: targets in columns, and what was looked at and refused, with the reason."""

from dataclasses import dataclass
from enum import IntEnum, StrEnum

import numpy as np
from numpy.typing import NDArray

from robcal.imaging.noise import NoiseModel

Array = NDArray[np.float64]


CONTOUR_SIGMA = 0.02
"""Standard deviation, px, of the centre of an ellipse through a contour at half height (rendered dots)."""


class TargetKind(IntEnum):
    """How a target is coded."""

    DOT = 0
    RING12 = 1
    ARUCO = 2
    CORNER = 3
    CIRCLE = 4


class CodeState(IntEnum):
    """What stands around a dot: nothing, a readable ring code, or a ring that could not be read with certainty."""

    NONE = 0
    READ = 1
    UNREADABLE = 2


class Reason(StrEnum):
    """Why a candidate was refused; the value is fit to be shown to a user."""

    TOO_SMALL = "smaller than a dot"
    TOO_LARGE = "larger than a dot (lamp, wall, reflection)"
    BORDER = "cut by the image border"
    ELONGATED = "elongated (edge, line, reflection)"
    SHAPE = "not an ellipse (screw, edge, reflection, part of a code)"
    STRUCTURE = "an ellipse in outline but not evenly bright or not evenly edged"
    CONTRAST = "contrast too low"
    NO_CONVERGENCE = "the ellipse fit found no minimum"
    RING_PART = "segment of a code ring"
    DUPLICATE = "same blob as a better candidate"
    OVER_CAP = "over the cap on candidates"
    CORNER = "no clean crossing of two edges (covered, reflection, too small)"
    OFF_BOARD = "does not lie where the board has it"


@dataclass(frozen=True)
class Rejected:
    """Refused candidates, k of them; counts may exceed k where only a part was kept for the report.

    Attributes
    ----------
    xy : (k, 2) centre, pixels. size : (k,) half of the larger side, pixels. reason : (k,) reasons.
    counts : reason -> how many were refused for it.
    """

    xy: Array
    size: Array
    reason: tuple[Reason, ...]
    counts: dict[Reason, int]


@dataclass(frozen=True)
class Detections:
    """Targets of one image, n of them, in columns. Pixels: (x, y), centre of the top-left pixel is (0, 0).

    Attributes
    ----------
    shape : (height, width) of the image.
    xy : (n, 2) centre of the dot's ellipse (ArUco: meeting point of the diagonals; corners: crossing of the edges).
        Not corrected for eccentricity: the centre of the ellipse is not the image of the dot's centre; axes and angle
        allow the correction later.
    covariance : (n, 2, 2) of the centre, px^2, from image noise and residuals.
    semi_axes : (n, 2) semi-axes of the dot's edge, major first, px (ArUco: half of the mean side; corners: reach of
        the pixels used).
    angle : (n,) of the major axis, rad, from +x towards +y.
    contrast, background : (n,) grey values; contrast is negative for dark dots.
    saturated : (n,) bool, some of the dot's pixels are saturated.
    code : (n,) ring12 id, marker id or id on a board, -1 where there is none.
    kind : (n,) :class:`TargetKind`. code_state : (n,) :class:`CodeState`.
    blur : (n,) standard deviation of the edge profile, px, without the pixel's own 1/12.
    residual : (n,) RMS residual by contrast. chi2 : (n,) residual variance by the variance expected from noise.
    gain_gradient : (n, 2) relative change of brightness over one pixel; 0 where not significant.
    contour_offset : (n,) px, distance of the centre from that of the ellipse through the dot's contour, which is
        independent of the fit to grey values; of doubtful dots only, NaN for all others. A diagnostic: no result
        depends on it.
    noise : noise model of the image. rejected : what was refused.
    message : empty, or why there is nothing (black image, saturated image).
    """

    shape: tuple[int, int]
    xy: Array
    covariance: Array
    semi_axes: Array
    angle: Array
    contrast: Array
    background: Array
    saturated: NDArray[np.bool_]
    code: NDArray[np.int64]
    kind: NDArray[np.int8]
    code_state: NDArray[np.int8]
    blur: Array
    residual: Array
    chi2: Array
    gain_gradient: Array
    contour_offset: Array
    noise: NoiseModel
    rejected: Rejected
    message: str = ""

    def __post_init__(self) -> None:
        for column in self.columns().values():
            column.setflags(write=False)

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def contradicted(self) -> NDArray[np.bool_]:
        """(n,) doubtful dots whose two centres disagree by more than three standard deviations."""
        sigma = np.hypot(CONTOUR_SIGMA, np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 2.0))
        return np.asarray(self.contour_offset > 3.0 * sigma)

    def columns(self) -> dict[str, NDArray]:
        """The per-target arrays by name."""
        return {name: getattr(self, name) for name in _COLUMNS}


def empty_columns(n: int = 0) -> dict[str, NDArray]:
    """Columns of n targets, all zero, code -1."""
    return {
        "xy": np.zeros((n, 2)),
        "covariance": np.zeros((n, 2, 2)),
        "semi_axes": np.zeros((n, 2)),
        "angle": np.zeros(n),
        "contrast": np.zeros(n),
        "background": np.zeros(n),
        "saturated": np.zeros(n, bool),
        "code": np.full(n, -1, np.int64),
        "kind": np.zeros(n, np.int8),
        "code_state": np.zeros(n, np.int8),
        "blur": np.zeros(n),
        "residual": np.zeros(n),
        "chi2": np.ones(n),
        "gain_gradient": np.zeros((n, 2)),
        "contour_offset": np.full(n, np.nan),
    }


_COLUMNS = tuple(empty_columns())


class RejectionLog:
    """Collects refused candidates; keeps at most `keep` places, counts all."""

    def __init__(self, keep: int = 2000) -> None:
        self.keep = keep
        self._entries: list[tuple[float, float, float, Reason]] = []
        self._counts: dict[Reason, int] = {}

    def add(self, x: float, y: float, size: float, reason: Reason) -> None:
        self._counts[reason] = self._counts.get(reason, 0) + 1
        if len(self._entries) < self.keep:
            self._entries.append((float(x), float(y), float(size), reason))

    def add_rows(self, xy: Array, size: Array, reason: Reason) -> None:
        """Several candidates (k, 2) with sizes (k,) for one reason."""
        for place, extent in zip(xy, size, strict=True):
            self.add(place[0], place[1], extent, reason)

    def count(self, reason: Reason, number: int) -> None:
        """Counts candidates without place."""
        if number:
            self._counts[reason] = self._counts.get(reason, 0) + int(number)

    def result(self) -> Rejected:
        numbers = np.array([entry[:3] for entry in self._entries], dtype=float).reshape(-1, 3)
        reasons = tuple(entry[3] for entry in self._entries)
        return Rejected(numbers[:, :2].copy(), numbers[:, 2].copy(), reasons, dict(self._counts))
