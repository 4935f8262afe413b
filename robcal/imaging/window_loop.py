"""Compiled loop of :mod:`robcal.imaging.windows`: which pixels around a candidate its fit looks at."""

import numpy as np

from robcal.jit import compiled, inner

_EVEN_MAX = 250  # pixels kept of the even inside, and of the background; the centre is in the edge
_0, _1 = np.float32(0.0), np.float32(1.0)
_TINY, _SMALL = np.float32(1e-18), np.float32(1e-9)


@inner
def _distances(shape, half, distance):  # type: ignore[no-untyped-def]
    """Signed distance to the edge of the ellipse, as in :mod:`robcal.imaging.edge_model`, of a window's pixels."""
    cx, cy = np.float32(shape[0]), np.float32(shape[1])
    b11, b12, b22 = np.float32(shape[2]), np.float32(shape[3]), np.float32(shape[4])
    k, side = b11 * b22 - b12 * b12, 2 * half + 1
    for row in range(side):
        dy = np.float32(row - half) - cy
        for column in range(side):
            dx = np.float32(column - half) - cx
            u1, u2 = b11 * dx + b12 * dy, b12 * dx + b22 * dy
            v1, v2 = b11 * u1 + b12 * u2, b12 * u1 + b22 * u2
            q = u1 * u1 + u2 * u2
            w = max(np.sqrt(v1 * v1 + v2 * v2), _SMALL)
            inside = _1 if q < _1 else _0
            outside = _1 - inside
            root = np.sqrt(inside * max(w * w + k * (_1 - q), _TINY) + outside * q)
            distance[row, column] = (inside * w + outside * q - root) / (inside * k + outside * w)


@inner
def _leave_out_others(image, left, upper, distance, bright, far, valid):  # type: ignore[no-untyped-def]
    """Marks the pixels of other bright things, with a border of one pixel, as not valid."""
    height, width = image.shape
    side = len(distance)
    for row in range(side):
        for column in range(side):
            if distance[row, column] <= far:
                continue
            # beyond the image its last pixel counts
            value = image[min(max(upper + row, 0), height - 1), min(max(left + column, 0), width - 1)]
            if value > bright:
                for r in range(max(row - 1, 0), min(row + 2, side)):
                    for c in range(max(column - 1, 0), min(column + 2, side)):
                        valid[r, c] = False


@inner
def _thin(upper, distance, edge, valid):  # type: ignore[no-untyped-def]
    """Keeps every k-th row of a large inside or background: neighbours along rows stay, they show correlated noise."""
    inner_count, outer_count = 0, 0
    for row in range(len(distance)):
        for column in range(len(distance)):
            inner_count += distance[row, column] < -edge
            outer_count += valid[row, column] and distance[row, column] > edge
    inside, outside = max(1, -(-inner_count // _EVEN_MAX)), max(1, -(-outer_count // _EVEN_MAX))
    for row in range(len(distance)):
        for column in range(len(distance)):
            every = inside if distance[row, column] < -edge else outside if distance[row, column] > edge else 1
            if (upper + row) % every != 0:
                valid[row, column] = False


@compiled
def gather_pixels(image, corners, shapes, scales, half, neighbours, x, y, value):  # type: ignore[no-untyped-def]  # noqa: PLR0913
    """Places from the window's middle and grey values of the pixels to fit, into the front of x, y, value (n, p).

    Parameters
    ----------
    image : (h, w). corners : (n, 2) x, y of the windows' first pixels. shapes : (n, >= 5) ellipses, from the middle.
    scales : (n, 3) blur, margin, grey value above which a pixel is bright. half : of the windows' side.
    neighbours : whether pixels of other bright things are left out.

    Returns
    -------
    (n,) number of pixels.
    """
    side, counts = 2 * half + 1, np.zeros(len(corners), np.int64)
    distance, valid = np.empty((side, side), np.float32), np.empty((side, side), np.bool_)
    for k in range(len(corners)):
        left, upper = corners[k, 0], corners[k, 1]
        blur, margin, bright = np.float32(scales[k, 0]), np.float32(scales[k, 1]), np.float32(scales[k, 2])
        _distances(shapes[k], half, distance)
        for row in range(side):
            inside = 0 <= upper + row < image.shape[0]
            for column in range(side):
                within = inside and 0 <= left + column < image.shape[1]
                valid[row, column] = within and distance[row, column] < margin
        if neighbours:
            _leave_out_others(image, left, upper, distance, bright, 2.0 * blur + 0.7, valid)
        _thin(upper, distance, 2.5 * blur + 0.5, valid)
        count = 0
        for row in range(side):
            for column in range(side):
                if valid[row, column]:
                    x[k, count], y[k, count] = column - half, row - half
                    value[k, count] = image[upper + row, left + column]
                    count += 1
        counts[k] = count
    return counts
