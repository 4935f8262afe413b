"""What a hand-eye calibration found."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from robcal.estimation.summary import SolveSummary
from robcal.handeye.data import BoolArray, Mounted
from robcal.handeye.fit import Fit
from robcal.handeye.shape import SHAPE_NAMES
from robcal.handeye.unknowns import Variances
from robcal.photogrammetry.core.camera import Camera
from robcal.transforms import Array, adjoint, difference, invert


@dataclass(frozen=True)
class RejectedImage:
    """An image that was left out, and why."""

    image: int
    reason: str


@dataclass(frozen=True)
class Moved:
    """The ``board`` or the ``camera`` stands elsewhere from an image on.

    ``change`` (6,) right twist of its frame from before to after, ``covariance`` (6, 6).
    """

    kind: str
    image: int
    change: Array
    covariance: Array


@dataclass(frozen=True)
class HeldOut:
    """How far marks of images that took no part are from where the calibration puts them.

    ``px`` and ``mm`` root mean square distances, across the line of sight at the board; ``images`` their number;
    ``folds`` true where all images were kept out in turn.
    """

    px: float
    mm: float
    images: int
    folds: bool


@dataclass(frozen=True)
class HandEye:
    """A hand-eye calibration.

    Attributes
    ----------
    X : (4, 4) ``flange_T_camera`` (in the hand) or ``base_T_camera``: of a camera that moved, where it sits since.
    Z : (4, 4) ``base_T_board`` or ``flange_T_board``: of a board that moved, where it stood at first.
    covariance : (12, 12) of the right twists of X and Z, metres and radians.
    camera : interior orientation; camera_sigma : by name, of those that were free.
    variances : noise of the marks over what is stated (``pixel``, sigma0), scatter of the robot (m, rad a coordinate).
    shape, shape_sigma : deviations of the board that the images show, by name (scale; bends in 1/m).
    robot, robot_covariance : (p,), (p, p) deviations of the robot in the order of ``robot_names``; ``with_robot``
        (12, p) their covariance with X and Z.
    used : (n,) images that took part; image_px : (n,) root mean square distance of their marks, as predicted from
        the robot; residuals : (m, 2) px with the robot's misses taken out; marks : (m,) that took part.
    rejected : images that were left out; moved : a board or camera that was pushed.
    """

    mounted: Mounted
    X: Array
    Z: Array
    covariance: Array = field(repr=False)
    camera: Camera
    camera_sigma: Mapping[str, float]
    variances: Variances
    shape: Mapping[str, float]
    shape_sigma: Mapping[str, float]
    robot_names: tuple[str, ...]
    robot: Array = field(repr=False)
    robot_covariance: Array = field(repr=False)
    with_robot: Array = field(repr=False)
    used: BoolArray = field(repr=False)
    image_px: Array = field(repr=False)
    twist: Array = field(repr=False)
    residuals: Array = field(repr=False)
    marks: BoolArray = field(repr=False)
    rejected: tuple[RejectedImage, ...]
    moved: Moved | None
    heldout: HeldOut | None
    summary: SolveSummary
    notes: tuple[str, ...] = ()

    @property
    def sigma(self) -> Array:
        """(12,) standard deviations of X and Z."""
        return np.sqrt(np.diag(self.covariance))


def collected(
    fit: Fit, used: BoolArray, rejected: tuple[RejectedImage, ...], heldout: HeldOut | None, notes: tuple[str, ...]
) -> HandEye:
    """Everything about a fit."""
    data, layout, solved = fit.problem.data, fit.problem.layout, fit.solved
    state, Q = solved.state, solved.covariance()
    x, z, lens, shape, robot = layout.parts(state)
    both = np.concatenate([np.arange(x.stop - 6, x.stop), np.arange(z.start, z.start + 6)])
    names = tuple(data.robot.names) if layout.robot and data.robot is not None else ()
    sigma = np.sqrt(np.clip(np.diag(Q), 0.0, None))
    lens_names = [data.camera.names[k] for k in layout.lens]
    return HandEye(
        mounted=data.mounted,
        X=state.X[-1],
        Z=state.Z[0],
        covariance=Q[np.ix_(both, both)],
        camera=state.camera,
        camera_sigma=dict(zip(lens_names, sigma[lens].tolist(), strict=True)),
        variances=solved.variances,
        shape={SHAPE_NAMES[k]: float(state.shape[k]) for k in layout.shape},
        shape_sigma={SHAPE_NAMES[k]: float(s) for k, s in zip(layout.shape, sigma[shape], strict=True)},
        robot_names=names,
        robot=state.robot if names else np.zeros(0),
        robot_covariance=Q[robot, robot],
        with_robot=Q[both][:, robot],
        used=used,
        image_px=fit.image_px(),
        twist=state.twist,
        residuals=fit.pixels(state.twist),
        marks=fit.problem.used,
        rejected=rejected,
        moved=_moved(fit, Q),
        heldout=heldout,
        summary=solved.summary,
        notes=notes,
    )


def _moved(fit: Fit, Q: Array) -> Moved | None:
    """The move from the first to the second X or Z: ``D`` of ``Z2 = Z1 D``, its covariance from both frames'."""
    state, layout = fit.solved.state, fit.problem.layout
    x, z = layout.parts(state)[:2]
    for kind, frames, part, which in (("board", state.Z, z, layout.of_Z), ("camera", state.X, x, layout.of_X)):
        if len(frames) == 2:
            change = difference(frames[0], frames[1])
            # the twist of D by those of both frames, on its right
            back = invert(frames[1]) @ frames[0]
            J = np.concatenate([-adjoint(back), np.eye(6)], axis=1)
            C = J @ Q[part, part] @ J.T
            return Moved(kind, int(np.argmax(which == 1)), change, C)
    return None
