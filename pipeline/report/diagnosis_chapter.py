"""Chapter: what the model left out, how it is known, and what would settle what is open."""

from __future__ import annotations

from pipeline.report.blocks import Block, Chapter, Text
from pipeline.report.material import Material


def diagnosis_chapter(material: Material) -> Chapter:
    """One part for every cause."""
    blocks: list[Block] = []
    if material.diagnosis is not None:
        blocks.append(Text(str(material.diagnosis.get("statement", "")), "lead"))
    return Chapter("diagnosis", "What the model left out", "", tuple(blocks))
