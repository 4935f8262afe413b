"""What goes into a survey of a measuring body and what comes out."""

from dataclasses import dataclass, field

from robcal.imaging.detections import Detections
from robcal.photogrammetry.bundle.settings import AdjustSettings
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES
from robcal.photogrammetry.core.network import CameraNetwork, IntArray
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
