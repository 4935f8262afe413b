"""campaign.yaml for what lies in a folder, with a comment for each choice and each thing that is missing."""

import re
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.beginning.found import Found, TableFound, look_around
from pipeline.campaign_schema import FORMAT
from robcal.errors import InvalidInput
from robcal.files.poses_table import NO_PAYLOAD
from robcal.files.storage import write_text
from robcal.files.yaml_io import FlowMapping, yaml_text

FITTING = 0.5
"""Share of the images of a folder that must bear the name of a pose for a station camera's."""


@dataclass
class _Text:
    """Lines of the file, and what a person has to look at."""

    lines: list[str] = field(default_factory=list)
    todo: list[str] = field(default_factory=list)

    def add(self, entry: dict[str, object], comment: str = "", indent: int = 0) -> None:
        lines = yaml_text(entry).splitlines()
        lines[0] += f"{' ' * max(1, 38 - len(lines[0]) - indent)}# {comment}" if comment else ""
        self.lines += [" " * indent + line for line in lines]

    def remark(self, sentence: str, missing: bool = True) -> None:
        self.lines.append(f"# {sentence}")
        if missing:
            self.todo.append(sentence)


def begin_campaign(folder: Path) -> tuple[Path, list[str]]:
    """Write campaign.yaml into a folder from what lies there; its path, and what is missing or to be looked at.

    Raises
    ------
    InvalidInput : there is one already, no such folder, or nothing that a campaign can use.
    """
    path = folder / "campaign.yaml"
    if path.exists() or path.is_symlink():
        raise InvalidInput(f"{path}: is there already and is never overwritten: 'pipeline check {folder}' looks at it")
    text, todo = campaign_text(look_around(folder))
    write_text(path, text)
    return path, todo


def campaign_text(found: Found) -> tuple[str, list[str]]:
    """The text of a campaign.yaml, and what is missing in it.

    Raises
    ------
    InvalidInput : nothing that a campaign can use.
    """
    if not (found.images or found.of("frames", "points", "distances", "sensor_points", "marks")):
        unread = f" (not understood: {', '.join(p.name for p in found.unknown[:5])})" if found.unknown else ""
        raise InvalidInput(
            f"{found.folder}: neither images nor measurements lie here{unread}: images are PNG, TIFF, JPEG or BMP in "
            "folders; tables have a heading, see docs/campaigns.md"
        )
    out = _Text()
    out.lines += [
        "# Written from what lies in this folder. 'pipeline check' says what is missing, 'pipeline run' runs it.",
        "# Paths are relative to this file; docs/campaigns.md has all keys.",
    ]
    out.add({"format": FORMAT})
    out.add({"name": _plain(found.folder.resolve().name)}, "names the run folder")
    poses = _robot(out, found)
    station, surveys = _sources(found, poses)
    body_of = _bodies(out, found, surveys, station)
    _measured(out, found, station, body_of, poses)
    for path in found.unknown:
        out.remark(f"not used: {_relative(found, path)}", missing=False)
    return "\n".join(out.lines) + "\n", out.todo


def _plain(name: str) -> str:
    return re.sub(r"[^\w .+-]", "-", name).strip(" .")[:100] or "campaign"


def _relative(found: Found, path: Path) -> str:
    return path.relative_to(found.folder).as_posix()


def _use(found: Found, table: TableFound) -> object:
    """The entry of a table: its name, or a mapping where it is of another program."""
    name = _relative(found, table.path)
    if not table.use:
        return name
    entry = FlowMapping(file=name, **table.use)
    if isinstance(entry.get("columns"), dict):
        entry["columns"] = FlowMapping(entry["columns"])
    return entry


def _robot(out: _Text, found: Found) -> TableFound | None:
    """Robot, poses and payloads; the table of poses."""
    tables = found.of("poses")
    if found.robots:
        others = ", ".join(_relative(found, p) for p in found.robots[1:])
        out.add({"robot": _relative(found, found.robots[0])}, f"nominal; also here: {others}" if others else "nominal")
    elif tables:
        out.remark("robot: robot.yaml    missing: the nominal robot (URDF, dh.csv, or a copy from configs/robots)")
    if not found.robots or not tables:
        if found.robots:
            out.remark("poses: poses.csv    missing: the joint angles (pose, q1_deg, ...), or the controller's file")
        if not tables:
            return None
    table = max(tables, key=lambda t: len(t.names))
    others = ", ".join(_relative(found, t.path) for t in tables if t is not table)
    out.add({"poses": _use(found, table)}, f"also here: {others}" if others else f"{len(table.names)} poses")
    loads = [name for name in table.payloads if name.lower() not in NO_PAYLOAD]
    if loads and found.robots:
        out.add(
            {"payloads": {n: FlowMapping(mass_kg=0.0, cog_mm=[0.0, 0.0, 0.0]) for n in loads}}, "flange coordinates"
        )
        out.remark(f"state mass and centre of gravity of {', '.join(loads)}; 0 kg is a placeholder")
    return table


def _sources(
    found: Found, poses: TableFound | None
) -> tuple[dict[str, dict[str, object]], dict[str, dict[str, object]]]:
    """Station cameras and surveys by name; images or marks that bear the names of poses are a station's."""
    known = set(poses.names) if poses is not None else set()
    station: dict[str, dict[str, object]] = {}
    surveys: dict[str, dict[str, object]] = {}
    for folder, images in found.images.items():
        fits = sum(Path(name).stem in known for name in images) >= FITTING * len(images) and bool(known)
        inside = "station" in folder.relative_to(found.folder).parts and not known
        entry: dict[str, object] = {"images": _relative(found, folder)}
        (station if fits or inside else surveys)[folder.name if folder != found.folder else "camera"] = entry
    for table in found.of("marks"):
        fits = bool(known) and sum(name in known for name in table.names) >= FITTING * len(table.names)
        (station if fits else surveys)[table.path.stem] = {"observations": _relative(found, table.path)}
    for name, entry in station.items():
        file = next((p for p in found.cameras if p.stem.lower() == name.lower()), None)
        if file is not None:
            entry["calibration"] = _relative(found, file)
    return station, surveys


def _bodies(
    out: _Text, found: Found, surveys: dict[str, dict[str, object]], station: dict[str, dict[str, object]]
) -> str | None:
    """Bodies with their surveys; the name of the one that the robot carries."""
    if not found.bodies:
        if surveys or station:
            out.remark("bodies: {plate: {targets: plate.yaml}}    missing: the body file that lists the targets' ids")
        return None
    names = {path: path.stem for path in found.bodies}
    entries: dict[str, dict[str, object]] = {name: {"targets": _relative(found, p)} for p, name in names.items()}
    for name, entry in surveys.items():
        body = next((b for b in entries if b.lower() in name.lower() or name.lower() in b.lower()), next(iter(entries)))
        if "survey" in entries[body]:
            out.remark(f"not used: {next(iter(entry.values()))} (a second survey of {body}?)")
            continue
        camera = next((p for p in found.cameras if p.stem.lower().startswith(("survey", name.lower()))), None)
        if camera is not None and _relative(found, camera) not in [c.get("calibration") for c in station.values()]:
            entry["camera"] = _relative(found, camera)
        entries[body]["survey"] = entry
    out.add({"bodies": entries})
    if surveys:
        out.remark("scale_bars under 'survey', where bars were photographed:", missing=False)
        out.remark("  scale_bars: [{targets: [151, 343], length_mm: 1000.012, sigma_mm: 0.005}]", missing=False)
        out.todo.append(
            "list the scale bars that were photographed (scale_bars), or certified coordinates give the scale"
        )
    return next((name for name in entries if "plate" in name.lower()), next(iter(entries)))


def _measured(
    out: _Text, found: Found, station: dict[str, dict[str, object]], body: str | None, poses: TableFound | None
) -> None:
    tables = found.of("frames", "points", "distances", "sensor_points")
    uses = [_use(found, table) for table in tables]
    message = "; ".join(f"{_relative(found, t.path)}: {t.kind}" for t in tables)
    if station and body is not None:
        out.add({"station": {"cameras": {n: FlowMapping(e) for n, e in station.items()}, "body": body}})
        if len(found.bodies) > 1:
            out.todo.append(
                f"station.body: the robot carries '{body}'? also here: {', '.join(p.stem for p in found.bodies)}"
            )
        if uses:
            out.remark(f"not used beside the station: {message}; list each under 'instruments' to use both")
    elif uses:
        if poses is None:
            out.remark(f"not used without poses: {message}")
            return
        out.add({"measurements": uses[0] if len(uses) == 1 else uses}, message)
        if body is not None and len(found.bodies) > 1:
            out.add({"body": body}, "the one that was measured")
