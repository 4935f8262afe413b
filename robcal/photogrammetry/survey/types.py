"""What goes into a survey of a measuring body and what comes out.

What a survey is given: detections, the list of the body's targets, lengths, start values of the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput, NotIdentifiable
from robcal.imaging.detections import Detections
from robcal.photogrammetry.bundle.datum import DatumSpec
from robcal.photogrammetry.bundle.settings import AdjustSettings
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.core.network import CameraNetwork, IntArray, Lengths
from robcal.photogrammetry.survey.images import Collection
from robcal.transforms import Array


@dataclass(frozen=True)
class SurveyImage:
    """One photograph: what was detected in it, or marks identified by another program.

    Attributes
    ----------
    name : for messages.
    detections : result of the target detection, or None.
    marks : (ids (m,), xy (m, 2) px, covariance (m, 2, 2) px^2), or None.
    """

    name: str
    detections: Detections | None = None
    marks: tuple[IntArray, Array, Array] | None = None


@dataclass(frozen=True)
class BodyTarget:
    """A target as the body's file lists it; lengths in m."""

    id: int | None
    code: str | None = None
    diameter: float | None = None
    xyz: tuple[float, float, float] | None = None
    sigma: float | None = None


@dataclass(frozen=True)
class SurveySettings:
    """How to survey.

    Attributes
    ----------
    adjust : settings of the adjustment. free_intrinsics : what self-calibration estimates.
    new_points : search for uncoded dots without coordinates. min_images : images a new point must be seen in.
    eccentricity : model the eccentricity of ellipse centres where a diameter is known.
    reach : new points farther from the body's centre than this many of its radii are no targets.
    """

    adjust: AdjustSettings = field(default_factory=AdjustSettings)
    free_intrinsics: tuple[str, ...] = INTRINSIC_NAMES
    new_points: bool = True
    min_images: int = 3
    eccentricity: bool = True
    reach: float = 1.6


@dataclass(frozen=True)
class SurveyResult:
    """A surveyed body.

    Attributes
    ----------
    network : the adjusted network in the body's frame.
    frame : description of what defines that frame. scale : where the scale comes from.
    new_ids : ids that the survey gave to dots without id.
    unseen_ids : listed targets that could not be surveyed.
    unused_images : (name, reason). free_detections : detections that belong to no target.
    deviations : (id, metres) distance of each given coordinate from the surveyed one, after the fit.
    engine : which bundle engine made it.
    normals : (t, 3) outer unit normals of the network's targets where the ellipses determine them, else NaN.
    """

    network: CameraNetwork
    frame: str
    scale: str
    new_ids: tuple[int, ...]
    unseen_ids: tuple[int, ...]
    unused_images: tuple[tuple[str, str], ...]
    free_detections: int
    deviations: tuple[tuple[int, float], ...]
    engine: str
    normals: Array
    notes: tuple[str, ...]


@dataclass(frozen=True)
class SurveyInput:
    """All that stays fixed during a survey.

    Attributes
    ----------
    camera : start values of the interior orientation; ``camera_known`` false: made up from the size of the images.
    bars, checks : scale bars and check lengths.
    """

    detections: Collection
    targets: tuple[BodyTarget, ...]
    camera: Camera
    camera_known: bool
    bars: Lengths
    checks: Lengths
    settings: SurveySettings

    @property
    def adjust_settings(self) -> AdjustSettings:
        """Settings of the adjustments; the focal length of a known camera may be held where nothing determines it."""
        adjust = self.settings.adjust
        return replace(adjust, hold_focal=adjust.hold_focal or self.camera_known)

    @property
    def given(self) -> dict[int, Array]:
        """Given coordinates (3,) m by target id."""
        return {t.id: np.array(t.xyz, dtype=float) for t in self.targets if t.id is not None and t.xyz is not None}

    @property
    def blank(self) -> list[BodyTarget]:
        """Listed targets with neither code nor coordinates: any dot may be one of them."""
        return [t for t in self.targets if t.code is None and t.xyz is None]

    @property
    def stated_diameters(self) -> dict[int, float]:
        """Stated diameters, m, by target id."""
        return {t.id: t.diameter for t in self.targets if t.id is not None and t.diameter}

    def given_points(self, ids: Sequence[int] | IntArray) -> Array:
        """(t, 3) given coordinates of targets, NaN where unknown."""
        given = self.given
        return np.array([given.get(int(i), np.full(3, np.nan)) for i in ids]).reshape(-1, 3)

    def modelled_diameters(self, ids: IntArray, new: NDArray[np.bool_]) -> Array | None:
        """(t,) m stated diameters, 0 where unknown; None where the eccentricity is not to be modelled.

        New targets (``new`` (t,) bool) have the diameter of the uncoded ones where all of these have the same.
        """
        if not self.settings.eccentricity:
            return None
        common = {t.diameter for t in self.targets if t.diameter and t.code is None}
        of_new = common.pop() if len(common) == 1 else 0.0
        stated = self.stated_diameters
        return np.array([of_new if n else stated.get(int(i), 0.0) for i, n in zip(ids, new, strict=True)])

    def check_scale(self, datum: DatumSpec) -> None:
        """Raise an error if nothing can give the scale.

        Raises
        ------
        InvalidInput : targets of a fixed datum without coordinates.
        NotIdentifiable : neither a scale bar nor two targets with given coordinates.
        """
        given = self.given
        if isinstance(datum, tuple):
            missing = sorted(i for i in datum if i not in given)
            if missing:
                raise InvalidInput(f"targets {missing} of the fixed datum have no coordinates: give xyz_mm")
            return
        if len(self.bars) == 0 and len(given.keys() & set(self.detections.ids.tolist())) < 2:
            raise NotIdentifiable(
                "nothing gives the scale: photograph a scale bar (scale_bars) or give the coordinates of two targets",
                ("scale",),
            )
