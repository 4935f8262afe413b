"""A drift control between two calls: what is read from its database and what is written back."""

import io
import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from pipeline import codec
from pipeline.drift.database import ALARMS, FILES, IN_FORCE, META, MODELS, READINGS, TOURS
from pipeline.drift.readings_table import made
from robcal.calibration.calibrated import CalibratedRobot
from robcal.drift.control import ControlState, Events, Model
from robcal.drift.reference import DriftReference, DriftSettings, Readings
from robcal.errors import InvalidInput
from robcal.files.robot_file import read_robot, robot_text
from robcal.files.storage import StorageError
from robcal.robot.model import RobotModel
from robcal.transforms import Array

FORMAT = "robcal/drift-1"


def program() -> str:
    """Version of the program, for the provenance of what it writes."""
    try:
        return version("robcal")
    except PackageNotFoundError:
        return "source"


def now() -> str:
    """The machine's time, UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass(frozen=True)
class ModelRow:
    """A model of the history. ``values`` (p,) is the change of the drifting parameters since the reference."""

    version: int
    cycle: int
    time: float
    values: Array
    covariance: Array


def store_reference(connection: sa.Connection, reference: DriftReference, payload: dict[str, str | None]) -> None:
    """Write the frozen reference; plain arrays and texts, so that later versions of the program can read it."""
    robot = reference.robot
    content = {
        "format": FORMAT,
        "robot": robot_text(robot.model),
        "nominal": None if robot.nominal is None else robot_text(robot.nominal),
        "names": list(robot.names),
        "covariance": robot.covariance,
        "covariance_scale": float(robot.covariance_scale),
        "joint_sigma": np.asarray(robot.joint_sigma, dtype=float),
        "statics": robot.statics,
        "q": robot.q,
        "tools": robot.tools,
        "defaults": dict(robot.defaults),
        "sensor": reference.sensor,
        "poses": list(reference.poses),
        "targets": reference.targets,
        "reference_q": reference.q,
        "reference_load": reference.load,
        "p": reference.p,
        "p_covariance": reference.covariance,
        "drifting": list(reference.names),
        "sizes": reference.sizes,
        "settings": asdict(reference.settings),
        "payload": payload,
    }
    connection.execute(META.insert().values(key="reference", value=codec.dumps(content)))
    connection.execute(META.insert().values(key="made", value=f"{now()} {program()}".encode()))


def load_reference(connection: sa.Connection) -> tuple[DriftReference, dict[str, str | None]]:
    """The frozen reference, and the payload of each of its poses.

    Raises
    ------
    InvalidInput : the database holds no drift control.
    """
    blob = connection.execute(sa.select(META.c.value).where(META.c.key == "reference")).scalar_one_or_none()
    if blob is None:
        raise InvalidInput("the database holds no drift control: make one with 'pipeline drift init'")
    with np.load(io.BytesIO(blob), allow_pickle=False) as archive:
        arrays = {key: archive[key] for key in archive.files}
    data = codec.decode(json.loads(arrays.pop("structure").tobytes().decode()), arrays)
    sigma = data["joint_sigma"]
    robot = CalibratedRobot(
        model=_robot(data["robot"]),
        names=tuple(data["names"]),
        covariance=data["covariance"],
        covariance_scale=data["covariance_scale"],
        joint_sigma=float(sigma) if sigma.ndim == 0 else sigma.tolist(),
        statics=data["statics"],
        nominal=None if data["nominal"] is None else _robot(data["nominal"]),
        q=data["q"],
        tools=data["tools"],
        defaults=data["defaults"],
    )
    settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in data["settings"].items()}
    reference = DriftReference(
        robot,
        data["sensor"],
        tuple(data["poses"]),
        data["targets"],
        data["reference_q"],
        data["reference_load"],
        data["p"],
        data["p_covariance"],
        tuple(data["drifting"]),
        data["sizes"],
        DriftSettings(**settings),
    )
    return reference, data["payload"]


def _robot(text: str) -> RobotModel:
    with tempfile.TemporaryDirectory(prefix="robcal-") as folder:
        file = Path(folder) / "robot.yaml"
        file.write_text(text, encoding="utf-8")
        return read_robot(file)


def load_state(connection: sa.Connection) -> ControlState:
    """Where the control stands; held for this transaction on servers that several may write to."""
    query = sa.select(META.c.value).where(META.c.key == "state").with_for_update()
    data = json.loads(connection.execute(query).scalar_one())
    row = model_in_force(connection)
    data["bad_targets"], data["at_bound"] = tuple(data["bad_targets"]), tuple(data["at_bound"])
    return ControlState(Model(row.cycle, row.time, row.values, row.covariance), **data)


def store_state(connection: sa.Connection, state: ControlState) -> None:
    """Write where the control stands."""
    data = {name: value for name, value in state.__dict__.items() if name != "model"}
    value = json.dumps(data).encode()
    if connection.execute(META.update().where(META.c.key == "state").values(value=value)).rowcount == 0:
        connection.execute(META.insert().values(key="state", value=value))


def store_model(connection: sa.Connection, model: Model, number: int, tour: int | None, reason: str) -> None:
    """Write a model and put it in force."""
    connection.execute(
        MODELS.insert().values(
            version=number,
            cycle=model.cycle,
            time_s=model.time,
            change=np.ascontiguousarray(model.change).tobytes(),
            covariance=np.ascontiguousarray(model.covariance).tobytes(),
            tour=tour,
            made_at=now(),
            program=program(),
        )
    )
    put_in_force(connection, model.cycle, number, reason)


def put_in_force(connection: sa.Connection, cycle: int, number: int, reason: str) -> None:
    """Note that a model is in force from a cycle on."""
    connection.execute(IN_FORCE.insert().values(cycle=cycle, version=number, reason=reason))


def model_in_force(connection: sa.Connection, at_cycle: int | None = None) -> ModelRow:
    """The model in force, or that of an earlier cycle.

    Raises
    ------
    InvalidInput : there was none at that cycle.
    """
    query = sa.select(IN_FORCE.c.version).order_by(IN_FORCE.c.id.desc()).limit(1)
    if at_cycle is not None:
        query = query.where(IN_FORCE.c.cycle <= at_cycle)
    number = connection.execute(query).scalar_one_or_none()
    if number is None:
        raise InvalidInput(f"no model was in force at cycle {at_cycle}: the reference is younger")
    return model_of(connection, number)


def model_of(connection: sa.Connection, number: int) -> ModelRow:
    """A model by its version.

    Raises
    ------
    InvalidInput : there is none of that version.
    """
    row = connection.execute(sa.select(MODELS).where(MODELS.c.version == number)).one_or_none()
    if row is None:
        newest = connection.execute(sa.select(sa.func.max(MODELS.c.version))).scalar_one()
        raise InvalidInput(f"there is no model version {number}: versions go from 1 to {newest}")
    values = np.frombuffer(row.change).copy()
    return ModelRow(
        row.version, row.cycle, row.time_s, values, np.frombuffer(row.covariance).reshape(len(values), -1).copy()
    )


def open_readings(connection: sa.Connection, reference: DriftReference) -> list[tuple[int, Readings]]:
    """Readings of the tour that is not complete, with their numbers."""
    rows = connection.execute(sa.select(READINGS).where(READINGS.c.use == "open").order_by(READINGS.c.id)).all()
    return [
        (
            row.id,
            made(
                reference.kernel,
                reference.robot,
                np.array([row.cycle]),
                np.array([row.time_s]),
                (row.pose,),
                np.array([row.target]),
                (row.content,),
            ),
        )
        for row in rows
    ]


def store_events(connection: sa.Connection, events: Events, readings: dict[int, Readings], first_version: int) -> int:
    """Write tours, models and alarms; returns how many models."""
    uses: dict[str, list[int]] = {}
    for number, use in events.uses.items():
        uses.setdefault(use, []).append(number)
    for became, numbers in uses.items():
        connection.execute(READINGS.update().where(READINGS.c.id.in_(numbers)).values(use=became))
    made_models = 0
    for tour in events.tours:
        members = [readings[number] for number in tour.rows]
        accepted = first_version + made_models if tour.accepted else None
        key = connection.execute(TOURS.insert().values(version=accepted, **_tour_values(tour, members)))
        number = _number(key)
        connection.execute(READINGS.update().where(READINGS.c.id.in_(list(tour.rows))).values(tour=number))
        if accepted is not None:
            model = Model(tour.cycle, tour.time, tour.fit.change, tour.fit.covariance)
            store_model(connection, model, accepted, number, "tour")
            made_models += 1
    for alarm in events.alarms:
        time = next((float(r.time[0]) for r in readings.values() if int(r.cycle[0]) == alarm.cycle), 0.0)
        values = {"cycle": alarm.cycle, "time_s": time, "kind": alarm.kind, "text": alarm.text}
        connection.execute(ALARMS.insert().values(**values))
    return made_models


def _tour_values(tour: Any, members: Sequence[Readings]) -> dict[str, Any]:
    names = {n for r in members for n in r.inputs.covariates if n.startswith("temp_")}
    temperatures = {n: float(np.mean([r.inputs.covariates[n][0] for r in members])) for n in sorted(names)}
    before = 1e3 * np.linalg.norm(tour.fit.linear.r, axis=1)
    targets: dict[str, float] = {}
    for r, size in zip(members, before, strict=True):
        targets[str(int(r.target[0]))] = max(targets.get(str(int(r.target[0])), 0.0), round(float(size), 5))
    rejected = [
        {"cycle": int(r.cycle[0]), "pose": r.pose[0], "target": int(r.target[0])}
        for r, good in zip(members, tour.fit.kept, strict=True)
        if not good
    ]
    return {
        "cycle": tour.cycle,
        "time_s": tour.time,
        "uncorrected_mm": 1e3 * tour.uncorrected,
        "corrected_mm": 1e3 * tour.corrected,
        "residual_mm": 1e3 * tour.residual,
        "noise": tour.fit.noise,
        "rejected": rejected,
        "temperatures": temperatures,
        "targets_mm": targets,
    }


def store_file(connection: sa.Connection, name: str, sha256: str, rows: int, added: int) -> int:
    """Note where readings come from; returns the file's number."""
    values = {"name": name, "sha256": sha256, "taken_at": now(), "rows": rows, "added": added, "program": program()}
    return _number(connection.execute(FILES.insert().values(**values)))


def _number(inserted: sa.CursorResult[Any]) -> int:
    key = inserted.inserted_primary_key
    if key is None:
        raise StorageError("the database gave no number to a new row: it was changed by another program")
    return int(key[0])


def robot_at(connection: sa.Connection, at_cycle: int | None = None) -> CalibratedRobot:
    """The robot with the model in force, or with that of an earlier cycle."""
    reference, _ = load_reference(connection)
    row = model_in_force(connection, at_cycle)
    return with_change(reference, row)


def with_change(reference: DriftReference, row: ModelRow) -> CalibratedRobot:
    """The robot of the reference with drifted parameters; their covariance comes on top."""
    robot = reference.robot
    parameters = dict(robot.model.parameters)
    for name, value in zip(reference.names, row.values, strict=True):
        parameters[name] = parameters.get(name, 0.0) + float(value)
    names = (*robot.names, *(n for n in reference.names if n not in robot.names))
    covariance = np.zeros((len(names), len(names)))
    covariance[: len(robot.names), : len(robot.names)] = robot.covariance
    at = np.array([names.index(name) for name in reference.names])
    covariance[np.ix_(at, at)] += row.covariance
    return replace(robot, model=replace(robot.model, parameters=parameters), names=names, covariance=covariance)
