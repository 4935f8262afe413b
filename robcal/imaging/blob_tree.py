"""Compiled loop of :mod:`robcal.imaging.segmentation`: parts of an image cut again and again at half of their height.

A part is the list of its pixels (places in the flattened image, in reading order). Parts wait on a stack: what a part
is cut into has no more pixels than the part itself, so the stack of pixels never grows. `mark` (h * w) is zero between
two parts; within one it holds, for its pixels, a label >= 1 or one of the two numbers below.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robcal.jit import compiled, inner

_MEMBER, _NEAR = -1, -2  # pixels of the part below the level; those within two pixels of one above it
# reasons by number, see segmentation
FOUND, CONTRAST, TOO_LARGE, TOO_SMALL, ELONGATED, SHAPE, BORDER = -1, 0, 1, 2, 3, 4, 5
_ROUGH_PIXELS = 40_000  # pixels of a part's box that are enough to estimate its noise
_AROUND = 4  # px from the middle of the smallest parts to what is taken for their background
_MANY = 8  # parts of a node from which it pays to examine the smallest together
_PEAK_BY_CONTRAST = 0.6  # of a spot in the corner of a pixel


class Image(NamedTuple):
    """`grey` (h * w,) 8 or 16 bit, `mark` (h * w,) int32 zeros, `height`, `width`; `noise` (4,) variance, gain, level,
    least variance; `limits` (4,) least and largest semi-axis, least ratio, least contrast in sigmas."""

    grey: NDArray
    mark: NDArray[np.int32]
    height: int
    width: int
    noise: NDArray[np.float64]
    limits: NDArray[np.float64]


class Stack(NamedTuple):
    """Parts that wait: `pool` their pixels one after the other, `parts` (room, 3) number of pixels, base, depth;
    `used` (2,) parts and pixels in use."""

    pool: NDArray[np.int32]
    parts: NDArray[np.float64]
    used: NDArray[np.int64]


class Refused(NamedTuple):
    """`places` (r, 4) x, y, size, reason of the first that are refused, `tally` all by reason, `used` (1,) rows."""

    places: NDArray[np.float64]
    tally: NDArray[np.int64]
    used: NDArray[np.int64]


@inner
def _label(pixels, mark, width, members, first):  # type: ignore[no-untyped-def]
    """Labels 1, 2, ... of 4-connected pixels in the order of their first pixels, into `mark`.

    `members` (n,) takes the pixels part by part, `first` (> parts) where each part begins there. Returns the number of
    parts. Rosenfeld and Pfaltz (1966), two passes.
    """
    parent = np.empty(len(pixels) + 1, np.int32)
    last = 0
    for p in pixels:
        column = p % width
        left = mark[p - 1] if column > 0 else 0
        upper = mark[p - width] if p >= width else 0
        if left <= 0 and upper <= 0:
            last += 1
            parent[last] = last
            mark[p] = last
            continue
        a, b = max(left, upper), min(left, upper)
        if b > 0 and a != b:
            while parent[a] != a:
                a = parent[a]
            while parent[b] != b:
                b = parent[b]
            a, b = max(a, b), min(a, b)
            parent[a] = b
            mark[p] = b
        else:
            mark[p] = a
    parts = 0
    for label in range(1, last + 1):
        root = parent[label]
        if root == label:
            parts += 1
            parent[label] = parts
        else:
            parent[label] = parent[root]  # smaller, hence final already
    for part in range(parts + 2):
        first[part] = 0
    for p in pixels:
        mark[p] = parent[mark[p]]
        first[mark[p] + 1] += 1
    for part in range(1, parts + 2):
        first[part] += first[part - 1]
    place = first[: parts + 1].copy()
    for p in pixels:
        members[place[mark[p]]] = p
        place[mark[p]] += 1
    return parts


@inner
def _size_of(pixels, width, box):  # type: ignore[no-untyped-def]
    """Box x, y, width, height of a part's pixels."""
    left, right = pixels[0] % width, pixels[0] % width
    for p in pixels:
        column = p % width
        left, right = min(left, column), max(right, column)
    upper, lower = pixels[0] // width, pixels[-1] // width
    box[0], box[1], box[2], box[3] = left, upper, right - left + 1, lower - upper + 1


@inner
def _high_value(grey, pixels):  # type: ignore[no-untyped-def]
    """A high but not the highest value of a part: one hot pixel is no peak."""
    top = np.full(4, -1, np.int64)
    for p in pixels:
        value = np.int64(grey[p])
        if value <= top[3]:
            continue
        at = 3
        while at > 0 and value > top[at - 1]:
            top[at] = top[at - 1]
            at -= 1
        top[at] = value
    return float(top[min(3, len(pixels) // 6)])


@inner
def _rough_sigma(image, pixels, box):  # type: ignore[no-untyped-def]
    """Noise inside a large part from second differences along rows.

    The mean of the smaller half of |z| is 0.319 sigma; unlike the median it is not quantised.
    """
    grey, mark, width = image.grey, image.mark, image.width
    every = 1 + (box[2] * box[3]) // _ROUGH_PIXELS
    sizes = np.empty(len(pixels), np.int64)
    count, largest = 0, 0
    for p in pixels:
        row = p // width
        if (row - box[1]) % every == 0 and p - row * width + 2 < width and mark[p + 2] != 0:
            second = abs(np.int64(grey[p + 2]) - 2 * np.int64(grey[p + 1]) + np.int64(grey[p]))
            sizes[count] = second
            largest = max(largest, second)
            count += 1
    if count < 50:
        return 0.0
    bins = np.zeros(largest + 1, np.int64)
    for i in range(count):
        bins[sizes[i]] += 1
    half, taken, total = count // 2, 0, 0
    for size in range(largest + 1):
        some = min(bins[size], half - taken)
        taken += some
        total += some * size
    return total / half / (0.319 * np.sqrt(6.0))


@inner
def _variance(noise, grey):  # type: ignore[no-untyped-def]
    return max(noise[0] + noise[1] * (grey - noise[2]), noise[3])


@inner
def _stands_out(image, box, sigma):  # type: ignore[no-untyped-def]
    """Whether one of the smallest parts stands out from its own surroundings: else noise on brighter texture."""
    x, y = box[0] + box[2] // 2, box[1] + box[3] // 2
    far, width, height, noise, contrast = _AROUND, image.width, image.height, image.noise, image.limits[3]
    if max(box[2], box[3]) > 4 or min(x, y) < far or x >= width - far or y >= height - far:
        return True
    ring = np.empty(8 * far, np.int64)
    count, peak = 0, 0
    for dy in range(-far, far + 1):
        for dx in range(-far, far + 1):
            value, reach = np.int64(image.grey[(y + dy) * width + x + dx]), max(abs(dx), abs(dy))
            if reach == far:
                at = count
                while at > 0 and ring[at - 1] > value:
                    ring[at] = ring[at - 1]
                    at -= 1
                ring[at] = value
                count += 1
            elif reach <= 2:
                peak = max(peak, value)
    base = 0.5 * (ring[4 * far - 1] + ring[4 * far])
    return peak - base >= _PEAK_BY_CONTRAST * contrast * max(np.sqrt(_variance(noise, base)), sigma)


@inner
def _judge(image, pixels, box, level, base, found):  # type: ignore[no-untyped-def]
    """FOUND and a row in `found` if the part may be a dot, else the number of the reason why not."""
    min_axis, max_axis, min_ratio = image.limits[0], image.limits[1], image.limits[2]
    width, height = image.width, image.height
    if max(box[2], box[3]) > 2.2 * max_axis + 2.0:
        return TOO_LARGE
    area = len(pixels)
    x, y, xx, yy, xy, peak = 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for p in pixels:
        row = p // width
        dx, dy = float(p - row * width - box[0]), float(row - box[1])
        x, y, xx, yy, xy = x + dx, y + dy, xx + dx * dx, yy + dy * dy, xy + dx * dy
        peak = max(peak, np.int64(image.grey[p]))
    cx, cy = x / area, y / area
    # a pixel is an area: 1/12 belongs to the second moments
    sxx, syy, sxy = xx / area - cx * cx + 1 / 12, yy / area - cy * cy + 1 / 12, xy / area - cx * cy
    mean, radius = 0.5 * (sxx + syy), np.sqrt(0.25 * (sxx - syy) ** 2 + sxy**2)
    major, minor = 2.0 * np.sqrt(mean + radius), 2.0 * np.sqrt(max(mean - radius, 1e-6))
    if minor < 0.6 * min_axis:
        return TOO_SMALL if area < 9 else ELONGATED
    if major > 1.15 * max_axis + 1.0:
        return TOO_LARGE
    if minor < 0.8 * min_ratio * major:
        return ELONGATED
    # filled ellipses have 1; half rings, crosses, squares with holes have less. Few pixels scatter
    if abs(area / (np.pi * major * minor) - 1.0) > 0.08 + 0.9 / np.sqrt(area):
        return SHAPE
    if box[0] <= 1 or box[1] <= 1 or box[0] + box[2] >= width - 1 or box[1] + box[3] >= height - 1:
        return BORDER
    half, high = 0.5 * (level + peak), 0
    for p in pixels:
        high += image.grey[p] > half
    # between the levels 1/2 and 3/4 lie 0.674 sigma of a blurred edge, along the perimeter
    blur = (area - high) / (0.674 * 2.0 * np.pi * np.sqrt(0.5 * (major**2 + minor**2)))
    found[0], found[1], found[2], found[3] = box[0] + cx, box[1] + cy, major, minor
    found[4] = 0.5 * np.arctan2(2.0 * sxy, sxx - syy)
    found[5], found[6], found[7] = base, peak, min(max(blur, 0.35), 0.5 * minor + 0.5)
    return FOUND


@inner
def _grown(rows):  # type: ignore[no-untyped-def]
    larger = np.empty((2 * len(rows), rows.shape[1]))
    for i in range(len(rows)):
        for k in range(rows.shape[1]):
            larger[i, k] = rows[i, k]
    return larger


@inner
def _mark_near(pixels, mark, width, height):  # type: ignore[no-untyped-def]
    """Marks what lies within two pixels of those above the level; only their border has such neighbours."""
    for p in pixels:
        y = p // width
        x = p - y * width
        within = 0 < x < width - 1 and 0 < y < height - 1
        if within and mark[p - 1] > 0 and mark[p + 1] > 0 and mark[p - width] > 0 and mark[p + width] > 0:
            continue
        for row in range(max(y - 2, 0), min(y + 3, height)):
            for column in range(max(x - 2, 0), min(x + 3, width)):
                if mark[row * width + column] == _MEMBER:
                    mark[row * width + column] = _NEAR


@inner
def _push(stack, pixels, base, depth):  # type: ignore[no-untyped-def]
    k, begin = stack.used[0], stack.used[1]
    for i in range(len(pixels)):
        stack.pool[begin + i] = pixels[i]
    stack.parts[k, 0], stack.parts[k, 1], stack.parts[k, 2] = len(pixels), base, depth
    stack.used[0], stack.used[1] = k + 1, begin + len(pixels)


@inner
def _refuse(refused, box, reason):  # type: ignore[no-untyped-def]
    refused.tally[reason] += 1
    k = refused.used[0]
    if k < len(refused.places):
        refused.places[k, 0], refused.places[k, 1] = box[0] + box[2] / 2, box[1] + box[3] / 2
        refused.places[k, 2], refused.places[k, 3] = max(box[2], box[3]) / 2, reason
        refused.used[0] = k + 1


@inner
def _sort_part(image, pixels, box, levels, stack, refused, found):  # type: ignore[no-untyped-def]
    """Whether a part above the level is a dot, in `found`; else it is put back to be cut again, or refused.

    `levels` : level, base, sigma, depth of the part's parts, greatest depth.
    """
    level, base, sigma, depth, max_depth = levels
    peak, total = 0, 0
    for p in pixels:
        peak = max(peak, np.int64(image.grey[p]))
        total += np.int64(image.grey[p])
    height, least = peak - level, image.limits[3] * sigma
    if height < 0.3 * least:  # crumbs of noise along the level's contour on a slope
        return False
    reason = _judge(image, pixels, box, level, base, found)
    if reason == FOUND:
        return True
    # an evenly bright part has no dots of its own inside
    even = total / len(pixels) - level > 0.5 * height
    if depth <= max_depth and len(pixels) > 12 and (not even or reason == TOO_LARGE) and height > least:
        _push(stack, pixels, level, depth)
        if reason != TOO_LARGE:
            return False
    _refuse(refused, box, reason)
    return False


@inner
def _keep_rest(image, pixels, core, base, least, depth, stack):  # type: ignore[no-untyped-def]
    """Puts back the fainter parts that hang together with a brighter one only by its glare."""
    mark = image.mark
    _mark_near(core, mark, image.width, image.height)
    rest, count = np.empty(len(pixels), np.int32), 0
    for p in pixels:
        if mark[p] == _MEMBER:
            rest[count] = p
            count += 1
        mark[p] = 0
    if count < 6:
        return
    members, first = np.empty(count, np.int32), np.empty(count + 2, np.int64)
    for part in range(1, _label(rest[:count], mark, image.width, members, first) + 1):
        own = members[first[part] : first[part + 1]]
        peak = 0
        for p in own:
            peak = max(peak, np.int64(image.grey[p]))
        if len(own) >= 4 and peak - base > least:
            _push(stack, own, base, depth)


@inner
def _cut(image, pixels, base, depth, max_depth, stack, refused, found, hits):  # type: ignore[no-untyped-def]  # noqa: PLR0913
    """Cuts one part half way between its base and its peak; returns the rows of dots and their number."""
    grey, mark, n = image.grey, image.mark, len(pixels)
    box = np.zeros(4, np.int64)
    _size_of(pixels, image.width, box)
    for p in pixels:
        mark[p] = _MEMBER
    peak, sigma = _high_value(grey, pixels), np.sqrt(_variance(image.noise, base))
    if n > 200:
        sigma = max(sigma, _rough_sigma(image, pixels, box))
    least = image.limits[3] * sigma
    if peak - base < 0.6 * least:
        if depth == 0:
            _refuse(refused, box, CONTRAST)
        return found, hits
    core, members, first = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n + 2, np.int64)
    cores, level = 0, 0.5 * (base + peak)
    for p in pixels:
        if grey[p] > int(level):
            core[cores] = p
            cores += 1
    parts = _label(core[:cores], mark, image.width, members, first)
    several = 0
    for part in range(1, parts + 1):
        several += first[part + 1] - first[part] > 1
    for part in range(1, parts + 1):
        own = members[first[part] : first[part + 1]]
        if len(own) < 2:
            continue
        _size_of(own, image.width, box)
        if several >= _MANY and not _stands_out(image, box, sigma):
            continue
        if hits == len(found):
            found = _grown(found)
        hits += _sort_part(image, own, box, (level, base, sigma, depth + 1, max_depth), stack, refused, found[hits])
    if depth < max_depth and n > 1.5 * cores + 8:
        _keep_rest(image, pixels, core[:cores], base, least, depth + 1, stack)
    return found, hits


@compiled
def cut_parts(image, stack, refused, max_parts, max_depth):  # type: ignore[no-untyped-def]
    """Cuts all parts of the stack, the last one first, until each is found to be a dot or refused.

    At most `max_parts` are cut, and parts of parts to the depth `max_depth`; what is left stays on the stack.

    Returns
    -------
    (f, 8) x, y, major, minor, angle, base, peak, blur of what may be dots.
    """
    found, hits, visited = np.empty((1024, 8)), 0, 0
    while stack.used[0] > 0 and visited < max_parts:
        visited += 1
        part = stack.parts[stack.used[0] - 1]
        n, base, depth = int(part[0]), part[1], int(part[2])
        stack.used[0] -= 1
        stack.used[1] -= n
        if n < 2:
            continue
        pixels = stack.pool[stack.used[1] : stack.used[1] + n].copy()
        found, hits = _cut(image, pixels, base, depth, max_depth, stack, refused, found, hits)
        for p in pixels:
            image.mark[p] = 0
    return found[:hits]
