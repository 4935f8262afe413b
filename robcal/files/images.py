"""Image files: listing a folder, reading grey values of 8 or 16 bit, telling broken files."""

import os
import re
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.files.storage import read_bytes
from robcal.files.tiff import MAGIC, plain_tiff, tiff_size

SUFFIXES = frozenset({".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp"})
MAX_BYTES = 1_500_000_000
MAX_PIXELS = 400_000_000
MAX_DECODED_BYTES = 1_000_000_000

TILES, LIT, COLOURED = 4, 0.02, 0.2
"""Tiles a side in which a mosaic is looked for; shares of the grey scale that are lit, and by which colours differ."""

GreyImage = NDArray[np.uint8 | np.uint16]


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key by which p9 comes before p10."""
    parts = re.split(r"(\d+)", name)
    return tuple((0, int(part), "") if part.isdigit() and len(part) < 19 else (1, 0, part) for part in parts)


def list_images(folder: Path, what: str) -> dict[str, Path]:
    """File name -> path of the images of a folder, in natural order; hidden files are skipped.

    Raises
    ------
    InvalidInput : the folder is missing or has no images; something that is no file bears an image's name.
    """
    if not folder.exists():
        raise InvalidInput(f"{folder}: no such folder, {what} needs its images there: check the name in campaign.yaml")
    if not folder.is_dir():
        raise InvalidInput(f"{folder}: is not a folder, {what} needs a folder of images")
    try:
        found = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    except OSError as error:
        raise InvalidInput(f"{folder}: cannot be read: {error.strerror or error}") from None
    if not found:
        raise InvalidInput(f"{folder}: no images in this folder, {what} needs some (PNG, TIFF, JPEG or BMP)")
    for path in found:
        if not path.is_file():
            what = "a link to a file that is not there" if path.is_symlink() else "a folder or a device, no image"
            raise InvalidInput(f"{path}: is {what}: remove or rename it")
    return {p.name: p for p in sorted(found, key=lambda p: natural_key(p.name))}


def check_image_file(path: Path) -> None:
    """Refuse what is no whole image of a size that can be worked on; nothing is decoded.

    Raises
    ------
    InvalidInput : not an image, truncated, too large.
    """
    _check_complete(path, read_bytes(path, MAX_BYTES))


def read_image(path: Path) -> GreyImage:
    """Grey values (h, w) of an image file, 8 or 16 bit; colour is converted.

    Raises
    ------
    InvalidInput : not an image, truncated, or of an unusual kind; the message says which file and what to do.
    """
    raw = read_bytes(path, MAX_BYTES)
    _check_complete(path, raw)
    inverted = False
    if raw.startswith(MAGIC):
        raw, inverted = plain_tiff(path, raw)
    try:
        with _silent_decoders():
            image = cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        raise InvalidInput(f"{path}: corrupt image, it cannot be decoded: copy it again or remove it")
    if image.dtype not in (np.uint8, np.uint16):
        raise InvalidInput(f"{path}: grey values of type {image.dtype}: save the image with 8 or 16 bit")
    if image.ndim == 3:
        channels = image.shape[2]
        image = image[:, :, 0] if channels in (1, 2) else cv2.cvtColor(image[:, :, :3], cv2.COLOR_BGR2GRAY)
    grey: GreyImage = np.ascontiguousarray(image, dtype=image.dtype)
    if mosaic(grey):
        raise InvalidInput(
            f"{path}: neighbouring pixels differ like the colours of a mosaic (Bayer pattern): develop it to grey "
            "values, or record grey"
        )
    return np.invert(grey) if inverted else grey


def mosaic(image: GreyImage) -> bool:
    """Whether an image (h, w) is the colour mosaic of a sensor: everywhere one of four pixels is brighter by far."""
    h, w = (size // (2 * TILES) * 2 * TILES for size in image.shape)
    if min(h, w) < 8 * TILES:
        return False
    # whole rows are added first, which is quick; then the columns of these sums
    rows = image[:h, :w].reshape(TILES, h // (2 * TILES), 2, w).sum(axis=1, dtype=np.uint64)
    cells = rows.reshape(TILES, 2, TILES, w // (2 * TILES), 2).mean(axis=3) / (h // (2 * TILES))
    means = cells.transpose(0, 2, 1, 3).reshape(-1, 4)
    lit = means.mean(axis=1) > LIT * (255.0 if image.dtype == np.uint8 else 65535.0)
    if np.count_nonzero(lit) < TILES:
        return False
    level = means[lit] / means[lit].mean(axis=1, keepdims=True)
    return bool(np.all(np.ptp(level, axis=1) > COLOURED) and np.ptp(level, axis=0).max() < COLOURED)


def _check_complete(path: Path, raw: bytes) -> None:
    """Decoders fill up what is missing with grey without a word, so the file's own end marks are checked first."""
    truncated = False
    width = height = 0
    depth = 1
    if not raw:
        raise InvalidInput(f"{path}: empty image file: copy it again or remove it")
    if raw.startswith(b"\x89PNG\r\n\x1a\n"):
        truncated = b"IEND" not in raw[-4096:] and b"IEND" not in raw
        if len(raw) >= 26:
            width, height, bits, kind = struct.unpack(">IIBB", raw[16:26])
            depth = (2 if bits == 16 else 1) * {2: 3, 3: 3, 4: 2, 6: 4}.get(kind, 1)
    elif raw.startswith(b"\xff\xd8"):
        # the last start of scan belongs to the main image; its end mark must follow it
        truncated = raw.rfind(b"\xff\xd9") < raw.rfind(b"\xff\xda")
        width, height, depth = _jpeg_size(raw)
    elif raw.startswith(b"BM") and len(raw) >= 30:
        offset, _, width, height = struct.unpack("<IIii", raw[10:26])
        bits = struct.unpack("<H", raw[28:30])[0]
        compressed = len(raw) >= 34 and struct.unpack("<I", raw[30:34])[0] not in (0, 3)
        truncated = not compressed and len(raw) < offset + (abs(width) * bits + 31) // 32 * 4 * abs(height)
    elif raw.startswith(MAGIC):
        width, height, depth = tiff_size(raw)
    else:
        raise InvalidInput(f"{path}: is not a PNG, TIFF, JPEG or BMP image in spite of its name: convert or remove it")
    if abs(width) * abs(height) > MAX_PIXELS:
        raise InvalidInput(f"{path}: {abs(width)} x {abs(height)} pixels are more than {MAX_PIXELS}: crop the image")
    if abs(width) * abs(height) * depth > MAX_DECODED_BYTES:
        size = abs(width) * abs(height) * depth / 1e9
        raise InvalidInput(f"{path}: {size:.1f} GB of colour values: save the image as grey values, or crop it")
    if truncated:
        raise InvalidInput(f"{path}: truncated image, its end is missing: copy it again or remove it")


def _jpeg_size(raw: bytes) -> tuple[int, int, int]:
    """Width, height and channels of the first frame header (ISO/IEC 10918-1, B.2.2); zeros where there is none."""
    at = 2
    while at + 10 <= len(raw) and raw[at] == 0xFF:
        marker = raw[at + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 0x01:
            at += 1 if marker == 0xFF else 2
            continue
        length = int.from_bytes(raw[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", raw[at + 5 : at + 9])
            return width, height, raw[at + 9]
        at += 2 + length
    return 0, 0, 1


@contextmanager
def _silent_decoders() -> Iterator[None]:
    """Keep the C decoders' own warnings (libpng, libtiff) off the terminal; what matters is raised as an error."""
    try:
        stderr = sys.__stderr__.fileno() if sys.__stderr__ is not None else 2
        saved = os.dup(stderr)
    except (OSError, ValueError):
        yield
        return
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, stderr)
        yield
    finally:
        os.dup2(saved, stderr)
        os.close(saved)
        os.close(sink)
