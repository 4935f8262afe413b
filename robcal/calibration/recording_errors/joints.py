"""Faults of the joint log and of the robot file: senses, units, columns, couplings, axes."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, permutations, product

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.recording_errors.recorded import Recorded, Trial

Array = NDArray[np.float64]

MOST_SENSES = 8
"""Joints of which all sets of wrong senses are tried; of more, sets of up to three."""


def listed(words: Sequence[str]) -> str:
    """'a', 'a and b', 'a, b and c'."""
    return "".join(words) if len(words) < 2 else f"{', '.join(words[:-1])} and {words[-1]}"


def joint_trials(recorded: Recorded, fast: bool) -> Iterator[Trial]:
    """Units, senses and columns of the joint log; where a trial takes long (not ``fast``), the common ones alone."""
    names = [f.name for f in recorded.model.joints]
    yield from _units(np.array([not f.prismatic for f in recorded.model.joints]))
    if not recorded.model.is_hexapod:  # a leg has no negative length
        yield from _senses(names, fast)
    for i, k in combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[i, k]] = k, i
        words = f"the columns of {'legs' if recorded.model.is_hexapod else 'joints'} {i + 1} and {k + 1} are exchanged"
        yield Trial("exchanged_columns", f"{names[i]} and {names[k]}", words, "exchange the two columns", _take(order))


def chain_trials(recorded: Recorded) -> Iterator[Trial]:
    """Coupled joints and axes of the robot file."""
    names = [f.name for f in recorded.model.joints]
    yield from _couplings(names, np.array([not f.prismatic for f in recorded.model.joints]))
    yield from _axes(recorded)


def _take(order: NDArray[np.int_]) -> Callable[[Recorded], Recorded]:
    return lambda r: r.with_q(r.poses.q[:, order])


def _times(factors: Array) -> Callable[[Recorded], Recorded]:
    return lambda r: r.with_q(r.poses.q * factors)


def _units(rotary: Array) -> Iterator[Trial]:
    for factor, words in (
        (np.pi / 180, "degrees stand where radians are expected"),
        (180 / np.pi, "radians stand where degrees are expected"),
    ):
        text = f"the joint angles have a wrong unit ({words})"
        remedy = "write degrees into the columns _deg"
        yield Trial("wrong_unit", "all joints", text, remedy, _times(np.where(rotary, factor, 1.0)))


def _senses(names: Sequence[str], fast: bool) -> Iterator[Trial]:
    """All sets of joints that are counted the other way."""
    n = len(names)
    largest = 1 if not fast else n if n <= MOST_SENSES else 3
    for size in range(1, largest + 1):
        for chosen in combinations(range(n), size):
            signs = np.ones(n)
            signs[list(chosen)] = -1.0
            numbers, called = listed([str(k + 1) for k in chosen]), listed([names[k] for k in chosen])
            words = f"joint {numbers} ({called}) is" if size == 1 else f"joints {numbers} ({called}) are"
            remedy = f"change 'sign' of {'this joint' if size == 1 else 'these joints'} in the robot file"
            yield Trial("wrong_sign", called, f"{words} counted with the wrong sign", remedy, _times(signs))


def _couplings(names: Sequence[str], rotary: Array) -> Iterator[Trial]:
    """Axes that controllers count from another link (Fanuc's J3 from the horizontal, ABB's parallel rods)."""
    for (k, j), sign, by in product(permutations(range(len(names)), 2), (1.0, -1.0), (1.0, -1.0)):
        if not (rotary[k] and rotary[j]):
            continue
        matrix = np.eye(len(names))
        matrix[k, k], matrix[k, j] = sign, by
        column = f"q{k + 1}"
        formula = f"{'' if sign > 0 else '-'}{column} {'+' if by > 0 else '-'} q{j + 1}"
        words = f"joint {k + 1} ({names[k]}) is counted together with joint {j + 1}: its angle is {formula}"
        remedy = f"write {formula} into the column of joint {k + 1}"
        yield Trial("coupled_joints", f"{names[k]} and {names[j]}", words, remedy, _mix(matrix))


def _mix(matrix: Array) -> Callable[[Recorded], Recorded]:
    return lambda r: r.with_q(r.poses.q @ matrix.T)


def _axes(recorded: Recorded) -> Iterator[Trial]:
    """A joint about another axis than the robot file says."""
    joint = 0
    if recorded.model.is_hexapod:
        return
    for at, frame in enumerate(recorded.model.frames):
        if not frame.is_joint:
            continue
        joint += 1
        for axis, sign in product("xyz", (1, -1)):
            if axis == frame.axis:
                continue
            words = f"joint {joint} ({frame.name}) moves {'along' if frame.prismatic else 'about'} {axis}"
            words += f"{' in the negative sense' if sign != frame.sign else ''}, not {frame.axis} as in the robot file"
            remedy = f"write 'axis: {axis}', 'sign: {sign}' for {frame.name} in the robot file"
            yield Trial("axis", frame.name, words, remedy, _turned(at, axis, sign))


def _turned(at: int, axis: str, sign: int) -> Callable[[Recorded], Recorded]:
    def correct(r: Recorded) -> Recorded:
        frames = list(r.model.frames)
        frames[at] = replace(frames[at], axis=axis, sign=sign)
        return r.with_frames(frames)

    return correct
