"""What the commands of a drift control do: init, add, status, watch, rollback."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from pipeline.campaign_reader import read_campaign
from pipeline.drift import store
from pipeline.drift.database import ALARMS, FILES, META, METADATA, MODELS, READINGS, TOURS, transaction
from pipeline.drift.readings_table import ReadingsTable, read_readings
from pipeline.runs import campaign_of, open_run
from pipeline.stages.identify import load_calibrated
from robcal.drift.control import DriftControl, started
from robcal.drift.jumps import unwatched_joints
from robcal.drift.reference import DriftReference, DriftSettings, freeze
from robcal.errors import InvalidInput
from robcal.files.placement import PlacementEntry
from robcal.files.storage import sha256_of
from robcal.files.yaml_io import read_yaml
from robcal.robot.kernel_cache import kernel_of
from robcal.transforms import Array

MOST_REJECTED_REPORTED = 200


def start(
    run: Path,
    readings: Path,
    place: Path | str,
    *,
    parameters: Sequence[str] | None = None,
    tool: Path | None = None,
    settings: DriftSettings | None = None,
) -> dict[str, Any]:
    """Freeze the reference of a drift control.

    Raises
    ------
    InvalidInput : no calibrated robot in the run, a table that contradicts the contract, a state that is there already.
    """
    robot = load_calibrated(open_run(run))
    options = settings or DriftSettings()
    sensor = None if tool is None else _tool(tool)
    kernel = kernel_of(robot.model, robot.statics)
    known, load = _campaign_angles(run, robot.model.n_joints)
    table = read_readings(readings, robot, kernel, known.get, options.sigma, load)
    try:
        reference = freeze(robot, table.readings, sensor=sensor, parameters=parameters, settings=options)
    except InvalidInput as problem:
        raise InvalidInput(f"{readings}: {problem}") from None
    payload = {name: content["payload"] for name, content in zip(table.readings.pose, table.content, strict=True)}
    with transaction(place, make=True) as connection:
        METADATA.create_all(connection)
        if connection.execute(sa.select(META.c.key)).first() is not None:
            raise InvalidInput(f"{place}: holds a drift control already: choose another name, or remove it")
        store.store_reference(connection, reference, payload)
        state = started(reference, table.readings)
        file = store.store_file(connection, str(readings), sha256_of(readings), len(table.content), len(table.content))
        _insert(connection, table, range(len(table.content)), file, "reference")
        store.store_model(connection, state.model, 1, None, "reference")
        store.store_state(connection, state)
    return {
        "state": str(place),
        "parameters": list(reference.names),
        "measurements": len(reference.poses),
        "targets": len(set(reference.targets.tolist())),
        "cycle": state.newest_cycle,
        "unwatched": unwatched_joints(reference),
    }


def add(place: Path | str, readings: Path) -> dict[str, Any]:
    """Take in the readings of a file, each of them once; all or nothing.

    Raises
    ------
    InvalidInput : a table that contradicts the contract, or earlier readings. StorageError : the database refuses.
    """
    with transaction(place) as connection:
        reference, payload = store.load_reference(connection)
        state = store.load_state(connection)
        angles = {pose: reference.q[k] for k, pose in reversed(list(enumerate(reference.poses)))}
        table = read_readings(
            readings, reference.robot, reference.kernel, angles.get, reference.settings.sigma, payload
        )
        _refuse_unknown(table, reference)
        new = _new_rows(connection, table)
        file = store.store_file(connection, str(readings), sha256_of(readings), len(table.content), len(new))
        numbers = _insert(connection, table, new, file, "open")
        before = store.open_readings(connection, reference)
        taken = set(numbers)
        control = DriftControl(reference, state, [row for row in before if row[0] not in taken])
        fresh = table.readings.subset(new)
        events = control.take(fresh, numbers)
        members = dict(before) | {number: fresh.subset([i]) for i, number in enumerate(numbers)}
        newest = connection.execute(sa.select(sa.func.max(MODELS.c.version))).scalar_one()
        models = store.store_events(connection, events, members, newest + 1)
        store.store_state(connection, control.state)
    return {
        "readings": len(table.content),
        "added": len(new),
        "known": len(table.content) - len(new),
        "tours": len(events.tours),
        "models": models,
        "missing": len(control.missing),
        "corrected_mm": 1e3 * events.tours[-1].corrected if events.tours else None,
        "alarms": [{"cycle": a.cycle, "kind": a.kind, "text": a.text} for a in events.alarms],
    }


def status(place: Path | str) -> dict[str, Any]:
    """How the control stands; see docs/formats.md for the keys."""
    with transaction(place) as connection:
        reference, _ = store.load_reference(connection)
        state = store.load_state(connection)
        model = store.model_in_force(connection)
        tour = connection.execute(sa.select(TOURS).order_by(TOURS.c.id.desc()).limit(1)).one_or_none()
        alarms = connection.execute(sa.select(ALARMS).order_by(ALARMS.c.id)).all()
        rejected = connection.execute(
            sa.select(READINGS.c.cycle, READINGS.c.pose, READINGS.c.target)
            .where(READINGS.c.use == "rejected")
            .order_by(READINGS.c.id.desc())
            .limit(MOST_REJECTED_REPORTED)
        ).all()
        opened = connection.execute(
            sa.select(sa.func.count()).select_from(READINGS).where(READINGS.c.use == "open")
        ).scalar_one()
    return {
        "cycle": state.newest_cycle,
        "model_version": model.version,
        "parameters": dict(zip(reference.names, model.values.tolist(), strict=True)),
        "sigma": dict(zip(reference.names, np.sqrt(np.diag(model.covariance)).tolist(), strict=True)),
        "residual_mm": None if tour is None else tour.residual_mm,
        "uncorrected_mm": None if tour is None else tour.uncorrected_mm,
        "corrected_mm": None if tour is None else tour.corrected_mm,
        "alarms": [{"cycle": a.cycle, "kind": a.kind, "text": a.text} for a in alarms],
        "rejected": [{"cycle": r.cycle, "pose": r.pose, "target": r.target} for r in reversed(rejected)],
        "held": state.held,
        "missing": len(reference.poses) - opened,
        "noise": state.noise,
        "unwatched": unwatched_joints(reference),
    }


def rollback(place: Path | str, number: int) -> dict[str, Any]:
    """Put an earlier model in force, and take the control up again where an alarm had stopped it."""
    with transaction(place) as connection:
        state = store.load_state(connection)
        row = store.model_of(connection, number)
        store.put_in_force(connection, state.newest_cycle, number, "rollback")
        store.store_state(connection, replace(state, held=False, released=True))
    return {"model_version": row.version, "cycle": state.newest_cycle, "of_cycle": row.cycle}


def watch(place: Path | str, folder: Path, every: float, once: bool) -> Iterator[tuple[Path, dict[str, Any] | str]]:
    """Take in the tables of a folder as they appear, in the order of their names; yields what came of each.

    A file is read when its size has stopped growing. One that was refused is tried again when it has changed.
    """
    if not folder.is_dir():
        raise InvalidInput(f"{folder}: is not a folder: name the one in which the files of readings appear")
    done: dict[Path, tuple[int, int]] = {}
    while True:
        for file in sorted(folder.glob("*.csv")):
            mark = _mark(file)
            if mark is None or done.get(file) == mark or (not once and time.time() - mark[1] / 1e9 < 1.0):
                continue
            done[file] = mark
            if _taken(place, file):
                continue
            try:
                yield file, add(place, file)
            except InvalidInput as problem:
                yield file, str(problem)
        if once:
            return
        time.sleep(every)


def _mark(file: Path) -> tuple[int, int] | None:
    try:
        found = file.stat()
    except FileNotFoundError:
        return None
    return found.st_size, found.st_mtime_ns


def _taken(place: Path | str, file: Path) -> bool:
    with transaction(place) as connection:
        known = sa.select(FILES.c.id).where(FILES.c.sha256 == sha256_of(file))
        return connection.execute(known).first() is not None


def _tool(path: Path) -> Array:
    value = read_yaml(path).data
    entry = value.get("flange_T_tool") if isinstance(value, dict) else None
    if not isinstance(entry, dict):
        raise InvalidInput(f"{path}: holds no flange_T_tool (xyz_mm, rpy_deg): where the sensor sits on the flange")
    return PlacementEntry(xyz_mm=entry.get("xyz_mm", (0, 0, 0)), rpy_deg=entry.get("rpy_deg", (0, 0, 0))).matrix()


def _campaign_angles(run: Path, joints: int) -> tuple[dict[str, Array], dict[str, str | None]]:
    """Angles and loads of the poses of the run's campaign, as far as it is still there."""
    path = campaign_of(open_run(run))
    if not path.exists():
        return {}, {}
    log = read_campaign(path).poses
    if log is None or log.q.shape[1] != joints:
        return {}, {}
    return dict(zip(log.names, log.q, strict=True)), dict(zip(log.names, log.payload, strict=True))


def _refuse_unknown(table: ReadingsTable, reference: DriftReference) -> None:
    slots = reference.slots(table.readings)
    if (slots < 0).any():
        i = int(np.argmax(slots < 0))
        pose, target = table.readings.pose[i], int(table.readings.target[i])
        raise table.table.error(
            i, f"pose '{pose}' with target {target} is not in the reference: remove the row, or begin anew (drift init)"
        )


def _new_rows(connection: sa.Connection, table: ReadingsTable) -> list[int]:
    """Rows that were not taken in before.

    Raises
    ------
    InvalidInput : one was, with other values.
    """
    readings = table.readings
    cycles = sorted(set(readings.cycle.tolist()))
    known: dict[tuple[int, str, int], Any] = {}
    for first in range(0, len(cycles), 500):
        query = sa.select(READINGS).where(READINGS.c.cycle.in_(cycles[first : first + 500]))
        known |= {(row.cycle, row.pose, row.target): row for row in connection.execute(query)}
    new = []
    for i, key in enumerate(zip(readings.cycle.tolist(), readings.pose, readings.target.tolist(), strict=True)):
        row = known.get(key)
        if row is None:
            new.append(i)
        elif row.time_s != readings.time[i] or row.content["x"] != table.content[i]["x"]:
            raise table.table.error(
                i,
                f"cycle {key[0]}, pose '{key[1]}', target {key[2]} was taken in before with other values: nothing was "
                "taken in; correct the row, or number the cycles on",
            )
    return new


def _insert(connection: sa.Connection, table: ReadingsTable, rows: Sequence[int], file: int, use: str) -> list[int]:
    """Store rows; returns their numbers."""
    if not len(rows):
        return []
    first = connection.execute(sa.select(sa.func.coalesce(sa.func.max(READINGS.c.id), 0))).scalar_one() + 1
    r = table.readings
    values = [
        {
            "id": first + k,
            "cycle": int(r.cycle[i]),
            "pose": r.pose[i],
            "target": int(r.target[i]),
            "time_s": float(r.time[i]),
            "content": table.content[i],
            "use": use,
            "file": file,
        }
        for k, i in enumerate(rows)
    ]
    connection.execute(READINGS.insert(), values)
    return [first + k for k in range(len(rows))]
