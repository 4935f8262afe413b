"""Settings of the target detection, checked when they are made."""

from dataclasses import dataclass
from typing import Literal

from robcal.errors import InvalidInput
from robcal.imaging.ring_code import RING12, RingPattern

Polarity = Literal["bright", "dark"]


@dataclass(frozen=True)
class DetectionSettings:
    """Settings of :func:`robcal.imaging.detect.detect_targets`.

    Attributes
    ----------
    polarity : bright dots on a dark ground (retroreflective, the default) or dark dots on a bright ground.
    min_axis_px, max_axis_px : limits of the dot's minor and major semi-axis, pixels.
    min_axis_ratio : minor by major axis; below it a blob is an edge or a line (0.2 is a tilt of 78 degrees).
    min_contrast_sigma : contrast by background noise below which a blob is not looked at.
    max_misfit : RMS of the residuals that noise does not explain, by contrast, above which a blob is no dot (clean dots
        stay below 0.03, unevenly lit balls reach 0.15; the covariance grows with it).
    ring12 : read ring codes. ring : how they are printed, default ring12.
    known_codes : the ids of rings that can occur; any other reading is then no code. None: any.
    aruco : OpenCV dictionary of square markers to look for, as "4X4_50" or "DICT_4X4_50"; None: none.
    saturation_level : grey value from which a pixel counts as saturated; None: found from the image.
    coarse : where most candidates are refused, add coarse dots (:mod:`robcal.imaging.coarse_dots`), for bodies that
        geometry identifies.
    max_candidates : cap on the blobs that are fitted; those of most contrast are kept.
    """

    polarity: Polarity = "bright"
    min_axis_px: float = 0.7
    max_axis_px: float = 100.0
    min_axis_ratio: float = 0.2
    min_contrast_sigma: float = 8.0
    max_misfit: float = 0.15
    ring12: bool = True
    ring: RingPattern = RING12
    known_codes: frozenset[int] | None = None
    aruco: str | None = None
    saturation_level: float | None = None
    coarse: bool = False
    max_candidates: int = 4000

    def __post_init__(self) -> None:
        if self.polarity not in ("bright", "dark"):
            raise InvalidInput(f"polarity {self.polarity!r} is unknown; use 'bright' or 'dark'")
        if not 0 < self.min_axis_px < self.max_axis_px:
            raise InvalidInput(
                f"min_axis_px {self.min_axis_px} and max_axis_px {self.max_axis_px}: give 0 < min_axis_px < max_axis_px"
            )
        if not 0 < self.min_axis_ratio < 1:
            raise InvalidInput(f"min_axis_ratio {self.min_axis_ratio} must lie between 0 and 1")
        if not self.min_contrast_sigma > 0 or not self.max_misfit > 0:
            raise InvalidInput("min_contrast_sigma and max_misfit must be positive")
        if self.max_candidates < 1:
            raise InvalidInput(f"max_candidates {self.max_candidates} must be at least 1")
