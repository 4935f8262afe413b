"""A look into some images of every source: can they be read, and do they show the body that the campaign names?"""

import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.campaign import Campaign, ImageSource
from pipeline.campaign_schema import SurveyEntry
from pipeline.checking.joints import Doubts
from pipeline.checking.surveys import named
from pipeline.stages.detect import settings_for, sources
from pipeline.tiled_images import tile_files
from robcal.errors import InvalidInput, RobcalError
from robcal.files.body_file import BodyFile
from robcal.files.images import check_image_file, read_image
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import CodeState

LOOKED_AT = 4
SECONDS = 20.0
"""Time for the looks into one source's images."""
FEWEST_CODES = 3
"""Codes of the body that must be read among all images looked at."""


def image_doubts(campaign: Campaign) -> Doubts:
    """Faults and doubts of all image sources."""
    faults: list[str] = []
    doubts: list[str] = []
    station = campaign.entry.station
    if station is not None and station.body not in campaign.bodies:
        campaign = replace(campaign, entry=campaign.entry.model_copy(update={"station": None}))
    for source, (images, body, survey) in sources(campaign).items():
        faults += _headers(images)
        if body.board is not None or images.reseau is not None:
            continue  # found by its own detector, or tile by tile
        wrong, doubtful = _source_doubts(source, images, body, survey)
        faults += wrong
        doubts += doubtful
    return faults, doubts


def _headers(images: ImageSource) -> list[str]:
    """Files that are no images, cut off, or too large; of many as far as the time goes."""
    faults = []
    begin = time.monotonic()
    for path in images.images.values():
        try:
            for file in [path] if images.reseau is None else tile_files(path):
                check_image_file(file)
        except InvalidInput as error:
            faults.append(str(error))
        if time.monotonic() - begin > SECONDS:
            break
    return faults


def _source_doubts(source: str, images: ImageSource, body: BodyFile, survey: SurveyEntry | None) -> Doubts:
    settings = replace(settings_for(body, survey), known_codes=None)
    paths = list(images.images.values())
    chosen = [paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, LOOKED_AT).astype(int))]
    faults: list[str] = []
    seen: Counter[int] = Counter()
    sizes: dict[tuple[int, int], Path] = {}
    dots = examined = 0
    begin = time.monotonic()
    for path in chosen:
        try:
            image = read_image(path)
            sizes.setdefault((image.shape[1], image.shape[0]), path)
            found = detect_targets(image, settings)
        except RobcalError as error:
            faults.append(str(error) if str(path) in str(error) else f"{path}: {error}")
            continue
        examined += 1
        dots += len(found)
        seen.update({int(code) for code in found.code[found.code_state == CodeState.READ]})
        if time.monotonic() - begin > SECONDS:
            break
    faults += _sizes(images, sizes)
    if not examined:
        return faults, []
    if not dots:
        return faults, [
            f"{chosen[0].parent}: no targets found in any of the {examined} images looked at: check exposure, focus "
            "and that these are images of the body (bright dots on dark ground unless 'polarity: dark')"
        ]
    wrong, doubtful = _codes(chosen[0].parent, seen, examined, body, survey)
    return [*faults, *wrong], doubtful


def _sizes(images: ImageSource, sizes: dict[tuple[int, int], Path]) -> list[str]:
    expected = images.size or next(iter(sizes), None)
    where = f"camera file {images.start_path} says" if images.start_path else "others have"
    return [
        f"{path}: {size[0]} x {size[1]} px, but {where} {expected[0]} x {expected[1]}: one camera takes images of one "
        "size, remove the others or correct the camera file"
        for size, path in sizes.items()
        if expected is not None and size != expected
    ]


def _codes(folder: Path, seen: Counter[int], examined: int, body: BodyFile, survey: SurveyEntry | None) -> Doubts:
    """Codes read against those listed: both lists where they do not fit."""
    listed = {t.id for t in body.targets if t.code not in (None, "corner", "circle") and t.id is not None}
    if not listed:
        return [], []
    lengths = [*(survey.scale_bars if survey else ()), *(survey.check_lengths if survey else ())]
    others = {number for length in lengths for number in length.targets}
    # a code that is read in one image alone may be a misreading
    sure = {code for code, count in seen.items() if count > 1 or examined == 1}
    strange, fitting = sorted(sure - listed - others), sorted(set(seen) & listed)
    unseen = sorted(listed - set(seen))
    lists = (
        f"read in {examined} images: {named(sorted(seen)) or 'none'}; listed in {body.path}: {named(sorted(listed))}; "
        f"listed but not read: {named(unseen) or 'none'}"
    )
    if len(fitting) < min(FEWEST_CODES, len(listed)):
        remedy = "name the body file that belongs to these images, or correct its ids and 'code'"
        return [f"{folder}: the images do not show the targets of {body.path} ({lists}): {remedy}"], []
    if strange:
        remedy = f"list {named(strange)} in the body file if they are on the body"
        return [], [f"{folder}: codes that no file lists are read ({lists}): {remedy}"]
    return [], []
