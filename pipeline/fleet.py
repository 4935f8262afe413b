"""Command fleet: the parameters of many runs, what is usual among them and which robots are not."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.json_io import write_json
from pipeline.runs import is_run, open_run
from pipeline.stages.identify import load_calibrated
from robcal.calibration.calibrated import CalibratedRobot
from robcal.errors import InvalidInput, RobcalError
from robcal.files.storage import write_text
from robcal.fleet.statistics import Fleet, Member, fleet
from robcal.robot.model import RobotModel, parameter_unit

FORMAT = "robcal/fleet-1"
DEGREES = 180.0 / math.pi
UNITS = {"m": ("mm", 1e3), "rad": ("deg", DEGREES), "rad/(N m)": ("deg/kNm", 1e3 * DEGREES), "kg": ("kg", 1.0)}
"""Unit inside -> unit of files and factor."""


def member_of(robot: CalibratedRobot, name: str, batch: str = "") -> Member:
    """The parameters of a robot itself, those of the cell (base and tool) left out."""
    own = [k for k, n in enumerate(robot.names) if not n.startswith(("base.", "tool."))]
    names = tuple(robot.names[k] for k in own)
    values = np.array([robot.values[n] for n in names])
    return Member(name, names, values, robot.covariance[np.ix_(own, own)], batch)


def read_fleet(folder: Path) -> tuple[list[Member], RobotModel, list[str]]:
    """The calibrated robots of all runs below a folder, one of their models, and runs without one.

    A run in a folder of its own below the fleet's (`runs/supplier/robot`) belongs to the batch of that name.

    Raises
    ------
    InvalidInput : no runs.
    """
    runs = sorted(path.parent.parent for path in folder.rglob("state/run.json") if is_run(path.parent.parent))
    members: list[Member] = []
    model: RobotModel | None = None
    without = []
    for run in runs:
        place = run.relative_to(folder)
        try:
            robot = load_calibrated(open_run(run))
        except RobcalError as error:
            without.append(f"{run}: left out: {error}")
            continue
        model = model or robot.model
        members.append(member_of(robot, place.as_posix(), place.parts[0] if len(place.parts) > 1 else ""))
    if model is None:
        raise InvalidInput(f"{folder}: holds no run with a calibrated robot: name the RUNS of 'pipeline batch'")
    return members, model, without


def fleet_report(folder: Path, out: Path) -> dict[str, Any]:
    """Write the page of a fleet and `fleet.json` beside it.

    Raises
    ------
    InvalidInput : no runs, too few, or none with parameters in common.
    """
    from pipeline.report.fleet_page import fleet_page

    members, model, warnings = read_fleet(folder)
    found = fleet(members)
    data = fleet_data(found, members, model)
    table = out.with_name("fleet.json") if out.stem == "fleet" else out.with_suffix(".json")
    write_json(table, data)
    write_text(out, fleet_page(data, {m.name: m.batch for m in members}))
    return {
        "robots": len(members),
        "parameters": len(found.parameters),
        "outlying": [o.name for o in found.outliers],
        "differences": [f"{d.parameter} ({d.kind})" for d in found.differences],
        "out": [str(out), str(table)],
        "warnings": warnings,
    }


def fleet_data(found: Fleet, members: list[Member], model: RobotModel) -> dict[str, Any]:
    """Content of fleet.json, in mm and degrees."""
    scale = {p.name: unit_of(model, p.name) for p in found.parameters}
    outlying = {o.name for o in found.outliers}
    beyond: Mapping[str, list[dict[str, Any]]] = {p.name: [] for p in found.parameters}
    for outlier in found.outliers:
        for name, z in outlier.parameters.items():
            p = next(q for q in found.parameters if q.name == name)
            value = float(p.values[p.robots.index(outlier.name)])
            beyond[name].append({"run": outlier.name, "value": value * scale[name][1], "z": z})
    return {
        "format": FORMAT,
        "robots": len(members),
        "batches": dict(found.batches),
        "parameters": {
            p.name: {
                "unit": scale[p.name][0],
                "robots": len(p.robots),
                "median": p.median * scale[p.name][1],
                "spread": p.spread * scale[p.name][1],
                "sigma": p.sigma * scale[p.name][1],
                "values": dict(zip(p.robots, (p.values * scale[p.name][1]).tolist(), strict=True)),
                "outliers": beyond[p.name],
            }
            for p in found.parameters
        },
        "outlying": [{"run": o.name, "p_value": o.p_value, "z": dict(o.parameters)} for o in found.outliers],
        "ordinary": len(members) - len(outlying),
        "differences": [
            {
                "parameter": d.parameter,
                "kind": d.kind,
                "p_value": d.p_value,
                "medians": {name: value * scale[d.parameter][1] for name, value in d.medians.items()},
            }
            for d in found.differences
        ],
    }


def unit_of(model: RobotModel, name: str) -> tuple[str, float]:
    """Unit of a parameter in files, and the factor to it."""
    try:
        unit = parameter_unit(model, name)
    except (KeyError, ValueError):
        unit = "1"
    return UNITS.get(unit, (unit, 1.0))
