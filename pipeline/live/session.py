"""Command live: drives a robot through poses, waits until it stands, measures, and writes a campaign.

What is measured goes line by line into a journal, each line flushed before the next pose is sent; a session that is
interrupted, at whatever moment, goes on with the pose it was in. The campaign is written from the journal at the end.
"""

import json
import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from pipeline.json_io import fingerprint
from pipeline.live.link import Link, NoAnswer, Pace, address_of, numbers
from pipeline.messages import LOG
from robcal.errors import InvalidInput
from robcal.files.frame_tables import SIX
from robcal.files.poses_table import joint_columns, read_poses
from robcal.files.robot_import import read_any_robot
from robcal.files.storage import read_bytes, storage_error, write_atomic, write_text
from robcal.files.tables import read_table, write_table
from robcal.files.yaml_io import yaml_text

FORMAT = "robcal/live-1"
ARRIVED = 0.5
"""deg or mm by which a robot that stands may be off its target: it stands elsewhere, beyond that."""
STILL = 0.005
"""deg or mm by which the joints of a standing robot may scatter."""


@dataclass(frozen=True)
class Plan:
    """Poses to measure: names, joint values in deg or mm, their columns, other columns kept as they are."""

    names: tuple[str, ...]
    q: tuple[tuple[float, ...], ...]
    columns: tuple[str, ...]
    other: Mapping[str, Sequence[str]]
    key: str


def read_plan(poses: Path, robot: Path) -> Plan:
    """The poses to measure; joint limits of the robot are checked.

    Raises
    ------
    InvalidInput : a bad table, a pose beyond the limits, names with blanks.
    """
    model = read_any_robot(robot)
    table = read_table(poses)
    payloads = sorted(set(table.texts("payload")) - {""}) if "payload" in table.columns else []
    log = read_poses(poses, model, payloads, to_predict=True)
    if log.outside:
        raise InvalidInput(f"{poses}: {log.outside}: a robot is not driven there")
    columns = tuple(name for name, _ in joint_columns(model))
    bad = next((name for name in log.names if not name.isascii() or len(name.split()) != 1), None)
    if bad is not None:
        raise InvalidInput(f"{poses}: pose '{bad}': names that are sent to a controller are ASCII without blanks")
    factors = [factor for _, factor in joint_columns(model)]
    q = tuple(tuple(float(v / f) for v, f in zip(row, factors, strict=True)) for row in log.q)
    kept = [n for n in table.columns if n not in ("pose", "time_s", *columns) and not n.startswith("approach")]
    other = {n: table.texts(n) for n in kept}
    return Plan(log.names, q, columns, other, fingerprint(log.names, q, {k: list(v) for k, v in other.items()}))


def measure_live(
    poses: Path, robot: Path, out: Path, controller: str, sensor: str | None = None, pace: Pace | None = None
) -> dict[str, Any]:
    """Drive through the poses and write a campaign folder.

    Raises
    ------
    InvalidInput : bad files, a controller that refuses. NoAnswer : the connection stays away; the journal is kept.
    """
    plan = read_plan(poses, robot)
    waits = pace or Pace()
    arm = Link(*address_of(controller, "controller"), waits)
    eye = Link(*address_of(sensor, "sensor"), waits) if sensor is not None else arm
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(out, error) from None
    lock = FileLock(out / ".lock", timeout=0)
    try:
        with lock:
            return _measure(plan, robot, out, arm, eye)
    except Timeout:
        raise InvalidInput(f"{out}: another session writes there: wait for it, or choose another --out") from None
    except NoAnswer as error:
        kept = f"what was measured is kept in {out}, the same command goes on from there"
        raise NoAnswer(f"{error}: check the connection; {kept}") from None
    finally:
        arm.close()
        eye.close()


def _measure(plan: Plan, robot: Path, out: Path, arm: Link, eye: Link) -> dict[str, Any]:
    journal = out / "live.jsonl"
    done = _read_journal(journal, plan)
    resumed = len(done)
    for k, name in enumerate(plan.names):
        if name in done:
            continue
        entry = {"pose": name, **_stand(arm, name, plan.q[k]), **_sense(eye, name)}
        kinds = {("frame" in e) for e in done.values()} | {"frame" in entry}
        if len(kinds) > 1:
            raise InvalidInput(f"pose '{name}': the sensor changed between frames and points: a campaign has one kind")
        _append(journal, entry)
        done[name] = entry
        LOG.info("%d of %d: %s", len(done), len(plan.names), name)
    _write_campaign(plan, robot, out, done)
    return {"poses": len(plan.names), "resumed": resumed, "campaign": str(out)}


def _stand(arm: Link, name: str, q: Sequence[float]) -> dict[str, Any]:
    """Send the robot to a pose and wait until it stands; its time and joints then."""
    arm.ask("MOVE " + " ".join([name, *(f"{v:.6f}" for v in q)]), "MOVING")
    where = f"{arm.host}:{arm.port}, pose '{name}'"
    begin = time.monotonic()
    since, anchor = begin, [math.inf] * len(q)
    while True:
        (words,) = arm.ask("WHERE", "AT")
        moment, *joints = numbers(words[1:], len(q) + 1, where)
        now = time.monotonic()
        if max(abs(a - b) for a, b in zip(joints, anchor, strict=True)) > STILL:
            since, anchor = now, joints
        elif now - since >= arm.pace.still:
            off = max(abs(a - b) for a, b in zip(joints, q, strict=True))
            if off <= ARRIVED:
                return {"time_s": moment, "q": joints}
            if now - begin > arm.pace.move:
                raise InvalidInput(f"{where}: the robot stands {off:.2f} deg off: are its drives on?")
        if now - begin > arm.pace.move:
            raise InvalidInput(f"{where}: the robot does not come to a stop within {arm.pace.move:.0f} s")
        time.sleep(arm.pace.poll)


def _sense(eye: Link, name: str) -> dict[str, Any]:
    """Trigger a measurement: a frame, or points of targets."""
    lines = eye.ask(f"MEASURE {name}", "FRAME|POINTS")
    where = f"{eye.host}:{eye.port}, pose '{name}'"
    if len(lines[0]) < 2 or lines[0][1] != name:
        raise InvalidInput(f"{where}: answers for another pose: '{' '.join(lines[0])[:60]}'")
    if lines[0][0] == "FRAME":
        return {"frame": numbers(lines[0][2:], 6, where)}
    points = {}
    for words in lines[1:]:
        if len(words) != 5:
            raise InvalidInput(f"{where}: 'POINT target x y z' was expected, not '{' '.join(words)[:60]}'")
        points[words[1]] = numbers(words[2:], 3, where)
    return {"points": points}


def _append(journal: Path, entry: Mapping[str, Any]) -> None:
    """One line, on the disk before anything else happens."""
    try:
        with journal.open("ab") as stream:
            stream.write(json.dumps(entry).encode() + b"\n")
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        raise storage_error(journal, error) from None


def _read_journal(journal: Path, plan: Plan) -> dict[str, dict[str, Any]]:
    """Poses that are measured already; a last line that was not finished is cut off.

    Raises
    ------
    InvalidInput : the journal of another plan.
    """
    if not journal.is_file():
        _append(journal, {"format": FORMAT, "plan": plan.key})
        return {}
    raw = read_bytes(journal, 1_000_000_000)
    whole = raw[: raw.rfind(b"\n") + 1]
    try:
        lines = [json.loads(line) for line in whole.splitlines()]
    except ValueError:
        raise InvalidInput(f"{journal}: is damaged: choose another --out") from None
    if lines and lines[0] != {"format": FORMAT, "plan": plan.key}:
        raise InvalidInput(f"{journal}: belongs to other poses: choose another --out, or go on with its own poses")
    if whole != raw:
        write_atomic(journal, lambda stream: stream.write(whole))
    if not lines:
        _append(journal, {"format": FORMAT, "plan": plan.key})
    return {line["pose"]: line for line in lines[1:]}


def _write_campaign(plan: Plan, robot: Path, out: Path, done: Mapping[str, dict[str, Any]]) -> None:
    """Tables and campaign.yaml, which comes last: with it the campaign is complete."""
    entries = [done[name] for name in plan.names]
    columns: dict[str, Sequence[object]] = {"pose": plan.names}
    columns |= {n: [f"{e['q'][k]:.9f}" for e in entries] for k, n in enumerate(plan.columns)}
    columns |= {**plan.other, "time_s": [repr(float(e["time_s"])) for e in entries]}
    write_table(out / "poses.csv", columns)
    if "frame" in entries[0]:
        names = [f"{n}_{'mm' if k < 3 else 'deg'}" for k, n in enumerate(SIX)]
        frames = {n: [repr(float(e["frame"][k])) for e in entries] for k, n in enumerate(names)}
        measurements = "frames.csv"
        write_table(out / measurements, {"pose": plan.names, **frames})
    else:
        rows = [(e["pose"], target, *xyz) for e in entries for target, xyz in e["points"].items()]
        if not rows:
            raise InvalidInput(f"{out}: the sensor saw no target in any pose: nothing to identify from")
        heads = ("pose", "target", "x_mm", "y_mm", "z_mm")
        measurements = "points.csv"
        write_table(out / measurements, {n: [row[k] for row in rows] for k, n in enumerate(heads)})
    robot_name = f"robot{robot.suffix}"
    content = read_bytes(robot, 20_000_000)
    write_atomic(out / robot_name, lambda stream: stream.write(content))
    data = {
        "format": "robcal/campaign-1",
        "name": out.resolve().name,
        "robot": robot_name,
        "poses": "poses.csv",
        "measurements": measurements,
    }
    write_text(out / "campaign.yaml", yaml_text(data))
