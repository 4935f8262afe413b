"""Stage detect: every image -> targets with sub-pixel centres. Each image has its own cache by content."""

from dataclasses import dataclass
from pathlib import Path

from pipeline import codec
from pipeline.artifacts import DETECTED, detections
from pipeline.campaign import Campaign, ImageSource
from pipeline.campaign_schema import SurveyEntry
from pipeline.detected_images import DetectionIndex, ImageEntry, check_images, refuse_duplicate, refuse_unreadable
from pipeline.json_io import fingerprint
from pipeline.messages import track
from pipeline.parallel import in_processes
from pipeline.sources import code_version
from pipeline.stages.base import Context, Outcome, Stage
from pipeline.tiled_images import detect_tiled, tile_files
from robcal.errors import RobcalError
from robcal.files.body_file import BodyFile
from robcal.files.images import read_image
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import Detections
from robcal.imaging.settings import DetectionSettings
from robcal.photogrammetry.boards.detect import find_board
from robcal.photogrammetry.boards.layout import Board
from robcal.photogrammetry.tiles.transformation import Reseau
from robcal.recipe.detection import detection_settings

NAME = "detect"
CIRCLES = ("circles", "asymmetric_circles")


@dataclass(frozen=True)
class _Job:
    source: str
    name: str
    path: Path
    cache: str
    key: str
    settings: DetectionSettings
    board: Board | None
    reseau: Reseau | None = None


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
    use = campaign.entry.hand_eye
    if use is not None and campaign.hand_eye is not None and campaign.hand_eye.images.images:
        found[f"hand_eye/{use.camera.name}"] = (campaign.hand_eye.images, campaign.bodies[use.board].file, None)
    return found


def settings_for(body: BodyFile, survey: SurveyEntry | None) -> DetectionSettings:
    """What to look for in images of a body: those of a survey, or of a station."""
    return detection_settings(body, None if survey is None else survey.ends)


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
            if job.reseau is not None:
                found = detect_tiled(job.path, job.reseau, job.settings, job.board)
            elif job.board is None:
                found = detect_targets(read_image(job.path), job.settings)
            else:
                found = find_board(read_image(job.path), job.board, job.settings.polarity)
        except RobcalError as error:
            reported = str(error) if str(job.path) in str(error) else f"{job.path}: {error}"
            return ImageEntry(job.source, job.name, job.path, None, (0, 0), 0, 0, 0, reported)
        codec.save(path, found)
    height, width = found.shape
    read = int((found.code >= 0).sum())
    lit = int(found.saturated.sum())
    doubtful = int(found.contradicted.sum())
    return ImageEntry(
        job.source, job.name, job.path, job.key, (width, height), len(found), read, lit, found.message, doubtful
    )


def board_notes(body: BodyFile) -> list[str]:
    """What a board's file leaves open."""
    notes, board = [], body.board
    if board is not None and board.turns > 1:
        notes.append(f"{body.path}: {board.same_when_turned}")
    if board is not None and board.kind in CIRCLES and board.diameter is None:
        notes.append(
            f"{body.path}: the circles state no diameter_mm: their centres are not corrected for perspective, which "
            "moves tilted ones by hundredths of a pixel and more: measure one and state it"
        )
    return notes


def work(context: Context) -> Outcome:
    """Detect targets in all images of the campaign."""
    campaign, run = context.campaign, context.run
    jobs: list[_Job] = []
    hashes: dict[str, dict[str, str]] = {}
    version = code_version("pipeline.tiled_images", "robcal.photogrammetry.boards.detect")
    for source, (images, body, survey) in sources(campaign).items():
        settings = settings_for(body, survey)
        for name, path in images.images.items():
            content = run.hash(path)
            if images.reseau is not None:
                tiles = (*tile_files(path), *images.reseau_files)
                content = fingerprint(content, [run.hash(file) for file in tiles])
            refuse_duplicate(hashes.setdefault(source, {}), content, path)
            key = fingerprint(content, codec.encode([settings, body.board], {}), version)[:32]
            jobs.append(
                _Job(source, name, path, str(run.artifact(detections(key))), key, settings, body.board, images.reseau)
            )
    results = in_processes(_detect, jobs, context.workers)
    entries = list(track(results, len(jobs), "detecting targets"))
    refuse_unreadable(entries)
    notes = [
        note for source, (images, _, _) in sources(campaign).items() for note in check_images(source, images, entries)
    ]
    notes += [note for _, body, _ in sources(campaign).values() for note in board_notes(body)]
    notes += [entry.message for entry in entries if entry.targets and entry.message]
    index = DetectionIndex(tuple(entries))
    path = run.save(DETECTED, index)
    result = {
        "images": len(entries),
        "targets": sum(e.targets for e in entries),
        "codes": sum(e.codes for e in entries),
        "empty": [str(e.path) for e in entries if e.targets == 0],
    }
    return Outcome({"detection": result}, [path], notes)


def _tiles(images: ImageSource) -> list[Path]:
    """Files beside the lists of tiles."""
    if images.reseau is None:
        return []
    return [*images.reseau_files, *(file for path in images.images.values() for file in tile_files(path))]


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: bool(sources(campaign)),
    work=work,
    inputs=lambda campaign: [
        path
        for images, body, _ in sources(campaign).values()
        for path in (*images.images.values(), *_tiles(images), body.path)
    ],
    settings=lambda campaign: {
        source: [codec.encode([settings_for(body, survey), body.board], {}), list(images.images), images.size]
        for source, (images, body, survey) in sources(campaign).items()
    },
    after=(),
    module=__name__,
)
