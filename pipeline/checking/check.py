"""All faults of a campaign at once: its files, what they say together, and a look into some of its images."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from pipeline.campaign import Campaign
from pipeline.campaign_reader import read_leniently
from pipeline.checking.images import image_doubts
from pipeline.checking.joints import joint_doubts
from pipeline.checking.measured import measured_doubts, recording_faults
from pipeline.checking.similar_robots import robots_of_so_many_joints
from pipeline.checking.surveys import survey_doubts
from pipeline.messages import track
from robcal.errors import InvalidInput, RobcalError


@dataclass(frozen=True)
class Checked:
    """What is wrong with a campaign, a sentence each with file, row and remedy.

    Attributes
    ----------
    campaign : as far as it could be read, None where nothing could.
    faults : each would stop a run. warnings : doubtful. notes : what a run would assume.
    """

    campaign: Campaign | None
    faults: tuple[str, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()


_LOOKS: tuple[Callable[[Campaign], tuple[list[str], list[str]]], ...] = (
    robots_of_so_many_joints,
    joint_doubts,
    measured_doubts,
    survey_doubts,
    image_doubts,
)


def check_campaign(path: Path) -> Checked:
    """Look at everything that lies in a campaign; a minute at most, nothing is written."""
    campaign, faults = read_leniently(path)
    if campaign is None:
        return Checked(None, tuple(faults), ())
    warnings = [*campaign.warnings]
    looks = [*_LOOKS, *([] if faults else [recording_faults])]
    for look in track(looks, len(looks), "looking at the recordings"):
        try:
            wrong, doubtful = look(campaign)
        except RobcalError as error:
            wrong, doubtful = list(error.faults if isinstance(error, InvalidInput) else [str(error)]), []
        faults += wrong
        warnings += doubtful
    return Checked(campaign, _each_once(faults), _each_once(warnings), campaign.notes)


def _each_once(sentences: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(" ".join(sentence.split()) for sentence in sentences))
