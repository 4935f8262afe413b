"""Causes in what was measured: station, body, wire and sensor in the hand. They displace observations, not the robot.

The displacement of an observation is what the recording shows minus what it would show without the cause, per unit
of each parameter, in the coordinates of the observation: metres in the world for points and sensor points, the right
twist of the frame (translation first) for frames, metres along the wire for distances.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from robcal.cause import Kind
from robcal.photogrammetry.station.contradictions import CAMERA_MOVED, TARGET_SHIFTED, TARGET_SWAPPED
from robcal.physics.cause import DEG, Array, Constants, Entry, ObservationCause, ObservationData, report_move
from robcal.physics.refraction import refraction_causes
from robcal.physics.site import breaks

SCALE_ERROR = Kind(
    "scale_error", "camera", "scale error", "The station measures lengths {ppm:.0f} ppm too long", of_station=True
)
SENSOR_SCALE = Kind("sensor_scale", "sensor", "sensor scale", "The sensor measures {ppm:.0f} ppm too long")
SENSOR_ROTATION = Kind("sensor_rotation", "sensor", "sensor rotation", "The sensor's axes are turned by {deg} deg")
SCALE_DRIFT = Kind("scale_drift", "camera", "drift of the scale", of_station=True)
WIRE_SAG = Kind("wire_sag", "wire", "sag of the wire", "The wire sags as one of {g_per_m:.1f} g/m does")
WIRE_STRETCH = Kind(
    "wire_stretch", "wire", "stretch of the wire", "The wire stretches by {ppm_per_m:.0f} ppm per metre drawn"
)
WIRE_SCALE = Kind("wire_scale", "wire", "scale of the wire", "The wire encoder counts {ppm:.0f} ppm too much")
WIRE_OFFSET = Kind("wire_offset", "wire", "zero of the wire", "The wire's zero is off by {mm:.2f} mm")
PULLEY_WRAP = Kind(
    "pulley_wrap",
    "wire",
    "wire around its pulley",
    "The wire wraps around a pulley of {radius_mm:.1f} mm radius that the model leaves out",
)
BODY_THERMAL_GROWTH = Kind(
    "body_thermal_growth",
    "body",
    "body thermal growth",
    "The measuring body {where} grows by {um_per_m_K:.1f} um per metre and kelvin",
)
SPHERE_GROWTH = Kind(
    "sphere_growth",
    "sensor",
    "sphere growth",
    "The calibration sphere grows by {um_per_m_K:.1f} um per metre and kelvin",
)

Course = Callable[[ObservationData], Array]


def measuring_causes(data: ObservationData, ids: tuple[int, ...], body: str) -> Iterator[ObservationCause]:
    """Causes for the kind of observation at hand; `ids` are the targets of the body, `body` its name."""
    if data.kind in ("points", "frames"):
        yield from _station(data)
    if data.kind == "points":
        yield from _body(data, ids, body)
    if data.kind == "distances":
        yield from _wire(data)
    if data.kind == "sensor":
        yield from _sensor(data, body)


def _temperatures(data: ObservationData) -> Iterator[tuple[str, Callable[[ObservationData], Array]]]:
    """Recorded temperatures that vary, as their change since the first pose, per observation (m, 1, 1)."""
    first = int(np.argmin(data.variables["index"]))
    for name, values in data.variables.items():
        if name.startswith("temp_") and np.ptp(values) > 0.2:
            reference = float(values[first])

            def change(d: ObservationData, name: str = name, reference: float = reference) -> Array:
                return (d.variables[name] - reference)[d.pose][:, None, None]

            yield name, change


def _clock(data: ObservationData) -> tuple[float, Callable[[ObservationData, float], Array]] | None:
    """Duration in hours and the course of a warming up, duration * (1 - exp(-t/tau)) / (1 - exp(-duration/tau))."""
    seconds = data.variables.get("time_s")
    if seconds is None or np.ptp(seconds) <= 0:
        return None
    start, duration = float(np.min(seconds)), float(np.ptp(seconds)) / 3600.0

    def course(d: ObservationData, tau: float) -> Array:
        hours = (d.variables["time_s"][d.pose] - start) / 3600.0
        return (duration * np.expm1(-hours / tau) / np.expm1(-duration / tau))[:, None, None]

    return duration, course


def _world(data: ObservationData, shift: Array, turn: Array | None = None) -> Array:
    """Displacements of the observations for displacements (m, 3, k) in the world and turns (m, 3, k) of frames."""
    if data.kind == "points":
        return shift
    R = np.swapaxes(data.world_T_tool[:, :3, :3], 1, 2)
    turned = np.zeros_like(shift) if turn is None else R @ turn
    return np.concatenate([R @ shift, turned], axis=1)


def _positions(data: ObservationData) -> Array:
    return data.p_world if data.kind == "points" else data.world_T_tool[:, :3, 3]


def _station(data: ObservationData) -> Iterator[ObservationCause]:
    yield from _scale(data)
    if data.kind == "points":
        yield from refraction_causes(data)
    yield _moved(data)


def _scale(data: ObservationData) -> Iterator[ObservationCause]:
    """The scale of the station, constant, with temperatures, and with time."""
    scale = ObservationCause(
        SCALE_ERROR,
        "station",
        None,
        ("scale",),
        (1e-4,),
        lambda v, c: {"ppm": float(v[0]) * 1e6},
        observation_shift=lambda d, c: _world(d, _positions(d)[:, :, None]),
    )
    if data.kind == "points" and len(np.unique(data.target)) >= 2:
        yield scale  # with frames alone the lengths of the robot absorb it
    for name, change in _temperatures(data):

        def drift(d: ObservationData, c: Constants, change: Course = change) -> Array:
            return _world(d, _positions(d)[:, :, None] * change(d))

        yield replace(
            scale,
            kind=SCALE_DRIFT,
            priors=(2e-5,),
            report=lambda v, c: {"ppm_per_K": float(v[0]) * 1e6},
            sentence="The scale of the station drifts by {ppm_per_K:.1f} ppm per kelvin",
            observation_shift=drift,
            covariates=(name,),
            weight=0.5,
        )
    clock = _clock(data)
    if clock is not None:
        duration, course = clock
        yield replace(
            scale,
            kind=SCALE_DRIFT,
            priors=(1e-4 / duration,),
            covariates=("time_s",),
            weight=0.5,
            report=lambda v, c: {"ppm_per_h": float(v[0]) * 1e6, "tau_h": c["tau_h"]},
            sentence="The scale of the station drifts by {ppm_per_h:.1f} ppm per hour",
            grid=tuple({"tau_h": share * duration} for share in (0.1, 0.25, 0.6, 3.0)),
            continuous={"tau_h": (0.02 * duration, 10.0 * duration)},
            observation_shift=lambda d, c: _world(d, _positions(d)[:, :, None] * course(d, c["tau_h"])),
        )


def _moved(data: ObservationData) -> ObservationCause:
    """The station (or a camera of it) was moved before some pose."""
    first, every = breaks(data.variables["index"], 3)

    def moved(d: ObservationData, c: Constants) -> Array:
        # the station moved by (shift, turn) about its origin, so everything it measures moves the other way
        after = -(d.variables["index"][d.pose] > c["pose"] - 0.5).astype(float)[:, None, None]
        arm = _positions(d)
        turn = np.broadcast_to(np.eye(3), (len(arm), 3, 3))
        shift = np.concatenate([turn, _cross_columns(arm)], axis=2)
        return _world(d, shift * after, np.concatenate([np.zeros_like(turn), turn], axis=2) * after)

    return ObservationCause(
        CAMERA_MOVED,
        "station",
        None,
        ("x", "y", "z", "rx", "ry", "rz"),
        (1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4),
        report_move,
        "The station moved before pose {pose}",
        grid=tuple({"pose": i} for i in first),
        ordered={"pose": every},
        observation_shift=moved,
        covariates=("index",),
    )


def _cross_columns(arm: Array) -> Array:
    """(m, 3, 3): column k is e_k x arm, the displacement by a unit turn about axis k."""
    return np.cross(np.eye(3)[None, :, :], arm[:, None, :]).swapaxes(1, 2)


def _body(data: ObservationData, ids: tuple[int, ...], body: str) -> Iterator[ObservationCause]:
    present = [i for i in ids if np.any(data.target == i)]
    if len(present) < 2:
        return
    for target in present:

        def shifted(d: ObservationData, c: Constants, t: int = target) -> Array:
            return d.world_T_tool[:, :3, :3] * (d.target == t)[:, None, None]

        yield ObservationCause(
            TARGET_SHIFTED,
            str(target),
            None,
            ("x", "y", "z"),
            (5e-4, 5e-4, 5e-4),
            lambda v, c: {"shift_mm": [float(x) * 1e3 for x in v]},
            observation_shift=shifted,
            weight=1.0 / len(present),
        )
    pairs = [(i, j) for k, i in enumerate(present) for j in present[k + 1 :]]
    yield from (replace(swapped(data, i, j), weight=1.0 / len(pairs)) for i, j in pairs)
    for name, change in _temperatures(data):

        def grown(d: ObservationData, c: Constants, change: Course = change) -> Array:
            return np.einsum("mij,mj->mi", d.world_T_tool[:, :3, :3], d.p_tool)[:, :, None] * change(d)

        yield ObservationCause(
            BODY_THERMAL_GROWTH,
            body,
            None,
            ("growth",),
            (1.5e-5,),
            lambda v, c: {"um_per_m_K": float(v[0]) * 1e6},
            observation_shift=grown,
            covariates=(name,),
        )


def swapped(data: ObservationData, i: int, j: int) -> ObservationCause:
    """Targets i and j carry each other's number: one column with the amplitude one."""
    there = {t: data.p_tool[np.flatnonzero(data.target == t)[0]] for t in (i, j)}

    def displace(d: ObservationData, c: Constants) -> Array:
        step = np.where((d.target == i)[:, None], there[j] - there[i], 0.0)
        step = step + np.where((d.target == j)[:, None], there[i] - there[j], 0.0)
        return np.einsum("mij,mj->mi", d.world_T_tool[:, :3, :3], step)[:, :, None]

    return ObservationCause(
        TARGET_SWAPPED, str(i), None, ("share",), (1.0,), lambda v, c: {"with": j}, observation_shift=displace
    )


def _wire(data: ObservationData) -> Iterator[ObservationCause]:
    stated = data.wire

    def cause(kind: Kind, prior: float, parameter: str, report: str, factor: float) -> ObservationCause:
        def law(d: ObservationData, c: Constants) -> Array:
            return d.wire.by_parameter(d.p_world, (parameter,))[:, None, :]

        return ObservationCause(
            kind,
            "wire",
            None,
            (parameter,),
            (prior,),
            lambda v, c: {report: (float(v[0]) + getattr(stated, parameter)) * factor},
            observation_shift=law,
        )

    yield replace(
        # 4.5 g/m: a steel wire of 0.9 mm; what matters is the ratio to the tension, which varies as much
        cause(WIRE_SAG, 2e-5, "sag", "g_per_m", 1.0),
        report=lambda v, c: {"g_per_m": float(np.sqrt(max(v[0] + stated.sag, 0.0))) * 1e3},
        positive=0.99,
        limits=(-stated.sag, np.inf),
    )
    yield cause(WIRE_STRETCH, 1e-4, "stretch", "ppm_per_m", 1e6)
    yield cause(WIRE_SCALE, 3e-4, "scale", "ppm", 1e6)
    yield cause(WIRE_OFFSET, 1e-3, "offset", "mm", 1e3)
    # over the top of the pulley: the higher the wire leaves, the less of it is wrapped
    wrap = cause(PULLEY_WRAP, 5e-3, "radius", "radius_mm", 1e3)
    yield replace(wrap, positive=0.5 if stated.radius else 0.99, limits=(-stated.radius, 0.5))


def _sensor(data: ObservationData, body: str) -> Iterator[ObservationCause]:
    if data.p_sensor is None:
        return
    yield ObservationCause(
        SENSOR_SCALE,
        "sensor",
        None,
        ("scale",),
        (1e-3,),
        lambda v, c: {"ppm": float(v[0]) * 1e6},
        observation_shift=lambda d, c: (
            -np.einsum("mij,mj->mi", d.world_T_tool[:, :3, :3], _required(d.p_sensor))[:, :, None]
        ),
    )
    yield ObservationCause(
        SENSOR_ROTATION,
        "sensor",
        None,
        ("rx", "ry", "rz"),
        (2e-3, 2e-3, 2e-3),
        lambda v, c: {"deg": [float(x) * DEG for x in v]},
        observation_shift=lambda d, c: d.world_T_tool[:, :3, :3] @ _cross_columns(_required(d.p_sensor)),
    )
    for name, change in _temperatures(data):

        def grown(d: ObservationData, c: Constants, change: Course = change) -> Array:
            return -d.p_world[:, :, None] * change(d)

        yield ObservationCause(
            SPHERE_GROWTH,
            body,
            None,
            ("growth",),
            (1e-5,),
            lambda v, c: {"um_per_m_K": float(v[0]) * 1e6},
            observation_shift=grown,
            covariates=(name,),
        )


def _required(p_sensor: Array | None) -> Array:
    if p_sensor is None:
        raise ValueError("sensor coordinates are missing")
    return p_sensor


ENTRIES = (Entry(on_observations=measuring_causes),)
