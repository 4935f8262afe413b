"""Hand-eye calibration by maximum likelihood over all marks, with what images and robot do wrong told.

Closed-form start from poses of the board in single images, judged in the images; then camera and board in their
carriers, interior orientation, the shape of the board and the robot's geometry where the data carry them, and the
robot's misses from pose to pose as random twists of estimated size. Images that contradict all others are left out
and named, a board or camera that was pushed is told from them.
"""

from dataclasses import dataclass, replace

import numpy as np

from robcal.errors import InvalidInput, NotIdentifiable
from robcal.estimation.reliability import critical_value
from robcal.handeye.checks import held_out, rejected
from robcal.handeye.choices import awake, jumped, with_robot, with_shape, with_step, without_shape
from robcal.handeye.closed_form import Start, start_values
from robcal.handeye.data import BoolArray, HandEyeData, Mounted
from robcal.handeye.fit import Fit, fitted
from robcal.handeye.images import critical
from robcal.handeye.motion import check_motion, weak_motion
from robcal.handeye.moves import find_jump
from robcal.handeye.problem import Problem
from robcal.handeye.result import HandEye, collected
from robcal.handeye.shape import SHAPE_NAMES
from robcal.handeye.single_images import SingleImages, discrepancies, resect, start_camera
from robcal.handeye.unknowns import Layout, State, Variances
from robcal.photogrammetry.core.bodies import IntArray
from robcal.transforms import Array, invert, retract

GROSS = 10.0
"""Twists this many robust standard deviations long are left out of the first adjustment."""
MOST_WRONG = 0.4
"""Share of images that may contradict the others."""
MARK_LEVEL = 0.01
"""Probability with which the worst of all good marks is left out."""


@dataclass(frozen=True)
class Options:
    """What is free, beside camera and board in their carriers.

    Attributes
    ----------
    hold_camera : the interior orientation is exact. start_camera : the data's camera has start values; else it is
        calibrated from the images. adjust_robot : the robot's geometry, where the images carry it.
    """

    hold_camera: bool = False
    start_camera: bool = True
    adjust_robot: bool = False


def calibrate(data: HandEyeData, options: Options = Options(), verify: BoolArray | None = None) -> HandEye:
    """Calibrate.

    Parameters
    ----------
    verify : (n,) images that take no part and are compared only; without, all are kept out in turn for that.

    Raises
    ------
    NotIdentifiable : the images cannot tell where the camera is; the message names the missing motion.
    InvalidInput : they contradict one another.
    """
    kept_out = np.zeros(data.n, dtype=bool) if verify is None else verify
    seen = (np.bincount(data.image, minlength=data.n) > 0) & ~kept_out
    model, q = (None, None) if data.robot is None else (data.robot.kernel.model, data.robot.inputs.q[seen])
    check_motion(data.base_T_flange[seen], data.mounted, model, q)
    if not options.start_camera:
        data = replace(data, camera=start_camera(data.select(seen), (data.camera.width, data.camera.height)))
    single = resect(data, data.camera)
    usable = single.usable & ~kept_out
    check_motion(data.base_T_flange[usable], data.mounted, model, None if q is None else _joints(data, usable))
    start = _start(data, single, kept_out)
    fit, used = _adjusted(data, options, single, start, usable)
    fit, used = _refined(fit, used, usable, options)
    notes = [weak_motion(data.base_T_flange[used])]
    out = rejected(data, single, fit, used, kept_out)
    return collected(fit, used, out, held_out(fit, used, kept_out), tuple(note for note in notes if note))


def _joints(data: HandEyeData, images: BoolArray) -> Array:
    assert data.robot is not None
    return data.robot.inputs.q[images]


def _start(data: HandEyeData, single: SingleImages, kept_out: BoolArray) -> Start:
    """The closed-form start; refused where hardly two images agree on one.

    Raises
    ------
    InvalidInput : no start fits, or only one for the camera mounted in the other way.
    """
    hidden = np.where(kept_out[:, None, None], np.nan, single.camera_T_board)
    other = np.where(kept_out[:, None, None], np.nan, single.other)
    start = start_values(data, data.camera, hidden, other)
    wrong = float(np.quantile(start.image_px[single.usable & ~kept_out], 0.3))
    if wrong < 0.03 * data.camera.width:
        return start
    turned: Mounted = "world" if data.mounted == "hand" else "hand"
    swapped = replace(data, mounted=turned)
    try:
        check_motion(data.base_T_flange[single.usable & ~kept_out], turned)
        better = float(np.quantile(start_values(swapped, data.camera, hidden, other).image_px, 0.3))
    except NotIdentifiable:
        better = np.inf
    message = f"no camera and board agree with the poses: most images miss by more than {wrong:.0f} px"
    if better < 0.2 * wrong:
        raise InvalidInput(f"{message}, but with 'mounted: {turned}' by {better:.1f} px: state that")
    raise InvalidInput(
        f"{message}: do the images belong to these poses, do the joint angles belong to this robot file, are the "
        "board's kind, columns, rows and sizes right?"
    )


def _adjusted(
    data: HandEyeData, options: Options, single: SingleImages, start: Start, usable: BoolArray
) -> tuple[Fit, BoolArray]:
    """First adjustment, without what is grossly wrong; a jump of board or camera is two places of it."""
    n = data.n
    none: IntArray = np.zeros(n, dtype=np.int64)
    X, Z = start.X[None], start.Z[None]
    of_X, of_Z = none, none
    lever = float(np.ptp(data.body.points[data.body.known], axis=0).max())
    views = invert(start.X) @ invert(data.carriers()) @ start.Z
    nearest = retract(views, discrepancies(data, views, single))
    jump = find_jump(views, np.where(usable[:, None, None], nearest, np.nan), lever)
    if jump is not None:
        X, Z, of_X, of_Z = jumped(jump, X, Z, n)
        views = invert(X[of_X]) @ invert(data.carriers()) @ Z[of_Z]
    used, scale = _without_gross(discrepancies(data, views, single), usable)
    lens = np.zeros(0, dtype=np.int64) if options.hold_camera else np.arange(len(data.camera.names))
    layout = Layout(of_X, of_Z, lens, np.zeros(0, dtype=np.int64))
    state = State(data.camera, X, Z, np.zeros(len(SHAPE_NAMES)), np.zeros(0), np.zeros((n, 6)))
    problem = Problem(data, layout, used[data.image])
    fit = fitted(problem, state, Variances(single.pixel, *scale))
    return fit, used


def _without_gross(twist: Array, usable: BoolArray) -> tuple[BoolArray, tuple[float, float]]:
    """Images without gross contradictions, and robust standard deviations of place and turn of the others."""
    place, turn = (np.linalg.norm(twist[:, part], axis=1) for part in (slice(0, 3), slice(3, 6)))
    # the median length of three normal numbers is 1.54 standard deviations; 0.4 leaves room for wrong ones
    scales = [max(float(np.quantile(v[usable], 0.4)) / 1.37, 1e-6) for v in (place, turn)]
    good = usable & (place <= GROSS * scales[0]) & (turn <= GROSS * scales[1])
    return good, (scales[0], scales[1])


def _refined(fit: Fit, used: BoolArray, usable: BoolArray, options: Options) -> tuple[Fit, BoolArray]:
    """Leave out what contradicts, take in what does not; then what else the images carry."""
    fit, used = _consistent(with_shape(fit), used, usable)
    stepped = with_step(fit, used)
    if stepped is not None:
        fit, used = _consistent(stepped, used, usable)
    shaped = with_shape(fit)
    if options.adjust_robot and fit.problem.data.robot is not None:
        adjusted = with_robot(shaped, used)
        if adjusted is not None:
            again = with_shape(without_shape(adjusted))
            return _consistent(again, used, usable)
    if shaped is not fit:
        return _consistent(shaped, used, usable)
    return fit, used


def _consistent(fit: Fit, used: BoolArray, usable: BoolArray) -> tuple[Fit, BoolArray]:
    """Images and marks that agree with one another, one change at a time.

    Raises
    ------
    InvalidInput : too many images contradict one another.
    """
    for _ in range(int(usable.sum())):
        marks = _good_marks(fit, used)
        statistic = fit.statistics(used)
        limit = critical(int(used.sum()))
        new = used.copy()
        back = usable & ~used & (statistic <= limit)
        worst = int(np.argmax(np.where(used, np.nan_to_num(statistic), -np.inf)))
        if back.any():
            new |= back
        elif statistic[worst] > limit:
            new[worst] = False
        elif np.array_equal(marks, fit.problem.used):
            return fit, used
        if new.sum() < max(3, (1.0 - MOST_WRONG) * usable.sum()):
            raise InvalidInput(
                f"{int(usable.sum() - new.sum())} of {int(usable.sum())} images contradict the others: do the images "
                "belong to these poses (file stem = pose), and did board and camera stay where they are?"
            )
        used = new
        problem = replace(fit.problem, used=_good_marks(fit, used))
        fit = fitted(problem, fit.solved.state, awake(fit.solved.variances))
    return fit, used


def _good_marks(fit: Fit, used: BoolArray) -> BoolArray:
    """(m,) marks of the images in use that fit the best place of their image."""
    problem, solved = fit.problem, fit.solved
    state = solved.state
    twist = np.where(used[:, None], state.twist, 0.0)
    r = problem.residuals(replace(state, twist=twist)) / solved.variances.pixel
    length = np.sum(r**2, axis=1)
    image = problem.data.image
    good = used[image] & (length <= critical_value(len(length), MARK_LEVEL))
    # an image that is only now taken in has no twist yet
    old = np.bincount(image[problem.used], minlength=len(used)) > 0
    return np.asarray(good | (used & ~old)[image])
