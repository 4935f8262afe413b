"""`pipeline targets --images FOLDER --out FOLDER`: pictures of what was read and refused, and a draft body file."""

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.messages import track
from robcal.errors import InvalidInput
from robcal.files.body_file import BodyFile, read_body
from robcal.files.images import list_images, read_image
from robcal.files.storage import storage_error, write_atomic, write_text
from robcal.files.yaml_io import FlowMapping, yaml_text
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import CodeState, Detections, Reason, TargetKind
from robcal.imaging.settings import DetectionSettings
from robcal.photogrammetry.boards.detect import find_board
from robcal.recipe.detection import detection_settings

_LONGER = 1600
"""Longer side of the pictures, px."""
_TRIED = 3
_READ, _DOT, _UNREAD, _REFUSED = (60, 220, 60), (255, 170, 30), (0, 220, 255), (70, 70, 255)  # BGR
_QUIET = (Reason.TOO_SMALL, Reason.CONTRAST, Reason.TOO_LARGE, Reason.DUPLICATE)
"""Refused by the thousand in any image: counted, not drawn."""
_SEEN = 2
"""Images in which a code must be read to stand in the draft: one misread stands nowhere else."""


def read_targets(folder: Path, out: Path, body: Path | None) -> dict[str, Any]:
    """Write an overlay picture for each image, and a draft of the body file where none was given.

    Parameters
    ----------
    body : what is to be seen; None: ring12 codes and dots, bright or dark, whichever there is more of.
    """
    images = list_images(folder, "--images")
    if out.resolve() == folder.resolve():
        raise InvalidInput(f"{out}: the pictures would lie among the images: name another folder for --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(out, error) from None
    file = None if body is None else read_body(body)
    grey = (read_image(path) for path in images.values())
    settings = _settings(images, file)
    codes: Counter[int] = Counter()
    dots: list[int] = []
    table = []
    for name, picture in track(zip(images, grey, strict=True), len(images), "reading targets"):
        if file is not None and file.board is not None:
            found = find_board(picture, file.board, settings.polarity)
        else:
            found = detect_targets(picture, settings)
        read = found.code >= 0
        codes.update(found.code[read].tolist())
        dots.append(int((~read).sum()))
        overlay = _overlay(picture, found)
        written = out / f"{Path(name).stem}.jpg"
        encoded = cv2.imencode(".jpg", overlay, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
        write_atomic(written, partial(_put, encoded))
        refused = {reason.value: count for reason, count in found.rejected.counts.items()}
        table.append(
            {"image": name, "codes": sorted(found.code[read].tolist()), "dots": dots[-1], "refused": refused}
            | ({"message": found.message} if found.message else {})
        )
    result: dict[str, Any] = {"images": table, "polarity": settings.polarity, "out": str(out)}
    if file is None:
        result["body"] = str(_draft(out / "body.yaml", codes, dots, settings.polarity))
    else:
        listed = {t.id for t in file.targets if t.id is not None}
        result["never_seen"] = sorted(listed - set(codes)) if any(t.code for t in file.targets) else []
        result["not_listed"] = sorted(set(codes) - listed)
    return result


def _put(data: bytes, stream: BinaryIO) -> None:
    stream.write(data)


def _settings(images: dict[str, Path], file: BodyFile | None) -> DetectionSettings:
    """What to look for; without a body the polarity in which the first images show more codes, then more dots."""
    if file is not None:
        return detection_settings(file, None)
    score = []
    for settings in (DetectionSettings(polarity="bright"), DetectionSettings(polarity="dark")):
        found = [detect_targets(read_image(path), settings) for path in list(images.values())[:_TRIED]]
        score.append((sum(int((d.code >= 0).sum()) for d in found), sum(len(d) for d in found), settings))
    return max(score, key=lambda item: item[:2])[2]


def _overlay(image: NDArray, found: Detections) -> NDArray[np.uint8]:
    """The image in grey with what was found and refused, and a legend."""
    factor = min(1.0, _LONGER / max(image.shape))
    top = float(np.quantile(image[:: max(1, image.shape[0] // 400)], 0.999)) or 1.0
    grey = np.clip(image * (200.0 / top), 0, 255).astype(np.uint8)
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else grey
    canvas = np.asarray(cv2.cvtColor(np.ascontiguousarray(small), cv2.COLOR_GRAY2BGR), dtype=np.uint8)

    def at(xy: NDArray) -> tuple[int, int]:
        x, y = (np.asarray(xy) + 0.5) * factor - 0.5
        return round(float(x)), round(float(y))

    for place, size, reason in zip(found.rejected.xy, found.rejected.size, found.rejected.reason, strict=True):
        if reason not in _QUIET:
            x, y = at(place)
            half = max(4, int(size * factor) + 2)
            cv2.rectangle(canvas, (x - half, y - half), (x + half, y + half), _REFUSED, 1, cv2.LINE_AA)
    for k in range(len(found)):
        read, unread = found.code[k] >= 0, found.code_state[k] == CodeState.UNREADABLE
        colour = _READ if read else _UNREAD if unread else _DOT
        centre = at(found.xy[k])
        if found.kind[k] == TargetKind.CORNER:
            cv2.drawMarker(canvas, centre, colour, cv2.MARKER_TILTED_CROSS, 9, 1, cv2.LINE_AA)
        else:
            axes = tuple(max(2, round(float(a) * factor) + 1) for a in found.semi_axes[k])
            cv2.ellipse(canvas, centre, axes, float(np.degrees(found.angle[k])), 0, 360, colour, 1, cv2.LINE_AA)
        if read:
            place = (centre[0] + 6, centre[1] - 6)
            cv2.putText(canvas, str(found.code[k]), place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
    return np.vstack([canvas, _legend(canvas.shape[1], found)])


def _legend(width: int, found: Detections) -> NDArray[np.uint8]:
    """Lines of text below the image: what the colours mean, how many, and why others were refused."""
    read = int((found.code >= 0).sum())
    unread = int((found.code_state == CodeState.UNREADABLE).sum())
    lines = [
        (f"{read} identified", _READ),
        (f"{len(found) - read - unread} dots without code", _DOT),
        (f"{unread} dots with a ring that could not be read", _UNREAD),
    ]
    for reason, count in sorted(found.rejected.counts.items(), key=lambda item: -item[1]):
        mark = "not drawn: " if reason in _QUIET else "refused: "
        lines.append((f"{mark}{count} {reason.value}", _REFUSED if reason not in _QUIET else (170, 170, 170)))
    if found.message:
        lines.append((found.message, (255, 255, 255)))
    strip = np.full((20 * len(lines) + 10, width, 3), 32, np.uint8)
    for k, (words, colour) in enumerate(lines):
        cv2.putText(strip, words, (8, 20 * k + 20), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    return strip


def _draft(path: Path, codes: Counter[int], dots: list[int], polarity: str) -> Path:
    """Body file of the codes that were read in several images."""
    needed = _SEEN if len(dots) >= 3 else 1
    kept = sorted(code for code, count in codes.items() if count >= needed)
    once = sorted(code for code, count in codes.items() if count < needed)
    typical = int(np.median(dots)) if dots else 0
    rows: list[dict[str, Any]] = []
    for code in kept:
        row: dict[str, Any] = FlowMapping(id=code, code="ring12", diameter_mm=None, xyz_mm=None)
        rows.append(row)
    rows += [FlowMapping(id=None, code=None, diameter_mm=None, xyz_mm=None) for _ in range(typical)]
    if not rows:
        raise InvalidInput(
            f"{path.parent}: no target was read in any image: the pictures there show what was refused and why; for a "
            "board or square markers state its body file with --body"
        )
    comment = (
        f"draft from {len(dots)} images: {len(kept)} codes read in {needed} or more, {typical} dots without (median)\n"
        "complete it: diameter_mm of the dots, xyz_mm where coordinates are known; remove what is not on the body"
    )
    if once:
        comment += f"\nread in one image only and left out: {', '.join(map(str, once))}"
    body: dict[str, Any] = {"format": "robcal/body-1"}
    if polarity == "dark":
        body["polarity"] = "dark"
    write_text(path, yaml_text(body | {"targets": rows}, comment))
    return path
