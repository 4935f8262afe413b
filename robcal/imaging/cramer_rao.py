"""Least variance with which a dot's centre can be known from one image (Cramer-Rao bound).

For independent normal noise of known variance v per pixel the Fisher information of parameters p of the expected grey
values m is sum (dm/dp)' (dm/dp) / v; the bound of the centre is the upper left block of its inverse (Kay 1993,
"Fundamentals of Statistical Signal Processing: Estimation Theory", sec. 3.9).
"""

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.imaging.edge_model import blurred_ellipse, matrix_from_axes, spot
from robcal.imaging.noise import NoiseModel

Array = NDArray[np.float64]


def centre_bound(
    semi_axes: tuple[float, float],
    angle: float,
    blur: float,
    contrast: float,
    background: float,
    noise: NoiseModel,
    *,
    phase: tuple[float, float] = (0.0, 0.0),
    known_shape: bool = False,
) -> Array:
    """(2, 2) bound of the centre of an evenly bright ellipse on an even background.

    Parameters
    ----------
    semi_axes : px. angle : of the first, rad. blur : of the lens, px (the pixel's 1/12 is added).
    contrast, background : grey values. noise : noise model. phase : of the centre within its pixel, px.
    known_shape : True if everything but the centre is known; else axes, angle, blur, contrast, background are unknown.

    Raises
    ------
    InvalidInput : axes, blur or contrast that are not positive.
    """
    if min(semi_axes) <= 0 or blur < 0 or contrast == 0:
        raise InvalidInput("semi-axes must be positive, blur not negative and contrast not zero")
    s = float(np.sqrt(blur**2 + 1.0 / 12.0))
    half = int(np.ceil(max(semi_axes) + 6.0 * s + 2.0))
    grid = np.arange(-half, half + 1.0)
    x, y = (array.reshape(1, -1) for array in np.meshgrid(grid, grid))
    axes, turn = np.array([semi_axes], dtype=float), np.array([angle])
    small = min(semi_axes) < 2.0 * s
    if small:
        # the light of the disc in a Gaussian spot of the same second moments (a quarter of the squared semi-axes)
        second = np.sqrt(s**2 + axes**2 / 4.0)
        contrast = contrast * float(np.prod(axes) / (2.0 * np.prod(second)))
        axes = second
    shape = np.concatenate([[phase], matrix_from_axes(axes, turn), [[np.log(s)]]], axis=1)
    profile, by_shape = spot(shape, x, y) if small else blurred_ellipse(shape, x, y)
    columns = by_shape[0].T * contrast
    if small:
        columns = columns[:, :5]  # size and blur are one
    everything = np.column_stack([columns, profile[0], np.ones(profile.shape[1])])
    columns = columns[:, :2] if known_shape else everything
    weight = 1.0 / noise.at(background + contrast * profile[0])
    return np.asarray(np.linalg.inv((columns * weight[:, None]).T @ columns)[:2, :2])
