"""How good a hand-eye calibration is at images that took no part, and why images were left out."""

from dataclasses import replace

import numpy as np

from robcal.estimation.summary import TerminationSettings
from robcal.handeye.closed_form import image_errors
from robcal.handeye.data import BoolArray, HandEyeData
from robcal.handeye.fit import Fit, mean_by_image
from robcal.handeye.result import HeldOut, RejectedImage
from robcal.handeye.single_images import SingleImages
from robcal.photogrammetry.core.bodies import IntArray
from robcal.transforms import Array

FOLDS = 6
NEAR = TerminationSettings(3, 6, 1e-6)
"""A fold is solved from the solution with all images, next to its own."""


def rejected(
    data: HandEyeData, single: SingleImages, fit: Fit, used: BoolArray, kept_out: BoolArray
) -> tuple[RejectedImage, ...]:
    """Why images are left out: without a pose, or against all others; another pose that fits is named by its number."""
    out = []
    px = fit.image_px()
    for i in map(int, np.flatnonzero(~used & ~kept_out)):
        if i in single.failed:
            if np.any(data.image == i):
                out.append(RejectedImage(i, single.failed[i]))
            continue
        other = _belongs_to(fit, i, used)
        reason = f"contradicts all others: the board is {px[i]:.3g} px from where the pose puts it"
        if other is not None:
            reason += f"; it fits the joint angles of pose {{{other}}}"
        out.append(RejectedImage(i, reason))
    return tuple(out)


def _belongs_to(fit: Fit, image: int, used: BoolArray) -> int | None:
    """Another pose whose flange explains an image as well as the others are explained; None if none does."""
    data, state = fit.problem.data, fit.solved.state
    rows = data.image == image
    flanges = fit.problem.flanges(state)[0]
    alone = replace(
        data,
        base_T_flange=flanges,
        image=np.zeros(int(rows.sum()), dtype=np.int64),
        target=data.target[rows],
        xy=data.xy[rows],
        covariance=data.covariance[rows],
        robot=None,
    )
    of_X, of_Z = fit.problem.layout.of_X[image], fit.problem.layout.of_Z[image]
    X, Z = state.X[None, of_X], state.Z[None, of_Z]
    errors = np.array([image_errors(replace(alone, base_T_flange=F[None]), state.camera, X, Z)[0, 0] for F in flanges])
    errors[image] = np.inf
    typical = float(np.nanmax(fit.image_px()[used]))
    best = int(np.argmin(errors))
    return best if errors[best] <= 2.0 * typical else None


def held_out(fit: Fit, used: BoolArray, kept_out: BoolArray) -> HeldOut | None:
    """Images that took no part against the calibration; without any, folds of those that did."""
    data = fit.problem.data
    square_px, square_mm = np.sum(fit.pixels() ** 2, axis=1), fit.millimetres()
    shown = np.isin(data.image, np.flatnonzero(kept_out))
    if kept_out.any():
        return _means(data, square_px[shown], square_mm[shown], data.image[shown], folds=False)
    order = np.flatnonzero(used)
    folds = min(FOLDS, len(order) // 3)
    if folds < 2:
        return None
    px, mm, image = [], [], []
    for fold in range(folds):
        out = np.isin(data.image, order[fold::folds])
        problem = replace(fit.problem, used=fit.problem.used & ~out)
        again = replace(fit, problem=problem, solved=problem.solve(fit.solved.state, fit.solved.variances, NEAR))
        mine = out & fit.problem.used
        px.append(np.sum(again.pixels() ** 2, axis=1)[mine])
        mm.append(again.millimetres()[mine])
        image.append(data.image[mine])
    return _means(data, np.concatenate(px), np.concatenate(mm), np.concatenate(image), folds=True)


def _means(data: HandEyeData, px: Array, mm: Array, image: IntArray, folds: bool) -> HeldOut | None:
    if not len(image):
        return None
    each = [mean_by_image(square, image, data.n) for square in (px, mm)]
    rms = [float(np.sqrt(np.nanmean(values**2))) for values in each]
    return HeldOut(rms[0], 1e3 * rms[1], len(np.unique(image)), folds)
