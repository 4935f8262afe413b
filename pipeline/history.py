"""Command history: every run with its provenance in a database, and what changed between them.

SQLite in one file by default, PostgreSQL by URL. The schema has a version; an older database is brought up to date when
it is opened, step by step, in the transaction that opens it.
"""

import datetime as dt
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from pipeline.batch import without_times
from pipeline.drift.database import database_transaction
from pipeline.fleet import UNITS, member_of
from pipeline.json_io import fingerprint, read_json
from pipeline.runs import campaign_of, is_run, open_run
from pipeline.sources import code_version
from pipeline.stages.identify import load_calibrated
from robcal.errors import InvalidInput
from robcal.files.schemas import proposal
from robcal.fleet.change import Change, change
from robcal.fleet.statistics import Member
from robcal.robot.model import parameter_unit

VERSION = 2
METADATA = sa.MetaData()
META = sa.Table("history_meta", METADATA, sa.Column("version", sa.Integer, nullable=False))
RUNS = sa.Table(
    "history_run",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("sha256", sa.String, nullable=False, unique=True),
    sa.Column("robot", sa.String, nullable=False, index=True),
    sa.Column("campaign", sa.String, nullable=False),
    sa.Column("folder", sa.String, nullable=False),
    sa.Column("measured_at", sa.String, nullable=False),
    sa.Column("imported_at", sa.String, nullable=False),
    sa.Column("program", sa.String, nullable=False),
    sa.Column("result", sa.JSON, nullable=False),
    sa.Column("parameters", sa.JSON, nullable=False),
    sa.Column("note", sa.String, nullable=False, server_default=""),
)


def _add_notes(connection: sa.Connection) -> None:
    connection.exec_driver_sql("ALTER TABLE history_run ADD COLUMN note VARCHAR NOT NULL DEFAULT ''")


MIGRATIONS: Mapping[int, Callable[[sa.Connection], None]] = {1: _add_notes}
"""Schema version -> what brings it to the next one."""


@contextmanager
def opened(database: str) -> Iterator[sa.Connection]:
    """A transaction on a history, made or brought up to date where need be.

    Raises
    ------
    InvalidInput : the database is of a newer program. StorageError : it cannot be opened or written.
    """
    with database_transaction(database, "history") as connection:
        if not sa.inspect(connection).has_table("history_meta"):
            METADATA.create_all(connection)
            connection.execute(META.insert().values(version=VERSION))
        version = connection.execute(sa.select(META.c.version)).scalar_one()
        if version > VERSION:
            raise InvalidInput(f"{database}: was written by a newer program (schema {version}): update this one")
        while version < VERSION:
            MIGRATIONS[version](connection)
            version += 1
            connection.execute(META.update().values(version=version))
        yield connection


def import_run(folder: Path, database: str, *, robot: str | None = None, note: str = "") -> dict[str, Any]:
    """Take a run into the history; one that is there already is left as it is.

    Parameters
    ----------
    robot : which robot it is; default the name in its robot file.

    Raises
    ------
    InvalidInput : no run with a calibrated robot.
    """
    run = open_run(folder)
    calibrated = load_calibrated(run)
    member = member_of(calibrated, folder.name)
    result = without_times(read_json(run.result))
    parameters = {
        "names": list(member.parameters),
        "values": member.values.tolist(),
        "covariance": member.covariance.tolist(),
        "units": [parameter_unit(calibrated.model, name) for name in member.parameters],
    }
    entry = {
        "sha256": fingerprint(result, parameters),
        "robot": robot or calibrated.model.name,
        "campaign": str(result.get("campaign", "")),
        "folder": str(folder.resolve()),
        "measured_at": _measured_at(campaign_of(run), run.result),
        "imported_at": _now(),
        "program": code_version("pipeline.runner"),
        "result": result,
        "parameters": parameters,
        "note": note,
    }
    with opened(database) as connection:
        known = connection.execute(sa.select(RUNS.c.id).where(RUNS.c.sha256 == entry["sha256"])).scalar()
        if known is not None:
            return {"id": known, "new": False, "robot": entry["robot"]}
        made = connection.execute(RUNS.insert().values(**entry)).inserted_primary_key
        return {"id": made[0] if made else None, "new": True, "robot": entry["robot"]}


def _now() -> str:
    return dt.datetime.now(dt.UTC).isoformat(timespec="seconds")


def _measured_at(campaign: Path, result: Path) -> str:
    """When the measurements were written, for want of a better date that of the result."""
    file = campaign if campaign.is_file() else campaign / "campaign.yaml"
    folder = file.parent
    files = [path for path in folder.glob("*.csv") if path.is_file()] if file.is_file() else []
    moment = max((path.stat().st_mtime for path in files), default=result.stat().st_mtime)
    return dt.datetime.fromtimestamp(moment, dt.UTC).isoformat(timespec="seconds")


def list_runs(database: str, robot: str | None = None) -> list[dict[str, Any]]:
    """All runs, the earliest measurement first."""
    columns = (RUNS.c.id, RUNS.c.robot, RUNS.c.campaign, RUNS.c.measured_at, RUNS.c.folder, RUNS.c.note, RUNS.c.result)
    query = sa.select(*columns).order_by(RUNS.c.measured_at, RUNS.c.id)
    if robot is not None:
        query = query.where(RUNS.c.robot == robot)
    with opened(database) as connection:
        rows = [dict(row._mapping) for row in connection.execute(query)]
        known = [str(name) for name in connection.execute(sa.select(RUNS.c.robot).distinct()).scalars()]
    if robot is not None and not rows:
        raise InvalidInput(f"{database}: holds no run of robot '{robot}'{proposal(robot, known)}")
    for row in rows:
        result = row.pop("result")
        row["mean_mm"] = _mean(result)
    return rows


def _mean(result: Mapping[str, Any]) -> float | None:
    verification = result.get("verification") or {}
    delivered = verification.get("delivered") or (verification.get("tools") or {}).get("0") or {}
    value = delivered.get("mean")
    return float(value) if isinstance(value, int | float) else None


def show_run(database: str, key: str) -> dict[str, Any]:
    """Everything that the history knows of a run.

    Raises
    ------
    InvalidInput : there is none of that number.
    """
    return _row(database, key)


def _row(database: str, key: str) -> dict[str, Any]:
    if not key.isdigit():
        raise InvalidInput(f"'{key}' is no number of a run: see 'pipeline history list'")
    with opened(database) as connection:
        row = connection.execute(sa.select(RUNS).where(RUNS.c.id == int(key))).first()
    if row is None:
        raise InvalidInput(f"{database}: holds no run {key}: see 'pipeline history list'")
    return dict(row._mapping)


def compare_runs(database: str, before: str, after: str) -> dict[str, Any]:
    """What changed between two runs, given by number in the history or as folders.

    Raises
    ------
    InvalidInput : a run is not there, or they have no parameters in common.
    """
    rows = [_either(database, key) for key in (before, after)]
    return _comparison(rows[0], rows[1])


def changes_of(database: str, robot: str, days: float) -> dict[str, Any]:
    """What changed on a robot between its last run and the one nearest to so many days before it.

    Raises
    ------
    InvalidInput : fewer than two runs of the robot.
    """
    listed = list_runs(database, robot)
    if len(listed) < 2:
        raise InvalidInput(f"{database}: holds one run of robot '{robot}': two are needed to compare")
    times = [dt.datetime.fromisoformat(row["measured_at"]) for row in listed]
    wanted = times[-1] - dt.timedelta(days=days)
    nearest = min(range(len(listed) - 1), key=lambda k: abs((times[k] - wanted).total_seconds()))
    return _comparison(*(_row(database, str(listed[k]["id"])) for k in (nearest, -1)))


def _either(database: str, key: str) -> dict[str, Any]:
    folder = Path(key)
    if not key.isdigit() and is_run(folder):
        run = open_run(folder)
        robot = load_calibrated(run)
        member = member_of(robot, key)
        parameters = {
            "names": list(member.parameters),
            "values": member.values.tolist(),
            "covariance": member.covariance.tolist(),
            "units": [parameter_unit(robot.model, name) for name in member.parameters],
        }
        return {
            "id": key,
            "robot": robot.model.name,
            "measured_at": _measured_at(campaign_of(run), run.result),
            "parameters": parameters,
        }
    return _row(database, key)


def _comparison(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    members = [_member(row) for row in (before, after)]
    found = change(*members)
    units = dict(zip(after["parameters"]["names"], after["parameters"]["units"], strict=True))
    warnings = []
    if before["robot"] != after["robot"]:
        warnings.append(f"two robots are compared: '{before['robot']}' and '{after['robot']}'")
    return {
        "before": {"id": before["id"], "robot": before["robot"], "measured_at": before["measured_at"]},
        "after": {"id": after["id"], "robot": after["robot"], "measured_at": after["measured_at"]},
        "p_value": found.p_value,
        "chi_square": found.chi_square,
        "parameters": _entries(found, units),
        "statement": _statement(found, units),
        "warnings": warnings,
    }


def _member(row: Mapping[str, Any]) -> Member:
    p = row["parameters"]
    return Member(str(row["id"]), tuple(p["names"]), np.array(p["values"]), np.array(p["covariance"]))


def _entries(found: Change, units: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    entries = {}
    for p in found.parameters:
        unit, factor = UNITS.get(units.get(p.name, "1"), (units.get(p.name, "1"), 1.0))
        entries[p.name] = {"change": p.change * factor, "sigma": p.sigma * factor, "unit": unit, "p_value": p.p_value}
    return entries


def _statement(found: Change, units: Mapping[str, str]) -> str:
    significant = sorted((p for p in found.parameters if p.p_value < 0.01), key=lambda p: p.p_value)
    if not significant:
        altogether = f"altogether p = {found.p_value:.2g}"
        if found.p_value < 0.01:
            return f"the robot changed ({altogether}), in no single parameter beyond doubt"
        return f"nothing changed beyond what the measurements leave open ({altogether})"
    entries = _entries(found, units)
    parts = [
        f"{p.name} by {entries[p.name]['change']:+.4g} +- {entries[p.name]['sigma']:.2g} {entries[p.name]['unit']}"
        for p in significant[:6]
    ]
    more: Sequence[str] = [f"and {len(significant) - 6} more"] if len(significant) > 6 else []
    return "changed: " + ", ".join([*parts, *more])
