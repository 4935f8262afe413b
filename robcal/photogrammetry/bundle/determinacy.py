"""What a network does not determine: unknowns whose effect in the image could be anything, and near-equal unknowns."""

from collections.abc import Sequence

import numpy as np

from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.core.network import Correlation
from robcal.transforms import Array

STATION_NAMES = ("x", "y", "z", "rx", "ry", "rz")

_DISTORTION_SHARE = 0.005
"""A distortion term is undetermined if its effect at the outermost mark is uncertain by this share of the image."""
_CENTRE_SHARE = 0.05
"""The same for the principal point."""
_FOCAL_SHARE = 0.02
"""Relative standard deviation from which on a focal length counts as undetermined.

Beyond a few per cent the linearised standard deviation is too small itself: tilts and heights made of noise seem to
carry information on the focal length (simulated frontal plates: off by six such standard deviations)."""


def intrinsics_basis(names: Sequence[str]) -> Array:
    """(9, k) free changes of the interior orientation; the name ``f`` changes fx and fy alike."""
    columns = []
    for name in names:
        column = np.zeros(len(INTRINSIC_NAMES))
        if name == "f":
            column[:2] = 1.0
        else:
            column[INTRINSIC_NAMES.index(name)] = 1.0
        columns.append(column)
    return np.array(columns).reshape(-1, len(INTRINSIC_NAMES)).T


def image_effects(camera: Camera, radius: float) -> dict[str, float]:
    """Displacement in px at ideal radius ``radius`` per unit of each distortion coefficient (the largest)."""
    f = 0.5 * (camera.fx + camera.fy)
    return {
        "k1": f * radius**3,
        "k2": f * radius**5,
        "k3": f * radius**7,
        "p1": 3.0 * f * radius**2,
        "p2": 3.0 * f * radius**2,
    }


def undetermined(names: Sequence[str], sigma: Array, camera: Camera, radius: float) -> tuple[str, ...]:
    """Names of free intrinsics that are undetermined; those to leave out first (highest order) come first.

    Parameters
    ----------
    names, sigma : the free numbers and their standard deviations (k,).
    radius : ideal radius (x/z, y/z) of the outermost mark.
    """
    size = max(camera.width, camera.height)
    effects = image_effects(camera, radius)
    out: list[str] = []
    for name in ("k1", "k2", "k3", "p1", "p2", "cx", "cy", "fy", "fx", "f"):
        if name not in names:
            continue
        s = float(sigma[list(names).index(name)])
        if name in effects:
            bad = not s * effects[name] < _DISTORTION_SHARE * size
        elif name in ("cx", "cy"):
            bad = not s < _CENTRE_SHARE * size
        else:
            bad = not s < _FOCAL_SHARE * camera.fx
        if bad or (name in ("k2", "k3") and {"k1", "k2"} & set(out)):
            # no lower power of the radius is held while a higher one is free
            out.append(name)
    order = ("k3", "k2", "p1", "p2", "k1", "cx", "cy", "fy", "fx", "f")
    return tuple(sorted(out, key=order.index))


def strong_correlations(
    names: Sequence[str],
    image_names: Sequence[str],
    Q_camera: Array,
    Q_mixed: Array,
    Q_station: Array,
    limit: float = 0.95,
    most: int = 40,
) -> tuple[Correlation, ...]:
    """Pairs above ``limit`` among the intrinsics (k, k), and of intrinsics with stations (mixed (k, n, 6))."""
    sigma = np.sqrt(np.maximum(np.diag(Q_camera), 1e-300))
    among = Q_camera / sigma[:, None] / sigma[None, :]
    found = [
        Correlation(names[i], names[j], float(among[i, j]))
        for i in range(len(names))
        for j in range(i)
        if abs(among[i, j]) > limit
    ]
    station_sigma = np.sqrt(np.maximum(np.diagonal(Q_station, axis1=1, axis2=2), 1e-300))
    mixed = Q_mixed / sigma[:, None, None] / station_sigma[None]
    found.sort(key=lambda c: -abs(c.value))
    rows = np.argwhere(np.abs(mixed) > limit)
    rows = rows[np.argsort(-np.abs(mixed[tuple(rows.T)]))][: max(most - len(found), 0)]
    found += [
        Correlation(names[i], f"{image_names[j]}.{STATION_NAMES[q]}", float(mixed[i, j, q]))
        for i, j, q in rows.tolist()
    ]
    return tuple(found)


def singular_unknowns(S: Array, names: Sequence[str], ids: Sequence[int]) -> tuple[str, ...]:
    """Names with a large part in the weakest direction of an equilibrated reduced system (intrinsics, then points)."""
    _, vectors = np.linalg.eigh(S)
    weakest = np.abs(vectors[:, 0])
    k = len(names)
    found = [names[i] for i in range(k) if weakest[i] > 0.1]
    rows = np.flatnonzero(weakest[k:] > 0.3 * np.max(weakest[k:], initial=0.0))
    if not found:
        found = [f"target {ids[r // 3]}.{'xyz'[r % 3]}" for r in rows[:6].tolist() if r // 3 < len(ids)]
    return tuple(found)
