"""Measurements given as tables: points, frames, distances, points in the sensor, marks in images.

The kind of a table is told by its columns. Everything is converted to metres and radians here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.calibration.recording_errors import empty_readings, frozen_readings
from robcal.errors import InvalidInput
from robcal.files.constraints import read_constraints
from robcal.files.frame_tables import SIX, frame_covariance_columns, twist_covariance
from robcal.files.tables import Table, read_table
from robcal.transforms import Array, frame_from_xyzrpy

IntArray = NDArray[np.int64]
Kind = Literal["points", "frames", "distances", "sensor_points", "constraints"]

MAX_METRES = 10_000.0
MOST_OUTSIDE = 0.2
"""Share of the marks that may lie outside their image."""


@dataclass(frozen=True)
class SharedErrors:
    """What points of a system with a calibration of its own have in common.

    Attributes
    ----------
    noise : (m, 3, 3) m^2, independent from point to point.
    jacobian : (m, 3, k) by the system's numbers; covariance : (k, k) of these.
    """

    noise: Array
    jacobian: Array
    covariance: Array

    @classmethod
    def none(cls, covariance: Array) -> "SharedErrors":
        """Of points (m, 3, 3) that have nothing in common."""
        return cls(covariance, np.zeros((len(covariance), 3, 0)), np.zeros((0, 0)))

    def select(self, rows: ArrayLike) -> "SharedErrors":
        """The given points (indices or mask)."""
        chosen = np.asarray(rows)
        return replace(self, noise=self.noise[chosen], jacobian=self.jacobian[chosen])

    @property
    def total(self) -> Array:
        """(m, 3, 3) covariance of each point alone."""
        return np.asarray(self.noise + self.jacobian @ self.covariance @ np.swapaxes(self.jacobian, -1, -2))


@dataclass(frozen=True)
class MeasuredTable:
    """Measurements of one table.

    Attributes
    ----------
    pose : (m,) index into the campaign's poses; rows : row in the file.
    target : (m,) ids, -1 where the kind has none.
    values : (m, 3) points in m, (m, 4, 4) frames, or (m,) distances in m.
    covariance : (m, 3, 3), (m, 6, 6) (right perturbation of the frame) or (m,) variances; None if not stated.
    covariates : further numeric columns that belong to the single measurement (``cycle``, ``time_s``).
    angles : (m, 3) of frames as they stand in the file, rad.
    loops : kinds of closed loops by name; ``loop`` : (m,) which of them, in that order.
    shared : what the points have in common, where the system states it; it is part of ``covariance``.
    sources : further files that the table was made from.
    q : (m, N) joint angles that the rows state themselves, rad or m; None where they state none.
    """

    kind: Kind
    path: Path
    pose: IntArray
    rows: IntArray
    target: IntArray
    values: Array
    covariance: Array | None
    covariates: Mapping[str, Array]
    notes: tuple[str, ...] = ()
    angles: Array | None = None
    loops: Mapping[str, str] = field(default_factory=dict)
    loop: IntArray | None = None
    shared: SharedErrors | None = None
    sources: tuple[Path, ...] = ()
    q: Array | None = None

    def __len__(self) -> int:
        return len(self.pose)

    def without(self, rows: NDArray[np.bool_], note: str) -> "MeasuredTable":
        """The table without some rows, and why."""
        if not rows.any():
            return self
        kept = ~rows
        return replace(
            self,
            pose=self.pose[kept],
            rows=self.rows[kept],
            target=self.target[kept],
            values=self.values[kept],
            covariance=None if self.covariance is None else self.covariance[kept],
            covariates={name: values[kept] for name, values in self.covariates.items()},
            notes=(*self.notes, note),
            angles=None if self.angles is None else self.angles[kept],
            loop=None if self.loop is None else self.loop[kept],
            shared=None if self.shared is None else self.shared.select(kept),
            q=None if self.q is None else self.q[kept],
        )


@dataclass(frozen=True)
class MarksTable:
    """Marks measured by another program: image names, target ids, pixels and their standard deviation."""

    path: Path
    image: tuple[str, ...]
    target: IntArray
    xy: Array
    sigma: Array
    stated: bool

    def __len__(self) -> int:
        return len(self.image)


def read_measurements(path: Path, pose_names: Sequence[str], kind: Kind | None = None) -> MeasuredTable:
    """Read a table of measurements; ``kind`` overrules what the columns tell.

    Raises
    ------
    InvalidInput : not one of the kinds, unknown pose, doubled measurement, impossible numbers.
    """
    return measurements_of(read_table(path), pose_names, kind)


def measurements_of(
    table: Table, pose_names: Sequence[str], kind: Kind | None = None, q: Array | None = None
) -> MeasuredTable:
    """The measurements of a table, as :func:`read_measurements` does it; ``q`` : angles that its rows state."""
    path = table.path
    kind = kind or _kind(table)
    if kind == "constraints":
        return replace(_constraints(table, pose_names), q=q)
    needed = {
        "points": ["pose", "target", "x_mm", "y_mm", "z_mm"],
        "sensor_points": ["pose", "target", "x_mm", "y_mm", "z_mm"],
        "frames": ["pose", "x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg"],
        "distances": ["pose", "distance_mm"],
    }[kind]
    table.require(needed)
    if not len(table):
        raise InvalidInput(f"{path}: lists no measurements")
    pose = pose_index(table, pose_names)
    target = target_ids(table) if "target" in needed else np.full(len(table), -1, dtype=np.int64)
    keys = ["pose", *(["target"] if "target" in needed else []), *(["cycle"] if table.has("cycle") else [])]
    table.unique(keys)
    if kind == "distances":
        values = table.numbers("distance_mm", positive=True) / 1000
        covariance = (table.numbers("sigma_mm", positive=True) / 1000) ** 2 if table.has("sigma_mm") else None
    elif kind == "frames":
        offsets = [table.numbers(f"{n}_mm") / 1000 for n in SIX[:3]]
        six = np.column_stack([*offsets, *(np.radians(table.numbers(f"{n}_deg")) for n in SIX[3:])])
        values = frame_from_xyzrpy(six)
        covariance = _frame_covariance(table, six)
    else:
        values = np.column_stack([table.numbers(f"{n}_mm") for n in SIX[:3]]) / 1000
        covariance = point_covariance(table)
    _check_size(table, values)
    covariates = {name: table.numbers(name) for name in ("cycle", "time_s") if table.has(name)}
    angles = six[:, 3:] if kind == "frames" else None
    measured = MeasuredTable(kind, path, pose, table.rows, target, values, covariance, covariates, angles=angles, q=q)
    return _without_empty(measured, pose_names)


def _constraints(table: Table, pose_names: Sequence[str]) -> MeasuredTable:
    if not len(table):
        raise InvalidInput(f"{table.path}: lists no constraints")
    number, kinds, values, variance = read_constraints(table)
    pose = pose_index(table, pose_names)
    none = np.full(len(table), -1, dtype=np.int64)
    return MeasuredTable(
        "constraints", table.path, pose, table.rows, none, values, variance, {}, loops=kinds, loop=number
    )


def _without_empty(table: MeasuredTable, pose_names: Sequence[str]) -> MeasuredTable:
    """Without rows of zeros or sentinels, which programs write where they measured nothing.

    Raises
    ------
    InvalidInput : no row holds a reading.
    """
    if table.kind == "distances":
        return table
    numbers = 1e3 * (table.values[:, :3, 3] if table.kind == "frames" else table.values)
    empty = empty_readings(np.round(numbers, 6))
    if empty.all():
        raise InvalidInput(f"{table.path}: no row holds a reading: all coordinates are zero or a sentinel")
    told = few(list(dict.fromkeys(pose_names[i] for i in table.pose[empty])))
    return table.without(
        empty, f"{table.path.name}: {int(empty.sum())} rows hold no reading (zeros or a sentinel), set aside: {told}"
    )


def without_frozen(table: MeasuredTable, places: Array, pose_names: Sequence[str]) -> MeasuredTable:
    """Without readings that stand still while the nominal flange moves on; ``places`` (n, 3) at the poses, m."""
    frozen = np.zeros(len(table), dtype=bool)
    if table.kind in ("sensor_points", "constraints"):
        return table
    values = table.values[:, :3].reshape(len(table), -1) if table.kind == "frames" else table.values
    for target in np.unique(table.target):
        rows = np.flatnonzero(table.target == target)
        frozen[rows] = frozen_readings(table.pose[rows], values[rows].reshape(len(rows), -1), places)
    if frozen.all():
        return table
    told = few(list(dict.fromkeys(pose_names[i] for i in table.pose[frozen])))
    return table.without(
        frozen,
        f"{table.path.name}: {int(frozen.sum())} readings repeat the one before though the robot had moved: set aside "
        f"({told})",
    )


def _kind(table: Table) -> Kind:
    if table.has("u_px"):
        raise InvalidInput(
            f"{table.path}: readings of linear cameras need their system: write {{file: {table.path.name}, "
            "line_cameras: system.yaml} (made by 'pipeline lines calibrate') in place of the file's name"
        )
    if table.has("constraint"):
        return "constraints"
    if table.has("distance_mm"):
        return "distances"
    if table.has("roll_deg") or table.has("pitch_deg") or table.has("yaw_deg"):
        return "frames"
    if table.has("target"):
        in_sensor = table.has("cycle") or table.has("time_s") or "sensor" in table.path.stem.lower()
        return "sensor_points" if in_sensor else "points"
    table.require(["pose"])
    raise InvalidInput(
        f"{table.path}, row 1: the columns are of no known kind: points need pose, target, x_mm, y_mm, z_mm; frames "
        "pose, x_mm, y_mm, z_mm, roll_deg, pitch_deg, yaw_deg; distances pose, distance_mm; closed loops pose, "
        "constraint, kind, value_mm, sigma_mm"
    )


def pose_index(table: Table, pose_names: Sequence[str]) -> IntArray:
    """Rows (m,) of the poses in the table of poses."""
    place = {name: i for i, name in enumerate(pose_names)}
    cells = table.texts("pose")
    unknown = [cell not in place for cell in cells]
    table.refuse(
        unknown,
        lambda i: (
            f"pose '{cells[i]}' is not in the table of poses ({sum(unknown)} such rows): add it there or remove the row"
        ),
    )
    return np.array([place[cell] for cell in cells], dtype=np.int64)


def unmeasured(tables: Sequence[MeasuredTable], pose_names: Sequence[str]) -> list[str]:
    """A note where some poses have no measurement in any of the tables."""
    if not tables:
        return []
    measured = np.unique(np.concatenate([table.pose for table in tables]))
    missing = np.delete(np.asarray(pose_names, dtype=object), measured)
    names = " and ".join(dict.fromkeys(table.path.name for table in tables))
    return [f"{len(missing)} poses have no measurement in {names} ({few(missing.tolist())})"] if len(missing) else []


def few(names: Sequence[str]) -> str:
    """The first names for a message."""
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


def target_ids(table: Table) -> IntArray:
    """Ids (m,) of a table's targets."""
    cells = table.columns["target"]
    table.refuse(
        [not cell.lstrip("-").isdigit() for cell in cells],
        lambda i: f"target '{cells[i][:40]}' is not a whole number: targets are named by their integer ids",
    )
    return table.whole_numbers("target")


def point_covariance(table: Table) -> Array | None:
    """Covariance (m, 3, 3) in m2 that a table of points states, None where it states none."""
    full = ("sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2")
    some = [name for name in full if table.has(name)]
    if some and len(some) < len(full):
        table.require(full)
    if some:
        six = np.column_stack([table.numbers(name) for name in full]) * 1e-6
        covariance = six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        return _positive_definite(table, covariance)
    if table.has("sigma_mm"):
        sigma = table.numbers("sigma_mm", positive=True) / 1000
        return sigma[:, None, None] ** 2 * np.eye(3)
    names = ("sx_mm", "sy_mm", "sz_mm")
    if table.has(*names):
        sigmas = np.column_stack([table.numbers(name, positive=True) for name in names]) / 1000
        return sigmas[:, :, None] ** 2 * np.eye(3)
    return None


def _positive_definite(table: Table, covariance: Array) -> Array:
    remedy = "its variances must outweigh its covariances, check the columns"
    bad = np.linalg.eigvalsh(covariance)[:, 0] <= 0
    table.refuse(bad, lambda _: f"the covariance is not positive definite: {remedy}")
    return covariance


def _frame_covariance(table: Table, six: Array) -> Array | None:
    scale = np.array([1e-3] * 3 + [np.pi / 180] * 3)
    numbers = np.zeros((len(six), 6, 6))
    columns = frame_covariance_columns()
    if any(table.has(name) for name, _, _ in columns):
        table.require([name for name, _, _ in columns])
        for name, i, j in columns:
            numbers[:, i, j] = numbers[:, j, i] = table.numbers(name)
    elif table.has(*(f"s{n}_mm" for n in SIX[:3]), *(f"s{n}_deg" for n in SIX[3:])):
        for k, n in enumerate(SIX):
            numbers[:, k, k] = table.numbers(f"s{n}_{'mm' if k < 3 else 'deg'}", positive=True) ** 2
    elif table.has("sigma_mm", "sigma_deg"):
        # an isotropic covariance of position and of rotation needs no transport
        sigma = table.numbers("sigma_mm", positive=True) / 1000
        turn = np.radians(table.numbers("sigma_deg", positive=True))
        diagonal = np.concatenate([np.tile(sigma[:, None], 3), np.tile(turn[:, None], 3)], axis=1) ** 2
        return diagonal[:, :, None] * np.eye(6)
    elif table.has("sigma_mm") or table.has("sigma_deg"):
        table.require(["sigma_mm", "sigma_deg"])
    else:
        return None
    return _positive_definite(table, twist_covariance(six, numbers * np.outer(scale, scale)))


def _check_size(table: Table, values: Array) -> None:
    lengths = np.abs(values[:, :3, 3] if values.ndim == 3 else values.reshape(len(values), -1)).max(axis=1)
    table.refuse(
        lengths > MAX_METRES, lambda i: f"a length of {lengths[i]:.3g} m: coordinates are in mm, check the unit"
    )


def read_marks(path: Path, default_sigma: float = 0.1) -> MarksTable:
    """Read observations.csv: ``image, target, x_px, y_px`` and optional ``sigma_px`` (default 0.1 px).

    Raises
    ------
    InvalidInput : missing columns, NaN, a target twice in one image.
    """
    return marks_of(read_table(path), default_sigma)


def marks_of(table: Table, default_sigma: float = 0.1) -> MarksTable:
    """The marks of a table, as :func:`read_marks` does it."""
    path = table.path
    table.require(["image", "target", "x_px", "y_px"])
    if not len(table):
        raise InvalidInput(f"{path}: lists no marks")
    image = table.texts("image")
    target = target_ids(table)
    table.unique(["image", "target"])
    xy = np.column_stack([table.numbers("x_px"), table.numbers("y_px")])
    far = np.abs(xy).max(axis=1) > 1e6
    table.refuse(far, lambda _: "a mark a million pixels off the image: coordinates are in pixels")
    stated = table.has("sigma_px")
    sigma = table.numbers("sigma_px", positive=True) if stated else np.full(len(table), default_sigma)
    return MarksTable(path, image, target, xy, sigma, stated)


def check_marks(marks: MarksTable, size: tuple[int, int] | None) -> None:
    """Refuse marks that do not lie in the image.

    Raises
    ------
    InvalidInput : many are beyond its edges; the message says what they look like.
    """
    outside = (marks.xy < -1.0).any(axis=1)
    if size is not None:
        outside |= (marks.xy > np.array(size, dtype=float)).any(axis=1)
    if np.mean(outside) < MOST_OUTSIDE:
        return
    low, high = marks.xy.min(axis=0), marks.xy.max(axis=0)
    spans = f"x_px from {low[0]:.0f} to {high[0]:.0f}, y_px from {low[1]:.0f} to {high[1]:.0f}"
    negative = low < -0.1 * (high - low)
    looks = "they seem to be counted from the centre of the image" if negative.all() else "check columns and image size"
    if negative[1] and not negative[0]:
        looks = "y seems to be counted upwards"
    raise InvalidInput(
        f"{marks.path}: {100 * np.mean(outside):.0f} % of the marks lie outside the image ({spans}): {looks}; count "
        "x_px to the right and y_px downwards from the centre of the top left pixel"
    )
