"""Compiled loops of :mod:`robcal.imaging.ring_code`: grey values around dots, and blurred segments at their angles."""

import math

import numpy as np

from robcal.jit import compiled

_FAR = 8.5  # standard deviations beyond which the normal distribution is 0 or 1 in double precision
_ROOT_HALF = math.sqrt(0.5)
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)


@compiled
def sample_rings(image, xy, to_image, rho, circle, grey):  # type: ignore[no-untyped-def]
    """Bilinear grey values on circles of the dots' unit planes, into `grey`.

    Parameters
    ----------
    image : (h, w). xy : (n, 2) centres. to_image : (n, 2, 2) from the unit plane to pixels. rho : (r,) radii.
    circle : (m, 2) directions. grey : (n, r, m), changed in place.

    Returns
    -------
    (n,) bool, whether all places lie in the image.
    """
    height, width = image.shape
    complete = np.ones(len(xy), np.bool_)
    for k in range(len(xy)):
        for i in range(len(rho)):
            for j in range(len(circle)):
                u, v = rho[i] * circle[j, 0], rho[i] * circle[j, 1]
                x = to_image[k, 0, 0] * u + to_image[k, 0, 1] * v + xy[k, 0]
                y = to_image[k, 1, 0] * u + to_image[k, 1, 1] * v + xy[k, 1]
                if not (x >= 0.0 and y >= 0.0 and x <= width - 1 and y <= height - 1):
                    complete[k] = False
                    x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
                column, row = min(int(x), width - 2), min(int(y), height - 2)
                fx, fy = x - column, y - row
                upper = image[row, column] * (1.0 - fx) + image[row, column + 1] * fx
                lower = image[row + 1, column] * (1.0 - fx) + image[row + 1, column + 1] * fx
                grey[k, i, j] = upper * (1.0 - fy) + lower * fy
    return complete


@compiled
def blur_segments(angles, phase, sigma, brightness, density):  # type: ignore[no-untyped-def]
    """Brightness of bright segments of equal size, blurred along the angle, and its change, into arrays (n, m, k).

    Parameters
    ----------
    angles : (m,), rad. phase : (n,) where the first of k segments begins. sigma : (n, m) blur, rad.
    brightness, density : changed in place; density is the brightness' derivative by the angle.
    """
    segments = brightness.shape[2]
    width = 2.0 * math.pi / segments
    half = 0.5 * width
    for n in range(len(phase)):
        for m in range(len(angles)):
            blur = sigma[n, m]
            for k in range(segments):
                turn = angles[m] - phase[n] - (k + 0.5) * width + math.pi
                delta = turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi)) - math.pi
                upper, lower = (delta + half) / blur, (delta - half) / blur
                if lower > _FAR or upper < -_FAR:
                    brightness[n, m, k] = density[n, m, k] = 0.0
                    continue
                brightness[n, m, k] = 0.5 * (math.erf(upper * _ROOT_HALF) - math.erf(lower * _ROOT_HALF))
                density[n, m, k] = _DENSITY * (math.exp(-0.5 * upper**2) - math.exp(-0.5 * lower**2)) / blur
