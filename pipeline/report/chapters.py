"""The chapters of the report in their order."""

from collections.abc import Callable, Iterator
from dataclasses import replace

from pipeline.report.blocks import Chapter
from pipeline.report.diagnosis_chapter import diagnosis_chapter
from pipeline.report.hand_eye_chapter import hand_eye_chapter
from pipeline.report.image_chapters import image_chapter, residual_chapter
from pipeline.report.material import Material
from pipeline.report.measurement_chapters import measurement_chapter
from pipeline.report.notes_chapter import files_chapter, rejected_chapter
from pipeline.report.parameter_chapter import parameter_chapter
from pipeline.report.survey_chapters import network_chapter, survey_chapter
from pipeline.report.verification_chapter import verification_chapter
from pipeline.report.workspace_chapter import workspace_chapter

_RESULTS: tuple[Callable[[Material], Chapter], ...] = (
    hand_eye_chapter,
    verification_chapter,
    workspace_chapter,
    diagnosis_chapter,
    rejected_chapter,
    files_chapter,
)
_APPENDIX: tuple[Callable[[Material], Chapter], ...] = (
    parameter_chapter,
    measurement_chapter,
    survey_chapter,
    network_chapter,
    image_chapter,
    residual_chapter,
)


def all_chapters(material: Material) -> Iterator[Chapter]:
    """Results first, then the evidence as an appendix; chapters without blocks are to be left out."""
    yield from (make(material) for make in _RESULTS)
    yield from (replace(make(material), appendix=True) for make in _APPENDIX)
