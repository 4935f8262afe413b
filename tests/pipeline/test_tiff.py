"""Tags of TIFF files: pixels as they are stored, whatever the tags; what is no single grey image is told."""

import struct
from pathlib import Path

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.files.images import read_image

Tags = dict[int, int]


def _page(order: str, big: bool, image: np.ndarray, tags: Tags, at: int, last: bool) -> bytes:
    """Directory and pixels of one page that begins at the byte ``at``."""
    word, counter, entry = ("Q", "Q", 20) if big else ("I", "H", 12)
    depth = image.dtype.itemsize
    data = image.astype(image.dtype.newbyteorder(order)).tobytes()
    h, w = image.shape
    known = {256: w, 257: h, 258: 8 * depth, 259: 1, 262: 1, 273: 0, 277: 1, 278: h, 279: len(data), **tags}
    size = struct.calcsize(order + counter) + len(known) * entry + struct.calcsize(order + word)
    known[273] = at + size
    end = at + size + len(data) + len(data) % 2
    out = struct.pack(order + counter, len(known))
    for tag in sorted(known):
        kind = 4 if tag in (256, 257, 273, 278, 279, 254) else 3
        value = struct.pack(order + ("I" if kind == 4 else "H"), known[tag])
        out += struct.pack(f"{order}HH{word}", tag, kind, 1) + value.ljust(struct.calcsize(order + word), b"\0")
    out += struct.pack(order + word, 0 if last else end)
    return out + data + b"\0" * (len(data) % 2)


def _write(path: Path, pages: list[tuple[np.ndarray, Tags]], order: str = "<", big: bool = False) -> Path:
    head = b"II" if order == "<" else b"MM"
    raw = head + (struct.pack(f"{order}HHHQ", 43, 8, 0, 16) if big else struct.pack(f"{order}HI", 42, 8))
    for k, (image, tags) in enumerate(pages):
        raw += _page(order, big, image, tags, len(raw), k == len(pages) - 1)
    path.write_bytes(raw)
    return path


def _image(dtype: type) -> np.ndarray:
    top = np.iinfo(dtype).max
    return (np.arange(12 * 16).reshape(12, 16) * (top // 200)).astype(dtype)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("white", [0, 1])
def test_pixels_are_those_stored(
    tmp_path: Path, orientation: int, dtype: type, order: str, big: bool, white: int
) -> None:
    image = _image(dtype)
    stored = np.iinfo(dtype).max - image if white == 0 else image
    path = _write(tmp_path / "a.tif", [(stored, {274: orientation, 262: white})], order, big)
    assert np.array_equal(read_image(path), image)
    assert read_image(path).dtype == dtype


def test_a_thumbnail_before_the_image(tmp_path: Path) -> None:
    image = _image(np.uint16)
    path = _write(tmp_path / "a.tif", [(image[::4, ::4].copy(), {254: 1}), (image, {254: 0})])
    assert np.array_equal(read_image(path), image)


def test_pages_and_mosaics_are_told(tmp_path: Path) -> None:
    image = _image(np.uint8)
    with pytest.raises(InvalidInput, match=r"a\.tif: holds 2 images .* one image a file"):
        read_image(_write(tmp_path / "a.tif", [(image, {}), (image, {})]))
    with pytest.raises(InvalidInput, match=r"b\.tif: holds the colour mosaic"):
        read_image(_write(tmp_path / "b.tif", [(image, {262: 32803})]))
    scene = np.full((64, 96), 100, np.uint8) + (np.arange(96) // 8).astype(np.uint8)
    assert np.array_equal(read_image(_write(tmp_path / "c.tif", [(scene, {})])), scene)
    scene[::2, ::2] //= 2
    scene[1::2, 1::2] //= 3
    with pytest.raises(InvalidInput, match=r"d\.tif: neighbouring pixels differ like the colours"):
        read_image(_write(tmp_path / "d.tif", [(scene, {})]))


def test_a_directory_beyond_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(b"II*\0" + struct.pack("<I", 900) + b"\0" * 40)
    with pytest.raises(InvalidInput, match=r"a\.tif"):
        read_image(path)
