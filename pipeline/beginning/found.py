"""What lies in a folder: every file and image folder by what it holds, told by its content rather than its name."""

import csv
import io
import re
from dataclasses import dataclass, field
from pathlib import Path

from robcal.errors import InvalidInput, RobcalError
from robcal.files.camera_import import foreign_camera
from robcal.files.images import SUFFIXES as IMAGE_SUFFIXES
from robcal.files.images import natural_key
from robcal.files.joint_logs import is_joint_log, read_controller_log
from robcal.files.storage import read_bytes
from robcal.files.yaml_io import read_yaml

MOST_FILES, DEEPEST = 50_000, 4
MAX_BYTES = 400_000_000
SEPARATORS = (",", ";", "\t", "|")

HEADINGS: dict[str, str] = {
    "pose": r"(pose|point|name|id|nr\.?|no\.?|index|label)",
    "target": r"(target|marker|ball|prism|smr)( ?(id|nr\.?|no\.?))?",
    **{f"{axis}_mm": rf"(pos[_ ]?)?{axis}([ _]?[\[(]?mm[\])]?)?" for axis in "xyz"},
    **{f"{axis}_m": rf"(pos[_ ]?)?{axis}[ _]?[\[(]?m[\])]?" for axis in "xyz"},
    **{n: rf"{n}|{o}" for n, o in zip(("qw", "qx", "qy", "qz"), ("q0", "q1", "q2", "q3"), strict=True)},
    **{f"r{axis}_deg": rf"r{axis}([ _]?[\[(]?(deg|°)[\])]?)?" for axis in "xyz"},
    **{f"r{axis}_rad": rf"r{axis}[ _]?[\[(]?rad[\])]?" for axis in "xyz"},
    **{f"{a}_deg": rf"{a}([ _]?[\[(]?(deg|°)[\])]?)?" for a in "abc"},
    **{f"{n}_deg": rf"{n}([ _]?[\[(]?(deg|°)[\])]?)?" for n in ("roll", "pitch", "yaw")},
    "sigma_mm": r"(sigma|uncertainty|u)([ _]?[\[(]?mm[\])]?)?",
    "time_s": r"(time|t|timestamp)([ _]?[\[(]?s[\])]?)?",
}
"""What other programs call our columns."""
JOINT = re.compile(r"(?:q|a|j|ax|axis|joint)[ _.]?(?P<k>[1-9])(?:[ _]?[\[(]?(?P<unit>deg|rad|°|mm|m)?[\])]?)?")


@dataclass(frozen=True)
class TableFound:
    """A table: what it holds, and how to read it where that is not as our own.

    Attributes
    ----------
    kind : 'poses', 'frames', 'points', 'distances', 'sensor_points', 'marks', 'dh' or '' (unknown).
    names : of poses or images, in order. extra : values of the column ``payload``.
    use : entries of a column map, empty for a table of our own.
    """

    path: Path
    kind: str
    names: tuple[str, ...] = ()
    payloads: tuple[str, ...] = ()
    use: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Found:
    """What lies in a folder; paths absolute, in natural order."""

    folder: Path
    images: dict[Path, tuple[str, ...]]
    robots: tuple[Path, ...]
    bodies: tuple[Path, ...]
    cameras: tuple[Path, ...]
    tables: tuple[TableFound, ...]
    unknown: tuple[Path, ...]

    def of(self, *kinds: str) -> list[TableFound]:
        """Tables of some kinds."""
        return [table for table in self.tables if table.kind in kinds]


def look_around(folder: Path) -> Found:
    """Everything of a kind that a campaign can use, in a folder and those inside it.

    Raises
    ------
    InvalidInput : no such folder, or far too many files.
    """
    if not folder.is_dir():
        raise InvalidInput(f"{folder}: no such folder: name the folder of the recordings")
    images: dict[Path, list[str]] = {}
    kinds: dict[str, list[Path]] = {"robot": [], "body": [], "camera": [], "": []}
    tables: list[TableFound] = []
    for path in _files(folder):
        if path.suffix.lower() in IMAGE_SUFFIXES:
            images.setdefault(path.parent, []).append(path.name)
            continue
        try:
            table = _table(path)
            if table is not None:
                tables.append(table)
                continue
            kinds[_kind(path)].append(path)
        except RobcalError:
            kinds[""].append(path)
    return Found(
        folder,
        {where: tuple(sorted(names, key=natural_key)) for where, names in images.items()},
        (*kinds["robot"], *(t.path for t in tables if t.kind == "dh")),
        tuple(kinds["body"]),
        tuple(kinds["camera"]),
        tuple(tables),
        tuple(kinds[""]),
    )


def _files(folder: Path) -> list[Path]:
    found: list[Path] = []
    for path in sorted(folder.rglob("*"), key=lambda p: natural_key(str(p))):
        parts = path.relative_to(folder).parts
        if len(parts) > DEEPEST or any(p.startswith(".") for p in parts) or "runs" in parts or not path.is_file():
            continue
        if not path.resolve().is_relative_to(folder.resolve()):
            continue  # a link out of the folder
        found.append(path)
        if len(found) > MOST_FILES:
            raise InvalidInput(f"{folder}: more than {MOST_FILES} files: name the folder of one campaign")
    return found


def _kind(path: Path) -> str:
    """'robot', 'body', 'camera' or ''."""
    suffix = path.suffix.lower()
    if suffix in (".urdf", ".xacro"):
        return "robot"
    if suffix == ".xml":
        head = read_bytes(path, MAX_BYTES)[:2000].decode("utf-8", errors="replace")
        return "robot" if "<robot" in head else "camera" if foreign_camera(path) is not None else ""
    if suffix not in (".yaml", ".yml"):
        return ""
    try:
        data = read_yaml(path).data
    except InvalidInput:
        return "camera" if foreign_camera(path) is not None else ""
    stated = str(data.get("format", ""))
    for kind in ("robot", "body", "camera"):
        if stated.startswith(f"robcal/{kind}-"):
            return kind
    if "format" not in data and isinstance(data.get("kinematics"), dict):
        return "robot"
    return "camera" if "format" not in data and foreign_camera(path) is not None else ""


def _table(path: Path) -> TableFound | None:
    if path.suffix.lower() not in (".csv", ".txt", ".tsv", ".dat", ".src", ".mod", ".script", ".log"):
        return None
    if is_joint_log(path):
        return TableFound(path, "poses", read_controller_log(path).columns["pose"])
    raw = read_bytes(path, MAX_BYTES)
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InvalidInput(f"{path}: is UTF-16 text: save it as 'CSV UTF-8'")
    text = raw.decode("utf-8-sig", errors="replace")
    lines = [line for line in text.splitlines()[:50] if line.strip()]
    if not lines:
        return None
    sep, skip = _separator(text.splitlines()[:50])
    rows = list(csv.reader(io.StringIO("\n".join(text.splitlines()[skip:])), delimiter=sep))
    rows = [[cell.strip() for cell in row] for row in rows if any(cell.strip() for cell in row)]
    if len(rows) < 2 or len(rows[0]) < 2:
        return None
    use: dict[str, object] = {"skip_rows": skip} if skip else {}
    if sep != ",":
        use["sep"] = "tab" if sep == "\t" else sep
        if any(re.fullmatch(r"-?\d+,\d+", cell) for row in rows[1:20] for cell in row):
            use["decimal"] = ","
    columns = _columns(rows[0])
    foreign = {own: given for own, given in columns.items() if own != given}
    if foreign:
        use["columns"] = foreign
    kind, orientation = _kind_of_table(set(columns) | set(rows[0]), path)
    if orientation:
        use["orientation"] = orientation
    body = [row for row in rows[1:] if len(row) == len(rows[0])]

    def column(name: str) -> tuple[str, ...]:
        heading = columns.get(name, name)
        return tuple(row[rows[0].index(heading)] for row in body) if heading in rows[0] else ()

    names = column("image" if kind == "marks" else "pose")
    return TableFound(path, kind, tuple(dict.fromkeys(names)), tuple(dict.fromkeys(column("payload"))), use)


def _separator(lines: list[str]) -> tuple[str, int]:
    """Separator, and the lines in front of the headings: those with fewer columns than most lines have."""
    best = max(SEPARATORS, key=lambda mark: sum(line.count(mark) for line in lines if mark != "," or ";" not in line))
    counts = [line.count(best) for line in lines]
    typical = max(set(counts), key=lambda n: (n > 0, counts.count(n)))
    return best, next((k for k, n in enumerate(counts) if n == typical), 0)


def _columns(headings: list[str]) -> dict[str, str]:
    """Own name -> heading, as far as they can be guessed."""
    found: dict[str, str] = {}
    for heading in headings:
        lowered = heading.lower()
        joint = JOINT.fullmatch(lowered)
        quaternion = "q0" in map(str.lower, headings)
        if joint and not (quaternion and lowered.startswith("q")):
            unit = {"°": "deg", None: "deg", "": "deg"}.get(joint["unit"], joint["unit"])
            found.setdefault(f"q{joint['k']}_{unit}", heading)
            continue
        own = next((name for name, pattern in HEADINGS.items() if re.fullmatch(pattern, lowered)), None)
        found.setdefault(own or heading, heading)
    return found


def _kind_of_table(names: set[str], path: Path) -> tuple[str, str]:
    """Kind of a table and the orientation of its frames ('' for roll, pitch, yaw)."""
    if {"a_mm", "alpha_deg", "d_mm", "theta_deg"} <= names:
        return "dh", ""
    if {"image", "target", "x_px", "y_px"} <= names:
        return "marks", ""
    if "pose" not in names:
        return "", ""
    if any(re.fullmatch(r"q1_(deg|rad|mm|m)", name) for name in names) and "target" not in names:
        return "poses", ""
    if "distance_mm" in names:
        return "distances", ""
    if not ({"x_mm", "y_mm", "z_mm"} <= names or {"x_m", "y_m", "z_m"} <= names):
        return "", ""
    if "target" in names:
        sensor = names & {"cycle", "time_s"} or "sensor" in path.stem.lower()
        return ("sensor_points" if sensor else "points"), ""
    if {"roll_deg", "pitch_deg", "yaw_deg"} <= names:
        return "frames", ""
    for orientation, needed in (
        ("quaternion", {"qw", "qx", "qy", "qz"}),
        ("abc", {"a_deg", "b_deg", "c_deg"}),
        ("rotation_vector", {"rx_deg", "ry_deg", "rz_deg"}),
        ("rotation_vector", {"rx_rad", "ry_rad", "rz_rad"}),
    ):
        if needed <= names:
            return "frames", orientation
    return "", ""
