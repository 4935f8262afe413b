"""Deviations of a board from its drawing: printed larger or smaller, and bent.

A print is out by its scale, along the sheet and across it alike to first order; a sheet on a board that is not flat is
bent like a paraboloid: ``z = a x^2 + b x y + c y^2`` about the board's middle.
"""

import numpy as np

from robcal.photogrammetry.core.bodies import Body
from robcal.transforms import Array

SHAPE_NAMES = ("scale", "bend_xx", "bend_xy", "bend_yy")
"""Scale (1) and bends (1/m), in the order of the vectors here."""


def shape_columns(body: Body) -> tuple[str, ...]:
    """Deviations that make sense for a body: none where its coordinates carry a covariance, bends for planes only."""
    if body.covariance is not None:
        return ()
    return SHAPE_NAMES if body.is_plane() else SHAPE_NAMES[:1]


def directions(body: Body) -> Array:
    """(t, 3, 4) derivative of the targets' coordinates by the deviations; zero at the middle of the board."""
    known = body.points[body.known]
    centre = known.mean(axis=0)
    centred = np.where(body.known[:, None], body.points - centre, 0.0)
    out = np.zeros((len(body), 3, 4))
    out[:, :, 0] = centred
    if body.is_plane():
        _, _, axes = np.linalg.svd(known - centre)
        normal = axes[2] if axes[2] @ [0.0, 0.0, 1.0] >= 0 else -axes[2]
        # along the board's own x and y where it lies in that plane, as boards do
        along = np.eye(3)[:2] if abs(normal[2]) > 0.999 else axes[:2]
        u, v = (centred @ along.T).T
        for k, bend in enumerate((u * u, u * v, v * v), start=1):
            # without its mean, so that a bend is no shift of the whole board
            out[:, :, k] = (bend - bend[body.known].mean())[:, None] * normal
    return out
