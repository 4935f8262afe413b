"""Types of a photogrammetric network: image marks, known lengths, and the adjusted network with its covariances.

A network is one camera (one interior orientation) seen at ``n`` stations around a body of ``t`` targets at rest.
Lengths in metres, angles in radians, image coordinates in pixels with the centre of the top-left pixel at (0, 0).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.columns import Columns
from robcal.errors import InvalidInput
from robcal.estimation.summary import SolveSummary
from robcal.photogrammetry.core.camera import Camera
from robcal.transforms import Array

IntArray = NDArray[np.int64]


def frozen(values: ArrayLike, dtype: type = float) -> NDArray[Any]:
    """A read-only copy, so that results cannot be changed behind their summary."""
    out: NDArray[Any] = np.array(values, dtype=dtype)
    out.setflags(write=False)
    return out


@dataclass(frozen=True)
class ImageMarks(Columns):
    """Measured image points, one row each.

    Attributes
    ----------
    image : (m,) index of the image.
    target : (m,) index of the target (a row of the network's ids, not the id itself).
    xy : (m, 2) px.
    covariance : (m, 2, 2) px^2.
    semi_axes : (m, 2) px of the target's ellipse, or None; not used by the adjustment, kept for the diagnosis.
    group : (m,) variance component each mark belongs to, or None for a single one.
    """

    image: IntArray
    target: IntArray
    xy: Array
    covariance: Array
    semi_axes: Array | None = None
    group: IntArray | None = None

    def __post_init__(self) -> None:
        m = len(self.image)
        shapes = {"target": (m,), "xy": (m, 2), "covariance": (m, 2, 2)}
        if self.semi_axes is not None:
            shapes["semi_axes"] = (m, 2)
        if self.group is not None:
            shapes["group"] = (m,)
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise InvalidInput(f"marks: {name} has shape {np.shape(getattr(self, name))}, expected {shape}")
        for name in ("image", "target", "group"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen(getattr(self, name), np.int64))
        for name in ("xy", "covariance", "semi_axes"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen(getattr(self, name)))
        if not np.all(np.isfinite(self.xy)):
            row = int(np.argmax(~np.all(np.isfinite(self.xy), axis=1)))
            raise InvalidInput(f"mark in row {row} has a coordinate that is no number: remove it or measure it again")
        a, b, c = self.covariance[:, 0, 0], self.covariance[:, 0, 1], self.covariance[:, 1, 1]
        if not np.all((a > 0) & (c > 0) & (a * c > b * b)):
            raise InvalidInput("a mark has a covariance that is not positive definite: its sigma must be above zero")

    def __len__(self) -> int:
        return len(self.image)


@dataclass(frozen=True)
class Lengths(Columns):
    """Known distances between pairs of targets (scale bars, check lengths).

    Attributes
    ----------
    ids : (k, 2) target ids.
    length : (k,) m.
    sigma : (k,) m; NaN where unknown (allowed for check lengths only).
    """

    ids: IntArray
    length: Array
    sigma: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids", frozen(np.reshape(self.ids, (-1, 2)), np.int64))
        object.__setattr__(self, "length", frozen(np.reshape(self.length, -1)))
        object.__setattr__(self, "sigma", frozen(np.reshape(self.sigma, -1)))
        k = len(self.ids)
        if self.length.shape != (k,) or self.sigma.shape != (k,):
            raise InvalidInput(f"lengths: {k} pairs of ids, {self.length.size} lengths, {self.sigma.size} sigmas")
        if not np.all(self.length > 0) or not np.all(np.isfinite(self.length)):
            raise InvalidInput("a known length must be a number above zero")
        if np.any(self.ids[:, 0] == self.ids[:, 1]):
            bad = int(self.ids[np.argmax(self.ids[:, 0] == self.ids[:, 1]), 0])
            raise InvalidInput(f"a known length goes from target {bad} to itself: name two different targets")

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def none(cls) -> "Lengths":
        """No lengths at all."""
        return cls(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class RejectedMark:
    """A mark that was taken out: name of the image, id of the target, px, and the test's chi-square (2 dof)."""

    image: str
    target: int
    xy: tuple[float, float]
    residual: tuple[float, float]
    statistic: float
    reason: str


LengthKind = Literal["scale_bar", "check"]


@dataclass(frozen=True)
class LengthResult:
    """A length after the adjustment, in m: measured by the network against the known one.

    ``sigma`` is that of ``error`` (measured minus expected): network and known length together, for scale bars
    (which take part in the adjustment) that of the residual. ``w`` = error / sigma.
    """

    ids: tuple[int, int]
    measured: float
    expected: float
    error: float
    sigma: float
    w: float
    kind: LengthKind


@dataclass(frozen=True)
class Correlation:
    """Two unknowns that the data hardly distinguish."""

    first: str
    second: str
    value: float


@dataclass(frozen=True)
class CameraNetwork:
    """An adjusted network.

    All covariances are marginal, in the stated datum, and already multiplied by the estimated variance components.

    Attributes
    ----------
    camera : interior orientation; intrinsics_covariance (9, 9) in the order of INTRINSIC_NAMES, zero where held.
    free_intrinsics : names of the estimated intrinsic parameters; left_out : (name, reason) of those given up.
    image_names : (n,) names; camera_T_body : (n, 4, 4); pose_covariance : (n, 6, 6), right perturbation (rho, omega)
        in body coordinates.
    ids : (t,) target ids; points : (t, 3) m in body coordinates; points_covariance : (3t, 3t);
        points_intrinsics_covariance : (3t, 9).
    marks : the marks in use; residuals : (m, 2) px measured minus projected; redundancy : (m, 2) share of a gross
        error that shows in its own residual; w : (m, 2) standardised residuals; statistic : (m,) chi-square of two
        degrees of freedom of the residual vector.
    normals : (t, 3) target normals in body coordinates, NaN where unknown; radii : (t,) m of the targets, 0 where the
        eccentricity of the ellipse centre is not modelled.
    sigma0 : factor by which the marks scatter more than their stated covariance (posterior); sigma0_px : the same as
        the mean standard deviation of a coordinate; group_sigma0 : per variance component of the marks;
        bars_sigma0 : of the scale bars (1 unless estimated).
    redundancy_total : observations minus unknowns plus datum defect.
    rejected : marks taken out; correlations : pairs of unknowns above 0.95.
    scale_bars, check_lengths : results per length; datum : description of what fixes the frame.
    unknowns : how many are estimated; rank : numerical rank of the normal equations without the datum, so ``unknowns``
        minus its defect (7, with scale bars 6, with fixed targets 0) where the marks determine everything.
    summary : iterations and seconds of all minimisations together; costs and termination of the last one.
    """

    camera: Camera
    intrinsics_covariance: Array
    free_intrinsics: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    image_names: tuple[str, ...]
    camera_T_body: Array
    pose_covariance: Array
    ids: IntArray
    points: Array
    points_covariance: Array
    points_intrinsics_covariance: Array
    marks: ImageMarks
    residuals: Array
    redundancy: Array
    w: Array
    statistic: Array
    normals: Array
    radii: Array
    sigma0: float
    sigma0_px: float
    group_sigma0: Array
    bars_sigma0: float
    redundancy_total: int
    rejected: tuple[RejectedMark, ...]
    correlations: tuple[Correlation, ...]
    scale_bars: tuple[LengthResult, ...]
    check_lengths: tuple[LengthResult, ...]
    datum: str
    condition: float
    unknowns: int
    rank: int
    summary: SolveSummary
    notes: tuple[str, ...] = field(default=())

    @property
    def rms_px(self) -> float:
        """Root mean square of the residual coordinates in px."""
        return float(np.sqrt(np.mean(self.residuals**2))) if len(self.marks) else float("nan")

    @property
    def points_sigma(self) -> Array:
        """Standard deviations (t, 3) of the coordinates in m."""
        return np.sqrt(np.maximum(np.diag(self.points_covariance), 0.0)).reshape(-1, 3)

    def index_of(self, ids: Sequence[int] | ArrayLike) -> IntArray:
        """Rows of the given target ids.

        Raises
        ------
        InvalidInput : an id is not in the network.
        """
        rows = {int(v): i for i, v in enumerate(self.ids)}
        wanted = [int(v) for v in np.ravel(np.asarray(ids))]
        missing = sorted({v for v in wanted if v not in rows})
        if missing:
            raise InvalidInput(f"targets {missing} are not in the network: check their ids")
        return np.array([rows[v] for v in wanted], dtype=np.int64)
