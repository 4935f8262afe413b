"""Stage detect: every image -> targets with sub-pixel centres. Each image has its own cache by content."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline import codec
from pipeline.artifacts import DETECTED, detections
from pipeline.campaign import Campaign, ImageSource
from pipeline.campaign_schema import SurveyEntry
from pipeline.json_io import fingerprint
from pipeline.messages import track
from pipeline.parallel import in_processes
from pipeline.runs import Run
from pipeline.sources import code_version
from pipeline.stages.base import Context, Outcome, Stage
from robcal.errors import InvalidInput, RobcalError
from robcal.files.body_file import BodyFile
from robcal.files.images import read_image
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import Detections
from robcal.imaging.settings import DetectionSettings
from robcal.photogrammetry.boards.detect import find_board
from robcal.photogrammetry.boards.layout import Board

NAME = "detect"
_MANY = 12


@dataclass(frozen=True)
class ImageEntry:
    """What became of one image.

    Attributes
    ----------
    source : ``survey/<body>`` or ``station/<camera>``; name : image name (for a station the pose id).
    key : name of its detections in the cache, None if it could not be read; size : (width, height).
    contradicted : targets whose contour has another centre than the fit to their grey values.
    message : why there is nothing in it, or why it could not be read.
    """

    source: str
    name: str
    path: Path
    key: str | None
    size: tuple[int, int]
    targets: int
    codes: int
    saturated: int
    message: str = ""
    contradicted: int = 0


@dataclass(frozen=True)
class DetectionIndex:
    """All images of a campaign."""

    entries: tuple[ImageEntry, ...] = field(repr=False)

    def of(self, source: str) -> tuple[ImageEntry, ...]:
        """The images of one source."""
        return tuple(entry for entry in self.entries if entry.source == source)


@dataclass(frozen=True)
class _Job:
    source: str
    name: str
    path: Path
    cache: str
    key: str
    settings: DetectionSettings
    board: Board | None


def sources(campaign: Campaign) -> dict[str, tuple[ImageSource, BodyFile, SurveyEntry | None]]:
    """Image sources of a campaign by name, with the body that is to be seen."""
    found: dict[str, tuple[ImageSource, BodyFile, SurveyEntry | None]] = {}
    for name, body in campaign.bodies.items():
        if body.survey is not None and body.survey.images:
            found[f"survey/{name}"] = (body.survey, body.file, body.survey_entry)
    if campaign.entry.station is not None:
        body_file = campaign.bodies[campaign.entry.station.body].file
        for name, camera in campaign.cameras.items():
            if camera.images:
                found[f"station/{name}"] = (camera, body_file, None)
    return found


def settings_for(body: BodyFile, survey: SurveyEntry | None) -> DetectionSettings:
    """What to look for in images of a body.

    Raises
    ------
    InvalidInput : two dictionaries of markers on one body.
    """
    codes = [t.code for t in body.targets]
    dictionaries = sorted({c.removeprefix("aruco:") for c in codes if c is not None and c.startswith("aruco:")})
    if len(dictionaries) > 1:
        raise InvalidInput(f"{body.path}: markers of several dictionaries ({', '.join(dictionaries)}): use one")
    ring = {t.id for t in body.targets if t.code == "ring12" and t.id is not None}
    lengths = [*(survey.scale_bars if survey else ()), *(survey.check_lengths if survey else ())]
    known = ring | {number for length in lengths for number in length.targets}
    polarities = {t.polarity for t in body.targets}
    if len(polarities) > 1:
        raise InvalidInput(f"{body.path}: bright and dark targets on one body: one polarity is needed")
    return DetectionSettings(
        polarity="dark" if polarities == {"dark"} else "bright",
        ring12=bool(known) or not any(codes),
        known_codes=frozenset(known) if ring else None,
        aruco=dictionaries[0] if dictionaries else None,
        # many uncoded dots are found by their arrangement: then a rough centre is better than none
        coarse=survey is None and not any(codes) and len(codes) >= _MANY,
    )


def _detect(job: _Job) -> ImageEntry:
    """One image, in a worker process: from the cache if it is there."""
    path = Path(job.cache)
    found: Detections | None = None
    if path.is_file():
        try:
            found = codec.load(path)
        except codec.StaleCache:
            found = None  # damaged: detect again
    if found is None:
        try:
            image = read_image(job.path)
            if job.board is None:
                found = detect_targets(image, job.settings)
            else:
                found = find_board(image, job.board, job.settings.polarity)
        except RobcalError as error:
            told = str(error) if str(job.path) in str(error) else f"{job.path}: {error}"
            return ImageEntry(job.source, job.name, job.path, None, (0, 0), 0, 0, 0, told)
        codec.save(path, found)
    height, width = found.shape
    read = int((found.code >= 0).sum())
    lit = int(found.saturated.sum())
    doubtful = int(found.contradicted.sum())
    return ImageEntry(
        job.source, job.name, job.path, job.key, (width, height), len(found), read, lit, found.message, doubtful
    )


def work(context: Context) -> Outcome:
    """Detect targets in all images of the campaign."""
    campaign, run = context.campaign, context.run
    jobs: list[_Job] = []
    hashes: dict[str, dict[str, str]] = {}
    version = code_version("robcal.files.images", "robcal.photogrammetry.boards.detect")
    for source, (images, body, survey) in sources(campaign).items():
        settings = settings_for(body, survey)
        for name, path in images.images.items():
            content = run.hash(path)
            _refuse_duplicate(hashes.setdefault(source, {}), content, path)
            key = fingerprint(content, codec.encode([settings, body.board], {}), version)[:32]
            jobs.append(_Job(source, name, path, str(run.artifact(detections(key))), key, settings, body.board))
    results = in_processes(_detect, jobs, context.workers)
    entries = list(track(results, len(jobs), "detecting targets"))
    _refuse_unreadable(entries)
    notes = [note for source, (images, _, _) in sources(campaign).items() for note in _check(source, images, entries)]
    notes += [
        f"{body.path}: {body.board.same_when_turned}"
        for _, body, _ in sources(campaign).values()
        if body.board is not None and body.board.turns > 1
    ]
    index = DetectionIndex(tuple(entries))
    path = run.save(DETECTED, index)
    result = {
        "images": len(entries),
        "targets": sum(e.targets for e in entries),
        "codes": sum(e.codes for e in entries),
        "empty": [str(e.path) for e in entries if e.targets == 0],
    }
    return Outcome({"detection": result}, [path], notes)


def _refuse_duplicate(seen: dict[str, str], content: str, path: Path) -> None:
    if content in seen:
        raise InvalidInput(f"{path}: byte for byte the same image as {seen[content]}: one of them is a copy, remove it")
    seen[content] = str(path)


def _refuse_unreadable(entries: Sequence[ImageEntry]) -> None:
    bad = [entry for entry in entries if entry.key is None]
    if bad:
        more = f" ({len(bad)} such images: {', '.join(e.path.name for e in bad[:5])})" if len(bad) > 1 else ""
        raise InvalidInput(f"{bad[0].message}{more}")


def _check(source: str, images: ImageSource, entries: Sequence[ImageEntry]) -> list[str]:
    own = [entry for entry in entries if entry.source == source]
    usual = Counter(entry.size for entry in own).most_common(1)[0][0]
    expected = images.size or usual
    odd = [entry for entry in own if entry.size != expected]
    if odd:
        path, size = odd[0].path, odd[0].size
        why = f"camera file {images.start_path} says" if images.start_path else f"the other {source} images have"
        count = f" ({len(odd)} such images)" if len(odd) > 1 else ""
        raise InvalidInput(
            f"{path}: {size[0]} x {size[1]} px, but {why} {expected[0]} x {expected[1]}{count}: one camera takes "
            "images of one size, remove the strangers or correct the camera file"
        )
    empty = [entry for entry in own if entry.targets == 0]
    if len(empty) == len(own):
        told = next((f" ({entry.message})" for entry in empty if entry.message), "")
        raise InvalidInput(
            f"{own[0].path.parent}: no targets found in any of {len(own)} images{told}: check exposure, focus and that "
            "these are images of the body (bright dots on dark ground unless 'polarity: dark')"
        )
    notes = [f"{entry.path}: {entry.message or 'no targets found'}: the image is left out" for entry in empty]
    if doubtful := [entry for entry in own if entry.contradicted]:
        total, worst = sum(e.contradicted for e in doubtful), max(doubtful, key=lambda e: e.contradicted)
        notes.append(
            f"{source}: {total} dots in {len(doubtful)} of {len(own)} images have a contour with another centre than "
            f"their grey values (dirt, reflections, half covered?), most in {worst.path.name}"
        )
    return notes


def load_detections(run: Run, index: DetectionIndex, source: str) -> dict[str, Detections]:
    """Image name -> targets of one source, images without targets left out."""
    return {e.name: run.load(detections(e.key)) for e in index.of(source) if e.key is not None and e.targets}


def sizes(index: DetectionIndex, source: str) -> tuple[int, int]:
    """(width, height) of the images of one source."""
    return index.of(source)[0].size


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: bool(sources(campaign)),
    work=work,
    inputs=lambda campaign: [
        path for images, body, _ in sources(campaign).values() for path in (*images.images.values(), body.path)
    ],
    settings=lambda campaign: {
        source: [codec.encode([settings_for(body, survey), body.board], {}), list(images.images), images.size]
        for source, (images, body, survey) in sources(campaign).items()
    },
    after=(),
    module=__name__,
)
