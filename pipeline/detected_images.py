"""Images in which targets were detected: their list, what they hold, and what speaks against them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.artifacts import detections
from pipeline.campaign import ImageSource
from pipeline.runs import Run
from robcal.errors import InvalidInput
from robcal.imaging.detections import Detections


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


def refuse_duplicate(seen: dict[str, str], content: str, path: Path) -> None:
    """Refuse an image whose content was seen before."""
    if content in seen:
        raise InvalidInput(f"{path}: byte for byte the same image as {seen[content]}: one of them is a copy, remove it")
    seen[content] = str(path)


def refuse_unreadable(entries: Sequence[ImageEntry]) -> None:
    """Refuse images that could not be read."""
    bad = [entry for entry in entries if entry.key is None]
    if bad:
        more = f" ({len(bad)} such images: {', '.join(e.path.name for e in bad[:5])})" if len(bad) > 1 else ""
        raise InvalidInput(f"{bad[0].message}{more}")


def check_images(source: str, images: ImageSource, entries: Sequence[ImageEntry]) -> list[str]:
    """Notes on the images of a source.

    Raises
    ------
    InvalidInput : images of several sizes, or no target in any of them.
    """
    own = [entry for entry in entries if entry.source == source]
    typical = Counter(entry.size for entry in own).most_common(1)[0][0]
    expected = images.size or typical
    odd = [entry for entry in own if entry.size != expected]
    if odd:
        path, size = odd[0].path, odd[0].size
        why = f"camera file {images.start_path} says" if images.start_path else f"the other {source} images have"
        count = f" ({len(odd)} such images)" if len(odd) > 1 else ""
        raise InvalidInput(
            f"{path}: {size[0]} x {size[1]} px, but {why} {expected[0]} x {expected[1]}{count}: one camera takes "
            "images of one size, remove the others or correct the camera file"
        )
    empty = [entry for entry in own if entry.targets == 0]
    if len(empty) == len(own):
        why = next((f" ({entry.message})" for entry in empty if entry.message), "")
        raise InvalidInput(
            f"{own[0].path.parent}: no targets found in any of {len(own)} images{why}: check exposure, focus and that "
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
