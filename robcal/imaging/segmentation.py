"""Bright blobs of an image: local background, threshold per blob, shapes that could be a dot.

The background is a morphological opening of the image at coarse scale. What rises above it by some sigma is cut into
blobs by a tree of thresholds: each blob is taken at the level half way between the level at which it merges with
others and its own peak, so that a dot in the gap of a code ring, on a bright plate or in the glare of a lamp gets a
threshold of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robcal.imaging.blobs import Candidates, judge, rough_sigma
from robcal.imaging.detections import Reason, RejectionLog
from robcal.imaging.noise import NoiseModel
from robcal.imaging.settings import DetectionSettings

Array = NDArray[np.float64]

_MAX_NODES = 5000  # thresholds tried in one image; a photograph of something else must not take minutes
_MAX_PARTS = 3000  # connected parts above the background, holes included; beyond, the threshold is raised
_MAX_LARGE = 40  # large parts that are searched with a finer background
_MAX_DEPTH = 7
_CROSS = np.ones((5, 5), np.uint8)


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
    found: list[tuple[float, ...]] = []
    visited = 0
    while nodes and visited < _MAX_NODES:
        visited += 1
        _split(nodes.pop(), image, noise, settings, nodes, found, log)
    rows = _distinct(np.array(found, dtype=float).reshape(-1, 8))
    if len(rows) > settings.max_candidates:
        order = np.argsort(-(rows[:, 6] - rows[:, 5]))
        log.count(Reason.OVER_CAP, len(rows) - settings.max_candidates)
        rows = rows[order[: settings.max_candidates]]
    log.count(Reason.OVER_CAP, len(nodes))
    return Candidates(rows[:, :2], rows[:, 2:4], rows[:, 4], rows[:, 5], rows[:, 6], rows[:, 7], bool(nodes))


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
        threshold = _raised(background, int(np.ceil(lift)))
        above = cv2.compare(image, threshold, cv2.CMP_GT)
        contours, hierarchy = cv2.findContours(above, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        # texture and dust without end: look at what stands out more
        extended = sum(len(contour) > 3 for contour in contours)  # single pixels are noise
        if (extended <= _MAX_PARTS and len(contours) <= 20 * _MAX_PARTS) or lift > 0.3 * top:
            break
        lift *= 1.6
    return _first_nodes(above, background, offset, contours, hierarchy, settings, log)


def _raised(image: NDArray, lift: int) -> NDArray:
    """The image plus a constant, cut off at the top of its range."""
    top = int(np.iinfo(image.dtype).max)
    return np.minimum(image, top - min(lift, top)) + image.dtype.type(min(lift, top))


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


def _distinct(rows: Array) -> Array:
    """Blobs (n, 8) without those found twice; of these the one with the higher base fits its surroundings better."""
    if len(rows) < 2:
        return rows
    keep = np.ones(len(rows), bool)
    for first, second in cKDTree(rows[:, :2]).query_pairs(0.35 * float(rows[:, 3].max()), output_type="ndarray"):
        if not keep[first] or not keep[second]:
            continue
        a, b = rows[first], rows[second]
        close = np.hypot(a[0] - b[0], a[1] - b[1]) < 0.35 * min(a[3], b[3])
        if close and 0.7 < a[2] / b[2] < 1.43 and 0.7 < a[3] / b[3] < 1.43:
            keep[first if a[5] < b[5] else second] = False
    return rows[keep]


def _first_nodes(
    above: NDArray, background: NDArray, offset: float, contours: Sequence[NDArray],
    hierarchy: NDArray | None, settings: DetectionSettings, log: RejectionLog,
) -> list[_Node]:  # fmt: skip
    """Connected parts above the background, by contours (fast where there are few), small ones last in the list."""
    nodes: list[_Node] = []
    if hierarchy is None:
        return nodes
    small = 0
    outer = np.flatnonzero(hierarchy[0][:, 3] < 0)
    boxes: list[tuple[int, int, int, int, int, int, int]] = []
    for index in outer:
        contour = contours[int(index)]
        if len(contour) < 3:
            small += 1
            continue
        x, y, width, height = cv2.boundingRect(contour)
        if width * height < 4 or min(width, height) < settings.min_axis_px:
            small += 1
            continue
        px, py = (int(value) for value in contour[0, 0])
        boxes.append((width * height, x, y, width, height, px - x, py - y))
    log.count(Reason.TOO_SMALL, small)
    if len(boxes) > _MAX_NODES:
        # what is nearest to a dot's size is looked at first; the rest is counted
        log.count(Reason.OVER_CAP, len(boxes) - _MAX_NODES)
        smallest = np.pi * settings.min_axis_px**2
        boxes.sort(key=lambda box: (box[0] < smallest, box[0]))
        boxes = boxes[:_MAX_NODES]
    boxes.sort(reverse=True)
    for _, x, y, width, height, px, py in boxes:
        part = above[y : y + height, x : x + width]
        number, labels = cv2.connectedComponents(part, connectivity=8)
        if number > 2:  # others reach into the box
            part = (labels == labels[py, px]).view(np.uint8)
        base = float(background[y + height // 2, x + width // 2]) + offset
        nodes.append(_Node(x, y, part, base, 0))
    return nodes


def _split(
    node: _Node, image: NDArray, noise: NoiseModel, settings: DetectionSettings,
    nodes: list[_Node], found: list[tuple[float, ...]], log: RejectionLog,
) -> None:  # fmt: skip
    """Cuts one node half way between its base and its peak; dots go to `found`, the rest is cut again or refused."""
    height, width = node.mask.shape
    crop = image[node.y : node.y + height, node.x : node.x + width]
    inside = crop[node.mask > 0]
    if inside.size < 2:
        return
    # a high but not the highest value: one hot pixel is no peak
    rank = min(3, inside.size // 6)
    peak = float(inside.max() if rank == 0 else np.partition(inside, inside.size - 1 - rank)[inside.size - 1 - rank])
    sigma = max(float(np.sqrt(noise.at(node.base))), rough_sigma(crop, node.mask) if inside.size > 200 else 0.0)
    if peak - node.base < 0.6 * settings.min_contrast_sigma * sigma:
        if node.depth == 0:
            log.add(node.x + width / 2, node.y + height / 2, max(width, height) / 2, Reason.CONTRAST)
        return
    level = 0.5 * (node.base + peak)
    core = ((crop > level) & (node.mask > 0)).view(np.uint8)
    number, labels, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=4, ltype=cv2.CV_32S)
    for part in range(1, number):
        left, upper, w, h, area = (int(value) for value in stats[part])
        if area < 2:
            continue
        box = (slice(upper, upper + h), slice(left, left + w))
        mask = (labels[box] == part).view(np.uint8)
        x, y = node.x + left, node.y + upper
        values = crop[box][mask > 0]
        part_peak = float(values.max())
        # crumbs of noise along the level's contour on a slope
        if part_peak - level < 0.3 * settings.min_contrast_sigma * sigma:
            continue
        reason = judge(mask, crop[box], area, level, node.base, (x, y), image.shape, settings, found)
        if reason is None:
            continue
        # an evenly bright part has no dots of its own inside
        even = float(values.mean()) - level > 0.5 * (part_peak - level)
        if (
            node.depth < _MAX_DEPTH
            and area > 12
            and (not even or reason is Reason.TOO_LARGE)
            and part_peak - level > (settings.min_contrast_sigma * sigma)
        ):
            nodes.append(_Node(x, y, mask, level, node.depth + 1))
            if reason is not Reason.TOO_LARGE:
                continue
        log.add(x + w / 2, y + h / 2, max(w, h) / 2, reason)
    # fainter parts of the node that hang together with a brighter one only by its glare
    if node.depth < _MAX_DEPTH and inside.size > 1.5 * np.count_nonzero(core) + 8:
        rest = np.where(cv2.dilate(core, _CROSS) > 0, 0, node.mask).astype(np.uint8)
        if np.count_nonzero(rest) >= 6:
            _add_rest(rest, node, crop, settings.min_contrast_sigma * sigma, nodes)


def _add_rest(rest: NDArray[np.uint8], node: _Node, crop: NDArray, lift: float, nodes: list[_Node]) -> None:
    """Adds the connected parts of the rest that have a peak of their own."""
    number, labels, stats, _ = cv2.connectedComponentsWithStats(rest, connectivity=4, ltype=cv2.CV_32S)
    for part in range(1, number):
        left, upper, w, h, area = (int(value) for value in stats[part])
        if area < 4:
            continue
        box = (slice(upper, upper + h), slice(left, left + w))
        mask = (labels[box] == part).view(np.uint8)
        if float(crop[box][mask > 0].max()) - node.base > lift:
            nodes.append(_Node(node.x + left, node.y + upper, mask, node.base, node.depth + 1))
