"""The report of a run: one HTML file without any outside resource, readable in a minute, printable."""

from pathlib import Path

from pipeline.report.chapters import all_chapters
from pipeline.report.material import Material
from pipeline.report.page import provenance, render
from pipeline.report.verdict import verdict_of
from pipeline.runs import Run
from robcal.files.storage import write_text


def write_report(run: Run) -> Path:
    """Write report.html from what lies in the run folder; returns its path.

    Raises
    ------
    StorageError : the disk is full or permission is missing.
    """
    material = Material(run)
    chapters = [chapter for chapter in all_chapters(material) if chapter.blocks]
    write_text(
        run.report, render(material.name, verdict_of(material), chapters, provenance(material), material.all_poses)
    )
    return run.report


__all__ = ["write_report"]
