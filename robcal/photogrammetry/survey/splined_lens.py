"""A survey with a splined lens where the residuals ask for one: the field and the network take turns."""

from collections.abc import Callable
from dataclasses import dataclass

from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.splined import SplinedCamera
from robcal.photogrammetry.survey.lens_field import LensField, lens_field, with_field
from robcal.photogrammetry.survey.types import SurveyResult

ROUNDS = 4
"""A network takes up a part of the field, which the next round finds in its residuals."""
WORTH = 0.005
"""Share by which a round must lower sigma0 to be followed by another."""


@dataclass(frozen=True)
class SplinedSurvey:
    """A survey with a splined lens. ``field`` : the pattern that asked for it; ``before`` : sigma0 (px) without."""

    result: SurveyResult
    field: LensField
    before: float


def with_splined_lens(done: SurveyResult, survey: Callable[[Camera], SurveyResult]) -> SplinedSurvey | None:
    """The survey again, with splines on the image; None where the residuals do not ask for it.

    Only a lens of Brown's is replaced, and one that a file gives as splined is left as it is. The splines count as
    exact in all covariances.

    Parameters
    ----------
    survey : the same survey with another camera as start.
    """
    if type(done.network.camera) is not Camera:
        return None
    field = lens_field(done.network)
    if field is None or not field.significant:
        return None
    best, found = done, field
    for _ in range(ROUNDS):
        trial = survey(with_field(best.network, found))
        if trial.network.sigma0_px >= best.network.sigma0_px * (1.0 - WORTH):
            break
        best = trial
        more = lens_field(best.network)
        if more is None or more.gain <= 0:
            break
        found = more
    if not isinstance(best.network.camera, SplinedCamera):
        return None
    return SplinedSurvey(best, field, done.network.sigma0_px)
