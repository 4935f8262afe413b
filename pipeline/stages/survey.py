"""Stage survey: bundle adjustment of each body that was photographed, with self-calibration of the camera."""

from collections import Counter
from typing import Any

import numpy as np

from pipeline import artifacts
from pipeline.campaign import BodySource, Campaign, ImageSource
from pipeline.campaign_schema import CheckLengthEntry, FixedDatum, ScaleBarEntry, SurveyEntry
from pipeline.detected_images import load_detections, sizes
from pipeline.result_sections import survey_notes, survey_section
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage
from robcal.errors import InvalidInput, RobcalError, located
from robcal.files.body_file import BodyFile, write_body
from robcal.files.camera_file import CameraFile, write_camera
from robcal.photogrammetry.bundle.colmap_engine import export_colmap
from robcal.photogrammetry.core.adjustable import adjustable_names
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.core.network import Lengths
from robcal.photogrammetry.survey.given_coordinates import GivenCoordinates, compare_given
from robcal.photogrammetry.survey.splined_lens import SplinedSurvey, with_splined_lens
from robcal.photogrammetry.survey.survey import SurveyImage, SurveyResult, survey_body
from robcal.recipe.survey import hardly_seen, marks_by_image, size_of_marks, survey_targets, surveyed_body

NAME = "survey"


def work(context: Context) -> Outcome:
    """Survey the bodies, or the one that was asked for."""
    campaign, run = context.campaign, context.run
    outputs, notes, results = [], [], {}
    for name, source in campaign.bodies.items():
        if source.survey is None or source.survey_entry is None or (context.body and name != context.body):
            continue
        done, splined = survey_one(campaign, run, name, source)
        body = surveyed_body(name, source.file, done, _not_on_it(campaign, run, name, source))
        outputs += [run.save(artifacts.survey(name), done), run.save(artifacts.surveyed_body(name), body)]
        outputs += _write(run, name, source, body, done)
        notes += [f"survey of '{name}': {note}" for note in survey_notes(done)]
        doubts = _against_given(campaign, source, done)
        notes += doubts.sentences(name)
        if splined is not None:
            notes.append(f"survey of '{name}': {_told(splined)}")
        results[name] = survey_section(done) | {
            "splined_lens": None
            if splined is None
            else {"rms_px": splined.field.rms, "z": splined.field.z, "sigma0_px_before": splined.before},
            "contradictions": doubts.sentences(name),
            "mirrored_mm": doubts.mirrored_mm,
        }
    return Outcome({"survey": results}, outputs, notes)


def survey_one(
    campaign: Campaign, run: Run, name: str, source: BodySource
) -> tuple[SurveyResult, SplinedSurvey | None]:
    """Survey one body, with a splined lens where the residuals ask for it.

    Raises
    ------
    RobcalError : with the name of the body and its files in the message.
    """
    entry, images_of = source.survey_entry, source.survey
    if entry is None or images_of is None:
        raise InvalidInput(f"{campaign.path}: body '{name}' has no survey")
    check_lengths(campaign, name, entry)
    images, size = _images(run, name, images_of, source.file)
    datum = tuple(entry.datum.fixed) if isinstance(entry.datum, FixedDatum) else entry.datum
    engine = campaign.entry.bundle.engine

    def survey(camera: Camera | None) -> SurveyResult:
        return survey_body(
            images,
            survey_targets(source.file, entry.ends),
            size=size,
            camera=camera,
            scale_bars=lengths(entry.scale_bars),
            check_lengths=lengths(entry.check_lengths),
            datum=datum,
            engine=engine,
        )

    try:
        done = survey(images_of.start.camera if images_of.start else None)
        splined = with_splined_lens(done, survey) if engine == "robcal" else None
        return (done if splined is None else splined.result), splined
    except RobcalError as error:
        raise located(error, f"{campaign.path}: survey of body '{name}'") from None


def _told(splined: SplinedSurvey) -> str:
    field = splined.field
    return (
        f"the residuals have a pattern over the image that Brown's lens cannot have ({field.rms:.2g} px RMS, "
        f"{field.z:.1f} standard deviations on images that did not make it): a splined lens takes it up, residuals "
        f"{splined.before:.3g} -> {splined.result.network.sigma0_px:.3g} px"
    )


def _against_given(campaign: Campaign, source: BodySource, done: SurveyResult) -> GivenCoordinates:
    """The given coordinates beside the surveyed ones.

    Raises
    ------
    InvalidInput : they are mirror images, and no robot is there to tell which of them is right.
    """
    listed = {t.id: t for t in source.file.targets if t.id is not None and t.xyz is not None}
    ids = done.network.ids
    given = np.array([listed[int(i)].xyz if int(i) in listed else (np.nan,) * 3 for i in ids], dtype=float)
    stated = [listed[int(i)].sigma if int(i) in listed else None for i in ids]
    sigma = np.array([np.nan if s is None else max(s) for s in stated])
    found = compare_given(ids, done.network.points, given.reshape(-1, 3), sigma)
    if found.mirrored is not None and (campaign.robot is None or campaign.entry.station is None):
        raise InvalidInput(
            f"{source.file.path}: {found.mirror_words}: either the image axes are mirrored (y counted upwards, or x to "
            "the left) or these coordinates are (a column with the wrong sign, a left-handed system): correct one"
        )
    return found


def lengths(entries: list[ScaleBarEntry] | list[CheckLengthEntry]) -> Lengths | None:
    """Known lengths in metres; sigma NaN where none is stated."""
    if not entries:
        return None
    return Lengths(
        np.array([e.targets for e in entries], dtype=np.int64),
        np.array([e.length_mm / 1000 for e in entries]),
        np.array([np.nan if e.sigma_mm is None else e.sigma_mm / 1000 for e in entries]),
    )


def check_lengths(campaign: Campaign, name: str, entry: SurveyEntry) -> None:
    """The same distance stated twice with different lengths is a contradiction of the file itself."""
    seen: dict[tuple[int, ...], tuple[float, int]] = {}
    for i, bar in enumerate(entry.scale_bars):
        pair = tuple(sorted(bar.targets))
        line = campaign.document.line(("bodies", name, "survey", "scale_bars", i)) or 0
        if pair in seen and abs(seen[pair][0] - bar.length_mm) > 1e-9:
            raise InvalidInput(
                f"{campaign.path}, line {line}: scale bar {list(bar.targets)} is {bar.length_mm:g} mm here and "
                f"{seen[pair][0]:g} mm in line {seen[pair][1]}: keep the right one"
            )
        seen[pair] = (bar.length_mm, line)


def _images(run: Run, name: str, source: ImageSource, file: BodyFile) -> tuple[list[SurveyImage], tuple[int, int]]:
    if source.marks is not None:
        return marks_by_image(source.marks), source.size or size_of_marks(source.marks)
    index = run.load(artifacts.DETECTED)
    key = f"survey/{name}"
    found = load_detections(run, index, key)
    return [SurveyImage(image, detections=targets) for image, targets in found.items()], sizes(index, key)


def _not_on_it(campaign: Campaign, run: Run, name: str, source: BodySource) -> frozenset[int]:
    """Targets of scale bars that the body file lists without coordinates and that the station (nearly) never sees.

    A file may list the targets of scale bars (without coordinates): they were photographed with the body but are not on
    it. A known distance between two of the body's own targets is stated in the same words; the station's images tell:
    one that is on the body is seen about as often as the others, a misread code now and then.
    """
    entry, station = source.survey_entry, campaign.entry.station
    if entry is None or station is None or station.body != name:
        return frozenset()
    ends = entry.ends
    bare = ends & {t.id for t in source.file.targets if t.id is not None and t.xyz is None}
    seen: Counter[int] = Counter()
    if bare and any(camera.images for camera in campaign.cameras.values()):
        index = run.load(artifacts.DETECTED)
        for camera in campaign.cameras:
            for found in load_detections(run, index, f"station/{camera}").values():
                seen.update(set(found.code.tolist()))
    for images in campaign.cameras.values():
        if images.marks is not None:
            seen.update(images.marks.target.tolist())
    own = [t.id for t in source.file.targets if t.id is not None and t.code is not None and t.id not in ends]
    return hardly_seen(bare, seen, own)


def _write(run: Run, name: str, source: BodySource, body: Body, done: SurveyResult) -> list[Any]:
    comment = f"surveyed: {done.frame}; {done.scale}"
    write_body(run.body(name), body, comment, source.file.board, source.file.ring)
    sigma = np.sqrt(np.clip(np.diag(done.network.intrinsics_covariance), 0, None))
    start = source.survey.start if source.survey is not None else None
    pixel = start.pixel_um if start is not None else None
    if type(done.network.camera) is Camera:  # COLMAP's model here has Brown's terms
        run.colmap(name).mkdir(parents=True, exist_ok=True)
        export_colmap(done.network, run.colmap(name))
    sigmas = dict(zip(INTRINSIC_NAMES, map(float, sigma), strict=True))
    own = {n: sigmas[n] for n in adjustable_names(done.network.camera)}
    camera = CameraFile(done.network.camera, None, pixel, own)
    path = run.camera(f"{NAME}_{name}")
    write_camera(path, camera, f"self-calibrated in the survey of {name}")
    return [run.body(name), path]


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: any(body.survey is not None for body in campaign.bodies.values()),
    work=work,
    inputs=lambda campaign: [
        path
        for body in campaign.bodies.values()
        if body.survey is not None
        for path in (
            body.file.path,
            *([body.survey.marks.path] if body.survey.marks else []),
            *([body.survey.start_path] if body.survey.start_path else []),
        )
    ],
    settings=lambda campaign: campaign.entry.model_dump(include={"bodies", "bundle"}),
    after=("detect",),
    module=__name__,
)
