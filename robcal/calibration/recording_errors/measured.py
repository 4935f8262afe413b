"""Faults of the measurements: columns, units, mirror images, conventions of orientation."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from robcal import transforms as tf
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    Observations,
    PointObservations,
    SensorPointObservations,
)
from robcal.calibration.recording_errors.joints import listed
from robcal.calibration.recording_errors.recorded import Recorded, Trial, as_frames

Array = NDArray[np.float64]

WHERE = "measurements"
ANGLES = ("roll", "pitch", "yaw")
UNITS = ((1e-3, "metres"), (1000.0, "micrometres"), (10.0, "hundredths"), (0.1, "centimetres"), (1 / 25.4, "inches"))
"""Factor of the coordinates as they were read to the true ones is its inverse; name of the unit they are in."""


def measured_trials(recorded: Recorded) -> Iterator[Trial]:
    """Alternatives of the measurements."""
    kinds = {type(o) for o in recorded.observations}
    if FrameObservations in kinds:
        yield from _columns()
        yield from _conventions()
    for factor, unit in UNITS:
        words = f"the measured lengths are in {unit}, not in mm"
        yield Trial("measured_unit", WHERE, words, "write mm into the columns _mm", _scaled(1.0 / factor))


def mirror_trials(recorded: Recorded) -> Iterator[Trial]:
    """Mirror images: a robot with its axes in one plane cannot tell them from wrong senses of some joints."""
    kinds = {type(o) for o in recorded.observations}
    kind, remedy = "measured_columns", "correct the columns of the measurements"
    if FrameObservations in kinds:
        mirror = np.diag([1.0, 1.0, -1.0])
        words = "the measured frames are mirror images (left-handed axes, or images with an axis the other way)"
        yield Trial(kind, WHERE, words, remedy, _on_frames(lambda p, a: _reflected(p, a, mirror)))
    if kinds & {PointObservations, SensorPointObservations}:
        words = "the measured points are mirrored (two columns exchanged, or one with the wrong sign)"
        yield Trial(kind, WHERE, words, remedy, _on_points(lambda p: p * [1.0, 1.0, -1.0]))


def _scaled(factor: float) -> Callable[[Recorded], Recorded]:
    def scale(o: Observations) -> Observations:
        if isinstance(o, FrameObservations):
            T = o.world_T_tool.copy()
            T[:, :3, 3] *= factor
            return replace(o, world_T_tool=T)
        if isinstance(o, PointObservations):
            return replace(o, p_world=o.p_world * factor)
        return replace(o, distance=o.distance * factor) if isinstance(o, DistanceObservations) else o

    return lambda r: r.change(scale)


def _on_points(change: Callable[[Array], Array]) -> Callable[[Recorded], Recorded]:
    def correct(o: Observations) -> Observations:
        if isinstance(o, PointObservations):
            return replace(o, p_world=change(o.p_world))
        return replace(o, p_sensor=change(o.p_sensor)) if isinstance(o, SensorPointObservations) else o

    def corrected(r: Recorded) -> Recorded:
        changed = r.change(correct)
        return replace(changed, observations=as_frames(changed.observations))

    return corrected


def _on_frames(change: Callable[[Array, Array], Array]) -> Callable[[Recorded], Recorded]:
    """``change`` makes frames (m, 4, 4) from places (m, 3) and the angles as they stand in the file (m, 3)."""

    def correct(o: Observations) -> Observations:
        if not isinstance(o, FrameObservations):
            return o
        angles = o.stated_angles
        if angles is None:
            angles = tf.rpy_from_rotation(o.world_T_tool[:, :3, :3])
        return replace(o, world_T_tool=change(o.world_T_tool[:, :3, 3], angles))

    return lambda r: r.change(correct)


def _columns() -> Iterator[Trial]:
    """Exchanged columns, wrong signs and units of frames."""
    kind, remedy = "measured_columns", "correct the columns of the measurements"
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        taken, factors = np.array(order), np.array(signs)
        if order == (0, 1, 2) and min(signs) > 0:
            continue
        exchanged = ["xyz"[k] for k in range(3) if order[k] != k]
        turned = ["xyz"[order[k]] for k in range(3) if signs[k] < 0]
        parts = [f"{listed(exchanged)} are exchanged"] * bool(exchanged)
        parts += [f"{listed(turned)} {'has' if len(turned) == 1 else 'have'} the wrong sign"] * bool(turned)
        words = f"the measured {' and '.join(parts)}"
        yield Trial(kind, WHERE, words, remedy, _on_frames(_moved(taken, factors)))
    for signs in product((1.0, -1.0), repeat=3):
        if min(signs) < 0:
            turned = [ANGLES[k] for k in range(3) if signs[k] < 0]
            words = f"the measured {listed(turned)} {'has' if len(turned) == 1 else 'have'} the wrong sign"
            yield Trial(kind, WHERE, words, remedy, _on_frames(_angles(np.array(signs))))
    for factor, words in (
        (180 / np.pi, "the measured angles are in radians where degrees are expected"),
        (np.pi / 180, "the measured angles are in degrees where radians are expected"),
    ):
        remedy = "write degrees into the columns _deg of the measurements"
        yield Trial("measured_unit", WHERE, words, remedy, _on_frames(_angles(np.full(3, factor))))


def _moved(order: Array, signs: Array) -> Callable[[Array, Array], Array]:
    return lambda p, a: tf.frame(tf.rotation_from_rpy(a), p[:, order] * signs)


def _reflected(p: Array, a: Array, M: Array) -> Array:
    return tf.frame(M @ tf.rotation_from_rpy(a) @ M, p @ M)


def _angles(factors: Array) -> Callable[[Array, Array], Array]:
    return lambda p, a: tf.frame(tf.rotation_from_rpy(a * factors), p)


def _conventions() -> Iterator[Trial]:
    """Every order of three elementary turns, rotation vectors; each as it is, transposed, and of the inverse frame."""
    readings: list[tuple[str, Callable[[Array], Array]]] = [("", tf.rotation_from_rpy)]
    for columns, axes in product(permutations(range(3)), permutations(range(3))):
        if tuple(axes[columns.index(c)] for c in range(3)) == (0, 1, 2) and axes == (2, 1, 0):
            continue
        readings.append((_order_words(columns, axes), _turns(columns, axes)))
    for first, middle in permutations(range(3), 2):
        for columns in ((0, 1, 2), (2, 1, 0)):
            axes = (first, middle, first)
            readings.append((_order_words(columns, axes), _turns(columns, axes)))
    readings.append(("rotation vectors (axis times angle)", tf.exp_so3))
    for words, reading in readings:
        message = f"the measured angles are {words}" if words else ""
        convert = "give roll, pitch and yaw about the fixed axes x, y, z (R = Rz Ry Rx) of the tool in the world"
        if words:
            yield Trial("orientation", WHERE, message, convert, _on_frames(_read(reading, False)))
        transposed = "the measured rotations are transposed (of the world in the tool, not of the tool in the world)"
        text = f"{transposed}{f', and {message[4:]}' if message else ''}"
        yield Trial("orientation", WHERE, text, convert, _on_frames(_read(reading, True)))
        also = f", and {message[4:]}" if message else ""
        text = f"the measured frames are inverted (the world seen from the tool){also}"
        yield Trial("inverted_frames", WHERE, text, f"invert them: {convert}", _on_frames(_inverse(reading)))


def _order_words(columns: tuple[int, ...], axes: tuple[int, ...]) -> str:
    order = " ".join("XYZ"[k] for k in axes)
    named = ", ".join(ANGLES[c] for c in columns)
    straight = columns == (0, 1, 2)
    return f"of the order {order} about moving axes{'' if straight else f' (columns {named})'}"


def _turns(columns: tuple[int, ...], axes: tuple[int, ...]) -> Callable[[Array], Array]:
    """R = R_axes0(columns0) R_axes1(columns1) R_axes2(columns2)."""

    def reading(angles: Array) -> Array:
        R = np.broadcast_to(np.eye(3), (len(angles), 3, 3))
        for c, axis in zip(columns, axes, strict=True):
            rpy = np.zeros_like(angles)
            rpy[:, axis] = angles[:, c]
            R = R @ tf.rotation_from_rpy(rpy)
        return np.asarray(R)

    return reading


def _read(reading: Callable[[Array], Array], transposed: bool) -> Callable[[Array, Array], Array]:
    def frames(p: Array, a: Array) -> Array:
        R = reading(a)
        return tf.frame(np.swapaxes(R, 1, 2) if transposed else R, p)

    return frames


def _inverse(reading: Callable[[Array], Array]) -> Callable[[Array, Array], Array]:
    return lambda p, a: tf.invert(tf.frame(reading(a), p))
