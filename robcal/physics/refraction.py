"""Bent lines of sight: what a temperature gradient, a window or water in front of an instrument does to points."""

from collections.abc import Callable, Iterator

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import Array, Constants, ObservationCause, ObservationData

REFRACTION = Kind(
    "refraction",
    "camera",
    "refraction",
    "The lines of sight of the station bend along {direction} (refraction), {curvature_per_km:.4f} per km",
    displaces_marks=True,
)

STEP = 1e-3
"""Metres over which the field is differentiated: it is a polynomial of the second degree, so any will do."""
LARGEST = 3e-4
"""1/m: lines of sight do not bend more. Air does by 1e-6 per kelvin and metre of its gradient (Ciddor, 1996); the rest
is left to windows."""


def refraction_causes(data: ObservationData) -> Iterator[ObservationCause]:
    """A bend towards each axis, from a place that is not known or from the origin, and a smooth warp of space."""
    yield from (_bent_sight(data, axis) for axis in range(3))
    yield from (_bent_from_origin(axis) for axis in range(3))
    yield _warped(data)


def _warping(field: Callable[[Array], Array]) -> Callable[[ObservationData, Constants], Array]:
    """Displacements of observations for a field of displacements, points (m, 3) to (m, 3, k).

    A frame moves as its origin does and turns by half the curl of the field there, as a small body does.
    """

    def displace(d: ObservationData, c: Constants) -> Array:
        shift = field(d.p_world)
        if d.kind != "frames":
            return shift
        ahead, behind = ([field(d.p_world + side * STEP * e) for e in np.eye(3)] for side in (1.0, -1.0))
        slope = (np.stack(ahead) - np.stack(behind)) / (2.0 * STEP)  # (derivative by, m, component, k)
        turn = 0.5 * np.stack([slope[i, :, j] - slope[j, :, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
        R = np.swapaxes(d.world_T_tool[:, :3, :3], 1, 2)
        return np.concatenate([R @ shift, R @ turn], axis=1)

    return displace


def _bend(arm: Array, axis: int) -> Array:
    """Displacement (m, 3) by unit curvature, seen from where the arms (m, 3) begin: half the squared distance, across
    the line of sight, towards the axis."""
    out = -arm * arm[:, axis, None]
    out[:, axis] += np.sum(arm**2, axis=1)
    return np.asarray(0.5 * out)


def _bent_sight(data: ObservationData, axis: int) -> ObservationCause:
    """Light bends evenly across the line of sight: points move by curvature * distance^2 / 2 towards one axis.

    The distance is from where the instrument stands, which is not known: with `w` its place from the centre `c`, the
    bend is that seen from `c` plus terms linear in `p - c` and in `w`.
    """
    centre = data.p_world.mean(axis=0)

    def bent(points: Array) -> Array:
        arm = points - centre
        out = np.zeros((len(arm), 3, 4))
        out[:, :, 0] = _bend(arm, axis)
        for k in range(3):
            out[:, axis, k + 1] -= 2.0 * arm[:, k]
            out[:, k, k + 1] += arm[:, axis]
        out[:, :, axis + 1] += arm
        return out

    names = ("curvature", "x", "y", "z")
    letter = "xyz"[axis]

    def report(v: Array, c: Constants) -> dict[str, object]:
        middle = ", ".join(f"{m:.3f}" for m in centre)
        law = (
            f"{v[0]:.4g} (|a|^2 {letter} - a (a.{letter})) / 2 + a (w.{letter}) + w (a.{letter}) - 2 (a.w) {letter}; "
            f"a = p - ({middle}) m, w = ({v[1]:.4g}, {v[2]:.4g}, {v[3]:.4g})"
        )
        return {
            "curvature_per_km": 1e3 * float(v[0]),
            "term": {"variables": ["x_m", "y_m", "z_m"], "kind": "formula", "formula": law},
        }

    return ObservationCause(
        REFRACTION,
        "station",
        letter,
        names,
        (2e-5, 1e-4, 1e-4, 1e-4),
        report,
        observation_shift=_warping(bent),
        weight=0.125,
        limits=(-1e-3, 1e-3),
        known_within=1e-4,
    )


def _bent_from_origin(axis: int) -> ObservationCause:
    """The same for an instrument that stands where its coordinates begin, as trackers do: one number."""

    def bent(points: Array) -> Array:
        return _bend(points, axis)[:, :, None]

    letter = "xyz"[axis]

    def report(v: Array, c: Constants) -> dict[str, object]:
        term = {
            "variables": ["x_m", "y_m", "z_m"],
            "kind": "formula",
            "formula": f"d = {v[0]:.4g} (|p|^2 {letter} - p (p.{letter})) / 2",
        }
        return {"curvature_per_km": 1e3 * float(v[0]), "term": term}

    return ObservationCause(
        REFRACTION,
        "station",
        letter,
        ("curvature",),
        (2e-5,),
        report,
        observation_shift=_warping(bent),
        weight=0.125,
        limits=(-LARGEST, LARGEST),
    )


def _warped(data: ObservationData) -> ObservationCause:
    """A line of sight that bends (a temperature gradient, a window) warps space smoothly: a quadratic field.

    Rigid motion and scale are left to their own causes; the field is centred on the measured volume and given per
    metre squared. Which physics bends the rays cannot be told from points alone.
    """
    centre = data.p_world.mean(axis=0)

    def bent(points: Array) -> Array:
        x, y, z = (points - centre).T
        squares = np.stack([x * x, y * y, z * z, x * y, x * z, y * z], axis=1)
        return np.einsum("mq,ij->miqj", squares, np.eye(3)).reshape(len(x), 3, -1)

    names = tuple(f"{s}_{a}" for s in ("xx", "yy", "zz", "xy", "xz", "yz") for a in "xyz")

    def report(v: Array, c: Constants) -> dict[str, object]:
        terms = [f"{1e3 * value:.4g} mm * {name[:2]} along {name[3]}" for name, value in zip(names, v, strict=True)]
        middle = ", ".join(f"{m:.3f}" for m in centre)
        return {
            "term": {
                "variables": ["x_m", "y_m", "z_m"],
                "kind": "formula",
                "formula": f"about ({middle}) m: " + " + ".join(terms),
            }
        }

    return ObservationCause(
        REFRACTION,
        "station",
        None,
        names,
        (1e-4,) * len(names),
        report,
        "The lines of sight of the station are bent (refraction): the measured space is warped",
        observation_shift=_warping(bent),
        weight=0.25,
        limits=(-LARGEST, LARGEST),
    )
