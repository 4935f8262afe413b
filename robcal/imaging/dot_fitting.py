"""From candidates to fitted dots: the ellipse fits of an image with the statistics of all its dots.

Two rounds. The first fits every dot by itself. Then all dots together show how the noise grows with brightness and how
strong gain gradients are in this image; the second round uses both, leaves out single outlying pixels and replaces the
edge model by a Gaussian spot where the dot is not larger than its blur.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.columns import Columns
from robcal.imaging.blobs import Candidates
from robcal.imaging.edge_model import axes_from_matrix, matrix_from_axes
from robcal.imaging.ellipse_fit import EllipseFits, iterate, outliers, start
from robcal.imaging.image_statistics import noise_around, noise_correlation, noise_inside, shading_priors, without_doubt
from robcal.imaging.noise import NoiseModel
from robcal.imaging.ring_code import RingReadings, ring_glare
from robcal.imaging.windows import Windows, gather_windows

Array = NDArray[np.float64]

_PIXEL_VARIANCE = 1.0 / 12.0
# systematic part of the centre that no noise covers (model misfit, pixel response), px; see edge_model
_FLOOR_EDGE, _FLOOR_SPOT = 0.001, 0.006
_GLARE_MAX = 0.015  # of the dot's contrast: light of a ring that is taken off; pixels with more are left out
_PIXELS_MIN = 12  # pixels with information that a fit of twelve parameters needs at least
_SPOT_RATIO, _SPOT_RATIO_ROUND = 1.7, 1.2  # minor semi-axis by s below which a tilted, a round dot is a spot


@dataclass(frozen=True)
class FittedDots(Columns):
    """Fits of n candidates in columns.

    Attributes
    ----------
    xy (n, 2), covariance (n, 2, 2), b (n, 3) ellipse matrix, semi_axes (n, 2), angle (n,), s (n,) blur with the
    pixel's part, background (n,), contrast (n,), gain_gradient (n, 2) per px, chi2 (n,), misfit (n,) RMS residual
    beyond noise by contrast, residual (n,) RMS residual by contrast, saturated (n,), converged (n,), is_spot (n,),
    shading_sigma (n,) prior used.
    """

    xy: Array
    covariance: Array
    b: Array
    semi_axes: Array
    angle: Array
    s: Array
    background: Array
    contrast: Array
    gain_gradient: Array
    chi2: Array
    misfit: Array
    residual: Array
    saturated: NDArray[np.bool_]
    converged: NDArray[np.bool_]
    is_spot: NDArray[np.bool_]
    shading_sigma: Array

    def __len__(self) -> int:
        return len(self.xy)

    def as_candidates(self) -> Candidates:
        """The fits as starts for another fit."""
        blur = np.maximum(self.s, 0.3)
        return Candidates(self.xy, self.semi_axes, self.angle, self.background, self.background + self.contrast, blur)


def fit_dots(
    image: NDArray, candidates: Candidates, noise: NoiseModel, saturation: float, max_misfit: float = 0.1
) -> tuple[FittedDots, NoiseModel, float]:
    """Fits all candidates; also returns the noise model improved by them and the prior sigma of gain gradients.

    The dots are fewer than the candidates: hopeless fits are left out, in the order of the candidates.

    Parameters
    ----------
    image : (h, w), bright dots. candidates : starts. noise : estimated from the image. saturation : grey value.
    max_misfit : fits with three times this misfit (by contrast) after the first round are given up.
    """
    groups, fits = _first_round(image, candidates, noise, saturation, max_misfit)
    clean = [without_doubt(window, fit) for window, fit in zip(groups, fits, strict=True)]
    noise = noise_inside(groups, fits, clean, noise_around(groups, fits, clean, noise))
    fits = [iterate(fit, window, noise, 2, tolerance=0.05) for window, fit in zip(groups, fits, strict=True)]
    shading, prior = shading_priors(groups, fits)
    noise = replace(noise, correlation=noise_correlation(groups, fits, clean))
    results = []
    for window, fit in zip(groups, fits, strict=True):
        results.append(_finish(fit, window, noise, shading[window.index], candidates))
    return _join(results, groups), noise, prior


def refit_ringed(
    image: NDArray, dots: FittedDots, readings: RingReadings, rows: NDArray, noise: NoiseModel, saturation: float
) -> FittedDots:
    """Fits the dots `rows` again with the glare of their own ring taken off, or left out where it is strong.

    The ring blurs into the gap. For round dots of 2.5 to 6 px radius taking it off alone leaves a bias of up to
    0.025 px towards the ring, no correction up to 0.05 px; this one leaves less than 0.008 px.
    """
    candidates = dots.select(rows).as_candidates()
    groups = gather_windows(image, candidates, saturation, neighbours=False)
    results = []
    for window in groups:
        source = rows[window.index]
        local = dots.xy[source] - window.origin
        glare = ring_glare(local, dots.b[source], dots.s[source], readings, source, window.x, window.y)
        # where the glare is more than a little its model's errors would tilt the background and pull the centre; and
        # foreign light in the window that the code does not explain
        background, contrast, s, major, cx, cy = (
            column.astype(np.float32)[:, None]
            for column in (
                dots.background[source],
                dots.contrast[source],
                dots.s[source],
                dots.semi_axes[source, 0],
                local[:, 0],
                local[:, 1],
            )
        )
        clean = replace(window, value=window.value - glare * contrast, valid=window.valid & (glare < _GLARE_MAX))
        far = (window.x - cx) ** 2 + (window.y - cy) ** 2 > (major + 2.0 * s + 0.7) ** 2
        clean = replace(clean, valid=clean.valid & ~(far & (clean.value > background + 0.2 * contrast)))
        fit = iterate(_start(candidates, clean), clean, noise, 6, tolerance=0.1)
        results.append(_finish(fit, clean, noise, dots.shading_sigma[source], candidates))
    return _join(results, groups)


def _start(candidates: Candidates, window: Windows) -> EllipseFits:
    rows = window.index
    s = np.sqrt(np.maximum(candidates.blur[rows], 0.3) ** 2)
    matrix = matrix_from_axes(candidates.semi_axes[rows], candidates.angle[rows])
    shape = np.column_stack([candidates.xy[rows] - window.origin, matrix, np.log(s)])
    return start(shape, candidates.base[rows], candidates.peak[rows], window, np.zeros(len(rows), bool))


def _first_round(
    image: NDArray, candidates: Candidates, noise: NoiseModel, saturation: float, max_misfit: float
) -> tuple[list[Windows], list[EllipseFits]]:
    """Fits of all candidates one by one; what is nowhere near an ellipse after a few steps is not pursued."""
    groups = gather_windows(image, candidates, saturation)
    kept_groups, kept_fits = [], []
    for window in groups:
        fit = iterate(_start(candidates, window), window, noise, 4, tolerance=0.2)
        used = np.maximum((fit.weight > 0).sum(axis=1), 1)
        mean_square = np.where(fit.weight > 0, fit.residual**2, 0.0).sum(axis=1) / used
        expected = np.where(fit.weight > 0, 1.0 / np.maximum(fit.weight, 1e-30), 0.0).sum(axis=1) / used
        contrast = np.abs(fit.parameters[:, 9])
        near = (window.radius < 2.0) | (mean_square - 2.0 * expected < (3.0 * max_misfit * contrast) ** 2)
        near = np.flatnonzero(near & _stays(fit, window, candidates))
        if near.size:
            window, fit = window.select(near), fit.select(near)
            kept_groups.append(window)
            kept_fits.append(iterate(fit, window, noise, 8, tolerance=0.2))
    return kept_groups, kept_fits


def _stays(fit: EllipseFits, window: Windows, candidates: Candidates) -> NDArray[np.bool_]:
    """(n,) fits that are still about the blob from which they began: beads along a line grow along it."""
    size = candidates.semi_axes[window.index, 0]
    moved = np.linalg.norm(fit.parameters[:, :2] + window.origin - candidates.xy[window.index], axis=1)
    major = axes_from_matrix(fit.parameters[:, 2:5])[0][:, 0]
    enough = (fit.weight > 0).sum(axis=1) > _PIXELS_MIN
    return np.asarray(enough & (moved < size + 1.0) & (major < 2.5 * size + 2.0))


def _finish(fit: EllipseFits, window: Windows, noise: NoiseModel, shading: Array, candidates: Candidates) -> dict:
    """Second round on one group, and its results as columns."""
    prior_blur = np.log(np.maximum(candidates.blur[window.index], 0.3))
    fit = iterate(replace(fit, shading_sigma=shading), window, noise, 12, tolerance=0.05, prior_blur=prior_blur)
    dropped = outliers(fit, window)
    dirty = np.flatnonzero(dropped.any(axis=1))
    if dirty.size:
        again = iterate(fit.select(dirty), window.select(dirty), noise, 6, 0.05, dropped[dirty], prior_blur[dirty])
        fit = fit.replaced(dirty, again)
    semi_axes, _ = axes_from_matrix(fit.parameters[:, 2:5])
    ratio = semi_axes[:, 1] / np.exp(fit.parameters[:, 5])
    tiny = (ratio < _SPOT_RATIO_ROUND) | ((ratio < _SPOT_RATIO) & (semi_axes[:, 1] < 0.85 * semi_axes[:, 0]))
    if tiny.any():
        fit = _as_spots(fit, window, noise, np.flatnonzero(tiny), prior_blur, dropped)
    return _columns(fit, window, noise)


def _as_spots(
    fit: EllipseFits, window: Windows, noise: NoiseModel, rows: NDArray, prior_blur: Array, dropped: NDArray
) -> EllipseFits:
    """Replaces the fits of `rows` by Gaussian spots of the same second moments."""
    chosen, old = window.select(rows), fit.select(rows)
    semi_axes, angle = axes_from_matrix(old.parameters[:, 2:5])
    parameters = old.parameters.copy()
    second = np.sqrt(np.exp(2.0 * parameters[:, 5, None]) + semi_axes**2 / 4.0)
    parameters[:, 2:5] = matrix_from_axes(second, angle)
    spots = replace(old, parameters=parameters, is_spot=np.ones(len(rows), bool))
    for steps in (4, 10):
        spots = iterate(spots, chosen, noise, steps, 0.05, dropped[rows], prior_blur[rows])
    return fit.replaced(rows, spots)


def _columns(fit: EllipseFits, window: Windows, noise: NoiseModel) -> dict:
    parameters = fit.parameters
    inverse = fit.covariance()
    used = (fit.weight > 0).sum(axis=1)
    dof = np.maximum(used - 10, 1)
    chi2 = np.einsum("np,np,np->n", fit.weight, fit.residual, fit.residual) / dof
    mean_square = np.where(fit.weight > 0, fit.residual**2, 0.0).sum(axis=1) / dof
    expected = np.where(fit.weight > 0, 1.0 / np.maximum(fit.weight, 1e-30), 0.0).sum(axis=1) / np.maximum(used, 1)
    contrast = parameters[:, 9]
    safe = np.maximum(np.abs(contrast), 1e-6)
    # beyond its own scatter chi2 indicates misfit or underestimated noise; correlated noise counts by its block means
    excess = np.where(chi2 > 1.0 + 3.0 * np.sqrt(2.0 / dof), chi2, 1.0)
    covariance = inverse[:, :2, :2] * (excess * noise.correlation)[:, None, None]
    floor = np.where(fit.is_spot, _FLOOR_SPOT, _FLOOR_EDGE)
    covariance = covariance + floor[:, None, None] ** 2 * np.eye(2)
    s = np.exp(parameters[:, 5])
    semi_axes, angle = axes_from_matrix(parameters[:, 2:5])
    return {
        "xy": parameters[:, :2] + window.origin,
        "covariance": covariance,
        "b": parameters[:, 2:5],
        "semi_axes": semi_axes,
        "angle": angle,
        "s": s,
        "background": parameters[:, 6],
        "contrast": contrast,
        "gain_gradient": parameters[:, 10:12] / (safe * window.radius)[:, None],
        "chi2": chi2,
        "misfit": np.sqrt(np.maximum(mean_square - expected, 0.0)) / safe,
        "residual": np.sqrt(mean_square) / safe,
        "saturated": (window.saturated & window.valid).any(axis=1),
        "converged": fit.converged & (used > _PIXELS_MIN),
        "is_spot": fit.is_spot,
        "shading_sigma": fit.shading_sigma,
    }


def _join(results: list[dict], groups: list[Windows]) -> FittedDots:
    """Columns of all groups in the order of the candidates fitted; axes of spots by the blur of the others."""
    if not results:
        real, flag = np.zeros(0), np.zeros(0, bool)
        return FittedDots(
            xy=np.zeros((0, 2)),
            covariance=np.zeros((0, 2, 2)),
            b=np.zeros((0, 3)),
            semi_axes=np.zeros((0, 2)),
            angle=real,
            s=real,
            background=real,
            contrast=real,
            gain_gradient=np.zeros((0, 2)),
            chi2=real,
            misfit=real,
            residual=real,
            saturated=flag,
            converged=flag,
            is_spot=flag,
            shading_sigma=real,
        )
    order = np.argsort(np.concatenate([window.index for window in groups]))
    columns = {name: np.concatenate([result[name] for result in results])[order] for name in results[0]}
    spots = columns["is_spot"]
    if spots.any():
        edges = ~spots & columns["converged"]
        s = float(np.median(columns["s"][edges])) if edges.any() else 0.6
        # second moments of a disc: a quarter of the squared semi-axes
        axes = 2.0 * np.sqrt(np.maximum(columns["semi_axes"][spots] ** 2 - s**2, 0.15**2))
        columns["semi_axes"][spots], columns["s"][spots] = axes, s
        columns["b"][spots] = matrix_from_axes(axes, columns["angle"][spots])
    return FittedDots(**columns)


def blur_without_pixel(s: Array) -> Array:
    """Standard deviation of the lens's blur from that of the edge profile."""
    return np.sqrt(np.maximum(s**2 - _PIXEL_VARIANCE, 0.0))
