"""Bright blobs of an image: local background, threshold per blob, shapes that could be a dot.

The background is a morphological opening of the image at coarse scale. What rises above it by some sigma is cut into
blobs by a tree of thresholds: each blob is taken at the level half way between the level at which it merges with
others and its own peak, so that a dot in the gap of a code ring, on a bright plate or in the glare of a lamp gets a
threshold of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robcal.imaging.blobs import Candidates
from robcal.imaging.detections import Reason, RejectionLog
from robcal.imaging.noise import NoiseModel
from robcal.imaging.settings import DetectionSettings

Array = NDArray[np.float64]

_MAX_NODES = 5000  # thresholds tried in one image; a photograph of something else must not take minutes
_MAX_PARTS = 3000  # connected parts above the background, holes included; beyond, the threshold is raised
_MAX_LARGE = 40  # large parts that are searched with a finer background
_MAX_DEPTH = 7
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
_BAND = 32  # rows
_TURN = np.arange(16) * (np.pi / 8.0)
_AROUND = 4  # px from the middle of the smallest parts to what is taken for their background
_PEAK_BY_CONTRAST = 0.6  # of a spot in the corner of a pixel
_REASONS = (
    Reason.CONTRAST,
    Reason.TOO_LARGE,
    Reason.TOO_SMALL,
    Reason.ELONGATED,
    Reason.SHAPE,
    Reason.BORDER,
)  # by the numbers of blob_tree


@dataclass(frozen=True)
class _Node:
    """A connected part of the image above `base`: its box's corner, and the mask of its pixels in the box."""

    x: int
    y: int
    mask: NDArray[np.uint8]
    base: float
    depth: int


def coarse_background(image: NDArray, max_axis_px: float) -> NDArray:
    """Background of bright things up to three times the largest dot (a code ring), same shape and type as the image."""
    height, width = image.shape
    factor = int(np.clip(round(max_axis_px / 8.0), 2, 16))
    rows, columns = height // factor, width // factor
    if rows < 3 or columns < 3:
        return np.full_like(image, int(np.median(image)))
    small = cv2.resize(image[: rows * factor, : columns * factor], (columns, rows), interpolation=cv2.INTER_AREA)
    half = int(np.ceil(3.3 * max_axis_px / factor))
    # beyond three times the coarse image the kernel changes nothing
    half = min(half, max(rows, columns))
    opened = cv2.morphologyEx(small, cv2.MORPH_OPEN, np.ones((2 * half + 1, 2 * half + 1), np.uint8))
    opened = cv2.blur(opened, (5, 5))
    return cv2.resize(opened, (width, height), interpolation=cv2.INTER_LINEAR)


def find_candidates(image: NDArray, noise: NoiseModel, settings: DetectionSettings, log: RejectionLog) -> Candidates:
    """Blobs brighter than their surroundings that could be the image of a dot.

    Parameters
    ----------
    image : (h, w) uint8 or uint16, bright dots (dark ones are turned over by the caller).
    noise : its noise model. settings : limits. log : takes what is refused, with the reason.
    """
    nodes = _nodes_above_background(image, settings.max_axis_px, noise, settings, log)
    # a part too large to be a dot may carry dots: what rises above a finer background within it
    for node in nodes[:_MAX_LARGE]:
        if max(node.mask.shape) > 2.2 * settings.max_axis_px + 2.0:
            nodes += _finer_nodes(node, image, settings.max_axis_px / 4.0, noise, settings, log)
    found, left = _cut(image, nodes, noise, settings, log)
    rows = _distinct(image, found)
    if len(rows) > settings.max_candidates:
        order = np.argsort(-(rows[:, 6] - rows[:, 5]))
        log.count(Reason.OVER_CAP, len(rows) - settings.max_candidates)
        rows = rows[order[: settings.max_candidates]]
    log.count(Reason.OVER_CAP, left)
    return Candidates(rows[:, :2], rows[:, 2:4], rows[:, 4], rows[:, 5], rows[:, 6], rows[:, 7], bool(left))


def _cut(
    image: NDArray, nodes: Sequence[_Node], noise: NoiseModel, settings: DetectionSettings, log: RejectionLog
) -> tuple[Array, int]:
    """Blobs (f, 8) of all nodes, each cut half way between its base and its peak, and its parts again; nodes left."""
    from robcal.imaging import blob_tree  # compiled: imported where it runs

    if not nodes:
        return np.zeros((0, 8)), 0
    height, width = image.shape
    pixels = []
    for node in nodes:
        rows, columns = np.divmod(np.flatnonzero(node.mask).astype(np.int32), np.int32(node.mask.shape[1]))
        pixels.append((rows + np.int32(node.y)) * np.int32(width) + columns + np.int32(node.x))
    pool, number = np.concatenate(pixels), len(nodes)
    parts = np.zeros((number + len(pool) // 4 + 1, 3))
    parts[:number, 0] = [len(some) for some in pixels]
    parts[:number, 1] = [node.base for node in nodes]
    parts[:number, 2] = [node.depth for node in nodes]
    stack = blob_tree.Stack(pool, parts, np.array([number, len(pool)]))
    seen = blob_tree.Image(
        np.ascontiguousarray(image).ravel(),
        np.zeros(image.size, np.int32),
        height,
        width,
        np.array([noise.variance, noise.gain, noise.level, noise.step**2 / 12.0]),
        np.array([settings.min_axis_px, settings.max_axis_px, settings.min_axis_ratio, settings.min_contrast_sigma]),
    )
    refused = blob_tree.Refused(np.empty((log.keep, 4)), np.zeros(len(_REASONS), np.int64), np.zeros(1, np.int64))
    found = blob_tree.cut_parts(seen, stack, refused, _MAX_NODES, _MAX_DEPTH)
    places = refused.places[: int(refused.used[0])]
    for x, y, size, reason in places.tolist():
        log.add(x, y, size, _REASONS[int(reason)])
    more = refused.tally - np.bincount(places[:, 3].astype(int), minlength=len(_REASONS))
    for reason, count in zip(_REASONS, more.tolist(), strict=True):
        log.count(reason, count)
    return found, int(stack.used[0])


def _nodes_above_background(
    image: NDArray, scale: float, noise: NoiseModel, settings: DetectionSettings, log: RejectionLog
) -> list[_Node]:
    """Connected parts of an image above its background at a scale, the largest first."""
    background = coarse_background(image, scale)
    top = int(np.iinfo(image.dtype).max)
    every = max(1, int(np.sqrt(image.size / 40_000)))
    typical = background[::every, ::every]
    # an opening runs along the lower side of texture and noise
    offset = max(0.0, float(np.median(image[::every, ::every].astype(float) - typical)))
    lift = offset + max(5.0 * float(np.sqrt(noise.at(float(np.median(typical))))), 1.5 * noise.step)
    while True:
        above, single = _without_single_pixels(_above(image, _raised(background, int(np.ceil(lift)))))
        last = lift > 0.3 * top
        if last or (single <= 20 * _MAX_PARTS and not _has_far_too_many(above)):
            contours, hierarchy = cv2.findContours(above, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
            if last or _extended(contours) <= _MAX_PARTS:
                break
        # texture and dust without end: raise the threshold
        lift *= 1.6
    log.count(Reason.TOO_SMALL, single)
    boxes = _boxes(contours, hierarchy, settings, log)
    high = _stand_out(image, boxes, 0.0, noise, settings)
    log.count(Reason.CONTRAST, len(boxes) - int(high.sum()))
    boxes = boxes[high]
    return _first_nodes(above, background, offset, boxes)


def _above(image: NDArray, threshold: NDArray) -> NDArray[np.uint8]:
    """255 where the image is above the threshold, else 0."""
    return np.asarray(cv2.compare(image, threshold, cv2.CMP_GT), dtype=np.uint8)


def _without_single_pixels(above: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], int]:
    """A mask without the pixels that have no neighbours (noise), and how many there were."""
    kept = np.asarray(cv2.bitwise_and(above, cv2.dilate(above, _NEIGHBOURS)), dtype=np.uint8)
    return kept, cv2.countNonZero(above) - cv2.countNonZero(kept)


def _extended(contours: Sequence[NDArray]) -> int:
    return int(np.count_nonzero(np.fromiter(map(len, contours), np.int64, len(contours)) > 3))


def _has_far_too_many(above: NDArray[np.uint8]) -> bool:
    """Whether an eighth of the image, in bands, shows that the whole has many more parts than are looked at."""
    bands, height = above.shape[0] // (8 * _BAND), 8 * _BAND
    if bands < 2:
        return False
    some = above[: bands * height].reshape(bands, height, -1)[:, :_BAND].reshape(bands * _BAND, -1)
    contours, _ = cv2.findContours(some, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    return 8 * _extended(contours) > 1.5 * _MAX_PARTS


def _raised(image: NDArray, lift: int) -> NDArray:
    """The image plus a constant, cut off at the top of its range."""
    constant: Any = (min(lift, int(np.iinfo(image.dtype).max)), 0.0, 0.0, 0.0)
    return np.asarray(cv2.add(image, constant), dtype=image.dtype)


def _finer_nodes(
    node: _Node, image: NDArray, scale: float, noise: NoiseModel, settings: DetectionSettings, log: RejectionLog
) -> list[_Node]:
    """Parts of a large node above a finer background; finer again where they are still large."""
    height, width = node.mask.shape
    crop = image[node.y : node.y + height, node.x : node.x + width]
    # what lies outside the part is dark and would pull the background down along its border
    filled = np.where(node.mask > 0, crop, int(np.median(crop[node.mask > 0]))).astype(image.dtype)
    nodes: list[_Node] = []
    for part in _nodes_above_background(filled, scale, noise, settings, log)[:_MAX_PARTS]:
        moved = _Node(part.x + node.x, part.y + node.y, part.mask, part.base, part.depth + 1)
        nodes.append(moved)
        if max(part.mask.shape) > 6.6 * scale and scale > 12.0 and part.mask.size < 0.9 * node.mask.size:
            nodes += _finer_nodes(moved, image, scale / 3.0, noise, settings, log)
    return nodes


def _distinct(image: NDArray, rows: Array) -> Array:
    """Blobs (n, 8) without those found twice; of these the one whose base is nearer to the grey values around it."""
    if len(rows) < 2:
        return rows
    keep = np.ones(len(rows), bool)
    for first, second in cKDTree(rows[:, :2]).query_pairs(0.35 * float(rows[:, 3].max()), output_type="ndarray"):
        if not keep[first] or not keep[second]:
            continue
        a, b = rows[first], rows[second]
        close = np.hypot(a[0] - b[0], a[1] - b[1]) < 0.35 * min(a[3], b[3])
        if close and 0.7 < a[2] / b[2] < 1.43 and 0.7 < a[3] / b[3] < 1.43:
            around = _surroundings(image, a if a[2] > b[2] else b)
            keep[first if abs(a[5] - around) > abs(b[5] - around) else second] = False
    return rows[keep]


def _surroundings(image: NDArray, row: Array) -> float:
    """Median grey value on an ellipse half as large again as a blob, in the gap between a dot and its code ring."""
    x, y, major, minor, angle = row[:5]
    u, v = (1.5 * major + 1.0) * np.cos(_TURN), (1.5 * minor + 1.0) * np.sin(_TURN)
    c, s = np.cos(angle), np.sin(angle)
    columns = np.clip(np.rint(x + c * u - s * v), 0, image.shape[1] - 1).astype(int)
    lines = np.clip(np.rint(y + s * u + c * v), 0, image.shape[0] - 1).astype(int)
    return float(np.median(image[lines, columns]))


def _boxes(
    contours: Sequence[NDArray], hierarchy: NDArray | None, settings: DetectionSettings, log: RejectionLog
) -> NDArray[np.int64]:
    """Bounding boxes x, y, width, height and a pixel px, py of the parts (k, 6), the largest first."""
    if hierarchy is None:
        return np.zeros((0, 6), np.int64)
    outer = np.flatnonzero(hierarchy[0][:, 3] < 0)
    rows = [
        (*cv2.boundingRect(contour), *contour[0, 0].tolist())
        for contour in (contours[index] for index in outer.tolist())
        if len(contour) > 2
    ]
    boxes = np.array(rows, dtype=np.int64).reshape(-1, 6)
    size = boxes[:, 2] * boxes[:, 3]
    large = (size >= 4) & (boxes[:, 2:4].min(axis=1) >= settings.min_axis_px)
    log.count(Reason.TOO_SMALL, len(outer) - int(large.sum()))
    boxes, size = boxes[large], size[large]
    if len(boxes) > _MAX_NODES:
        # what is nearest to a dot's size is looked at first; the rest is counted
        log.count(Reason.OVER_CAP, len(boxes) - _MAX_NODES)
        chosen = np.lexsort((size, size < np.pi * settings.min_axis_px**2))[:_MAX_NODES]
        boxes, size = boxes[chosen], size[chosen]
    return boxes[np.argsort(-size, kind="stable")]


def _stand_out(
    image: NDArray, boxes: NDArray[np.int64], sigma: float, noise: NoiseModel, settings: DetectionSettings
) -> NDArray[np.bool_]:
    """(k,) False for the smallest parts that do not stand out from their own surroundings: noise on brighter texture.

    Parameters
    ----------
    boxes : (k, >= 4) x, y, width, height in the image. sigma : noise seen there, where it is more than the model's.
    """
    height, width = image.shape
    x, y = boxes[:, 0] + boxes[:, 2] // 2, boxes[:, 1] + boxes[:, 3] // 2
    far = _AROUND
    tiny = (boxes[:, 2:4].max(axis=1) <= 4) & (np.minimum(x, y) >= far) & (x < width - far) & (y < height - far)
    rows = np.flatnonzero(tiny)
    offset = np.arange(-far, far + 1)
    around = offset[:, None] * width + offset
    patch = image.ravel().take((y[rows] * width + x[rows])[:, None, None] + around)
    ring = np.maximum(np.abs(offset)[:, None], np.abs(offset)) == far
    base = np.median(patch[:, ring], axis=1)
    peak = patch[:, far - 2 : far + 3, far - 2 : far + 3].max(axis=(1, 2))
    least = _PEAK_BY_CONTRAST * settings.min_contrast_sigma * np.maximum(np.sqrt(noise.at(base)), sigma)
    high = np.ones(len(boxes), bool)
    high[rows] = peak - base >= least
    return high


def _first_nodes(above: NDArray, background: NDArray, offset: float, boxes: NDArray[np.int64]) -> list[_Node]:
    """Connected parts above the background from their boxes, small ones last in the list."""
    nodes: list[_Node] = []
    for x, y, width, height, px, py in boxes.tolist():
        part = above[y : y + height, x : x + width]
        number, labels = cv2.connectedComponents(part, connectivity=8)
        if number > 2:  # others reach into the box
            part = (labels == labels[py - y, px - x]).view(np.uint8)
        base = float(background[y + height // 2, x + width // 2]) + offset
        nodes.append(_Node(x, y, part, base, 0))
    return nodes
