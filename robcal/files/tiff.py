"""What the tags of a TIFF file say before it is decoded (TIFF revision 6.0, Adobe 1992; BigTIFF).

Orientation tags are ignored as in other formats: pixels count as they are stored, so that all images of a camera agree.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from robcal.errors import InvalidInput

MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
SUBFILE, BITS, PHOTOMETRIC, ORIENTATION, SAMPLES, CFA = 254, 258, 262, 274, 277, 33421
WIDTH, LENGTH = 256, 257
WHITE_IS_ZERO, BLACK_IS_ZERO, MOSAIC, LINEAR_RAW = 0, 1, 32803, 34892
MOST_PAGES = 1000
_WIDTH = {3: "H", 4: "I", 16: "Q", 1: "B"}


@dataclass(frozen=True)
class _Page:
    """Offset of a directory, and by tag the first value, its place in the file and its format."""

    offset: int
    first: Mapping[int, tuple[int, int, str]]

    def value(self, tag: int, default: int) -> int:
        return self.first[tag][0] if tag in self.first else default

    @property
    def whole(self) -> bool:
        """Neither a thumbnail nor a mask."""
        return not self.value(SUBFILE, 0) & 0b101


def plain_tiff(path: Path, raw: bytes) -> tuple[bytes, bool]:
    """The file so that any decoder yields the pixels of its one full image as stored; true if white is zero in it.

    Raises
    ------
    InvalidInput : several images in one file, or a colour mosaic as it comes from the sensor.
    """
    try:
        order, pages = _pages(raw)
    except struct.error:
        return raw, False  # cut off: the decoder says so
    whole = [page for page in pages if page.whole]
    if any(page.value(PHOTOMETRIC, 1) in (MOSAIC, LINEAR_RAW) or CFA in page.first for page in pages):
        raise InvalidInput(
            f"{path}: holds the colour mosaic of the sensor (Bayer pattern): develop it to grey values, or record grey"
        )
    if len(whole) > 1:
        raise InvalidInput(f"{path}: holds {len(whole)} images (pages): save one image a file")
    if not whole:
        return raw, False
    page, out = whole[0], bytearray(raw)
    big = raw[2:4] in (b"+\0", b"\0+")
    struct.pack_into(order + ("Q" if big else "I"), out, 8 if big else 4, page.offset)
    inverted = (
        page.value(PHOTOMETRIC, BLACK_IS_ZERO) == WHITE_IS_ZERO
        and page.value(SAMPLES, 1) == 1
        and page.value(BITS, 1) in (8, 16)
    )
    for tag, wanted, wrong in ((ORIENTATION, 1, True), (PHOTOMETRIC, BLACK_IS_ZERO, inverted)):
        if wrong and tag in page.first:
            _, place, kind = page.first[tag]
            struct.pack_into(order + kind, out, place, wanted)
    return bytes(out), inverted


def tiff_size(raw: bytes) -> tuple[int, int, int]:
    """Width, height and bytes a pixel of the largest image that a file declares; zeros where it declares none."""
    try:
        _, pages = _pages(raw)
    except struct.error:
        return 0, 0, 1
    sizes = [
        (p.value(WIDTH, 0), p.value(LENGTH, 0), p.value(SAMPLES, 1) * max(p.value(BITS, 8) // 8, 1)) for p in pages
    ]
    return max(sizes, key=lambda size: size[0] * size[1] * size[2], default=(0, 0, 1))


def _pages(raw: bytes) -> tuple[str, list[_Page]]:
    order = "<" if raw[:2] == b"II" else ">"
    big = raw[2:4] in (b"+\0", b"\0+")
    word, counter, entry, start = ("Q", "Q", 20, 8) if big else ("I", "H", 12, 4)
    (offset,) = struct.unpack_from(order + word, raw, start)
    pages: list[_Page] = []
    seen: set[int] = set()
    while offset and offset not in seen and len(pages) < MOST_PAGES:
        seen.add(offset)
        (count,) = struct.unpack_from(order + counter, raw, offset)
        at = offset + struct.calcsize(order + counter)
        if at + count * entry > len(raw):
            raise struct.error("directory beyond the end of the file")
        first = {}
        for k in range(count):
            place = at + k * entry
            tag, kind, number = struct.unpack_from(f"{order}HH{word}", raw, place)
            if kind not in _WIDTH:
                continue
            value_at = place + 4 + struct.calcsize(order + word)
            if number * struct.calcsize(order + _WIDTH[kind]) > struct.calcsize(order + word):
                (value_at,) = struct.unpack_from(order + word, raw, value_at)
            if value_at + struct.calcsize(order + _WIDTH[kind]) <= len(raw):
                first[tag] = (struct.unpack_from(order + _WIDTH[kind], raw, value_at)[0], value_at, _WIDTH[kind])
        pages.append(_Page(offset, first))
        (offset,) = struct.unpack_from(order + word, raw, at + count * entry)
    return order, pages
