"""The chapters of the report in their order."""

from collections.abc import Callable, Iterator

from pipeline.report.blocks import Chapter
from pipeline.report.diagnosis_chapter import diagnosis_chapter
from pipeline.report.image_chapters import image_chapter, residual_chapter
from pipeline.report.material import Material
from pipeline.report.measurement_chapters import measurement_chapter
from pipeline.report.notes_chapter import files_chapter, rejected_chapter
from pipeline.report.parameter_chapter import parameter_chapter
from pipeline.report.survey_chapters import network_chapter, survey_chapter
from pipeline.report.verification_chapter import verification_chapter

_CHAPTERS: tuple[Callable[[Material], Chapter], ...] = (
    verification_chapter,
    diagnosis_chapter,
    parameter_chapter,
    measurement_chapter,
    survey_chapter,
    network_chapter,
    image_chapter,
    residual_chapter,
    rejected_chapter,
    files_chapter,
)


def all_chapters(material: Material) -> Iterator[Chapter]:
    """Chapters with whatever the run holds; those without blocks are to be left out."""
    return (make(material) for make in _CHAPTERS)
