"""What a survey lacks: a scale, images, ids that belong to its body."""

import numpy as np

from pipeline.campaign import BodySource, Campaign, ImageSource
from pipeline.campaign_schema import FixedDatum, SurveyEntry
from pipeline.checking.joints import Doubts
from pipeline.stages.survey import check_lengths
from robcal.files.body_file import BodyFile

FEWEST_IMAGES, FEW_IMAGES = 3, 10
MOST_NAMED = 12


def survey_doubts(campaign: Campaign) -> Doubts:
    """Surveys and station cameras of a campaign."""
    faults: list[str] = []
    doubts: list[str] = []
    for name, body in campaign.bodies.items():
        if body.survey is None or body.survey_entry is None:
            continue
        line = campaign.document.line(("bodies", name, "survey"))
        where = f"{campaign.path}, line {line}: survey of '{name}'"
        wrong, doubtful = _survey(where, body, body.survey, body.survey_entry)
        faults += wrong
        doubts += doubtful
        check_lengths(campaign, name, body.survey_entry)
    carried = campaign.bodies.get(campaign.carried_body or "")
    for camera in campaign.cameras.values():
        if carried is not None and camera.marks is not None:
            doubts += foreign_marks(camera, carried.file, set())
    return faults, doubts


def _survey(where: str, body: BodySource, source: ImageSource, entry: SurveyEntry) -> Doubts:
    faults: list[str] = []
    doubts: list[str] = []
    given = {t.id for t in body.file.targets if t.id is not None and t.xyz is not None}
    if isinstance(entry.datum, FixedDatum):
        missing = sorted(set(entry.datum.fixed) - given)
        if missing:
            faults.append(f"{where}: targets {missing} of the fixed datum have no coordinates: give xyz_mm")
    elif not entry.scale_bars and len(given) < 2:
        faults.append(
            f"{where}: nothing gives the scale: photograph a scale bar and list it under scale_bars, or give the "
            "coordinates (xyz_mm) of two targets"
        )
    elif not entry.scale_bars and body.file.board is None:
        doubts.append(
            f"{where}: no scale_bars: the scale will be that of the {len(given)} coordinates given in the file"
        )
    if len(source.names) < FEWEST_IMAGES:
        faults.append(f"{where}: {len(source.names)} images: at least {FEWEST_IMAGES} are needed, 20 to 60 are good")
    elif len(source.names) < FEW_IMAGES:
        doubts.append(f"{where}: {len(source.names)} images are few: take 20 to 60 from all around")
    if source.marks is not None:
        pairs = [*(bar.targets for bar in entry.scale_bars), *(length.targets for length in entry.check_lengths)]
        bars = {number for pair in pairs for number in pair}
        doubts += foreign_marks(source, body.file, bars)
        unseen = sorted(bars - set(source.marks.target.tolist()))
        if unseen:
            faults.append(f"{where}: targets {unseen} of known lengths are in no row of {source.marks.path}")
    return faults, doubts


def foreign_marks(source: ImageSource, body: BodyFile, others: set[int]) -> list[str]:
    """Ids of a table of marks and of a body that the other does not have: both lists."""
    if source.marks is None:
        return []
    listed = {t.id for t in body.targets if t.id is not None}
    return unmatched(str(source.marks.path), {int(i) for i in np.unique(source.marks.target)}, listed, others, body)


def unmatched(where: str, seen: set[int], listed: set[int], others: set[int], body: BodyFile) -> list[str]:
    """A sentence with both lists where what is seen and what a body lists differ."""
    strange, unseen = sorted(seen - listed - others), sorted(listed - seen)
    if not strange:
        return []
    return [
        f"{where}: targets {named(strange)} are not in {body.path}, which lists {named(sorted(listed))}"
        f"{f', of these {named(unseen)} are not seen' if unseen else ''}: correct the ids or the body file"
    ]


def named(ids: list[int]) -> str:
    """Ids for a sentence, the first of many."""
    return ", ".join(map(str, ids[:MOST_NAMED])) + (f", ... ({len(ids)} in all)" if len(ids) > MOST_NAMED else "")
