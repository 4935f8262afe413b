"""A second, much smaller reader of controllers' programs: what each motion commands, in order of the text.

Written apart from the library and by other means (regular expressions, one pass): it knows literals, names, constant
offsets, and the last tool and base that the text sets. Frames in m, angles in rad.
"""

import re
from dataclasses import dataclass

import numpy as np

from fixtures.rigid import Array, frame, rotation_from_vector, turn_about

N = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
X, Y, Z = 0, 1, 2


@dataclass(frozen=True)
class Motion:
    """Target as frame or joint values (rad), with tool and base."""

    T: Array | None
    q: Array | None
    tool: Array
    base: Array


def from_zyx(xyz: list[float], yaw: float, pitch: float, roll: float) -> Array:
    R = turn_about(Z, np.radians(yaw)) @ turn_about(Y, np.radians(pitch)) @ turn_about(X, np.radians(roll))
    return frame(R, np.array(xyz) / 1e3)


def from_quaternion(xyz: list[float], q: list[float]) -> Array:
    w, x, y, z = np.array(q) / np.linalg.norm(q)
    R = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return frame(np.array(R), np.array(xyz) / 1e3)


def from_vector(six: list[float]) -> Array:
    return frame(rotation_from_vector(np.array(six[3:])), np.array(six[:3]))


def numbers(text: str) -> list[float]:
    return [float(v) for v in re.findall(rf"(?<![\w.]){N}", text)]


def krl(src: str, dat: str = "", tools: dict | None = None, bases: dict | None = None) -> list[Motion]:
    numbered = {"TOOL": {0: np.eye(4), **(tools or {})}, "BASE": {0: np.eye(4), **(bases or {})}}
    lines = [re.sub(r";.*", "", line) for line in f"{dat}\n{src}".splitlines()]
    named: dict[str, str] = {}
    fdat: dict[str, tuple[int, int]] = {}
    for line in lines:
        for name, body in re.findall(r"(\w+(?:\[\d+\])?)\s*=\s*(\{[^}]*\})", line):
            named[name.upper()] = body
            if found := re.search(r"TOOL_NO (\d+).*BASE_NO (\d+)", body):
                fdat[name.upper()] = (int(found[1]), int(found[2]))

        if copy := re.match(r"\s*(\w+)\s*=\s*(\w+)\s*$", line):
            named[copy[1].upper()] = copy[2]

    def place(text: str) -> tuple[Array | None, Array | None]:
        T = np.eye(4)
        for part in re.split(r":(?=\s*[\w{])(?![^{]*\})", text):
            body = part.strip()
            while "{" not in body:
                body = named[re.sub(r"\[I\]", "[1]", body.upper())]
            values = {k.upper(): float(v) for k, v in re.findall(rf"\b([A-Z]\d?) ({N})", body, re.IGNORECASE)}
            if "A1" in values:
                return None, np.radians([values[f"A{k}"] for k in range(1, 7)])
            x, y, z, a, b, c = (values.get(k, 0.0) for k in "XYZABC")
            T = T @ from_zyx([x, y, z], a, b, c)
        return T, None

    state = {"TOOL": np.eye(4), "BASE": np.eye(4)}
    found: list[Motion] = []
    for line in re.sub(r";.*", "", src).replace("\r", "").splitlines():
        code = line.strip()
        if setting := re.match(r"\$(TOOL|BASE)\s*=\s*(.*)", code):
            what, value = setting.groups()
            if number := re.match(r"\w+_DATA\[(\d+)\]", value):
                state[what] = numbered[what][int(number[1])]
            else:
                state[what] = np.eye(4) if value.startswith("$") else place(value)[0]
        elif number := re.match(r"BAS\s*\(\s*#(TOOL|BASE)\s*,\s*(\d+)", code):
            state[number[1]] = numbered[number[1]][int(number[2])]
        elif act := re.match(r"FDAT_ACT\s*=\s*(\w+)", code):
            state = {w: numbered[w][fdat[act[1].upper()][k]] for k, w in enumerate(("TOOL", "BASE"))}
        elif move := re.match(r"S?(PTP|LIN|PL|CIRC)\s+(?!_)(.*)", code):
            own = dict(state)
            for what, name in re.findall(r"\$(TOOL|BASE)\s*=\s*S(?:TOOL2|BASE)\((\w+)", code):
                own[what] = numbered[what][fdat[name.upper()][what == "BASE"]]
            text = re.sub(r"\s+(C_\w+|WITH .*)", "", move[2])
            for part in re.split(r",(?![^{]*\})", text) if move[1] == "CIRC" else [text]:
                if not part.strip().startswith("$"):
                    found.append(Motion(*place(part), own["TOOL"], own["BASE"]))
    return found


def rapid(text: str, tools: dict | None = None, bases: dict | None = None) -> list[Motion]:
    code = re.sub(r'!.*|"[^"\n]*"', "", text).replace("\r", "")
    frames = {"tool0": np.eye(4), "wobj0": np.eye(4), **(tools or {}), **(bases or {})}
    for kind, name, body in re.findall(r"(tooldata|wobjdata)\s+(\w+)\s*:=\s*([^;]*);", code):
        v = numbers(body)
        frames[name] = from_quaternion(v[:3], v[3:7])
        if kind == "wobjdata":
            frames[name] = frames[name] @ from_quaternion(v[7:10], v[10:14])
    named: dict[str, list[str]] = {}
    for name, body in re.findall(r"(?:robtarget|jointtarget)\s+(\w+)(?:\{\d+\})?\s*:=\s*([^;]*);", code):
        parts = re.findall(r"\[\[[^\]]*\](?:,\s*\[[^\]]*\])+\]", body)
        named[name] = parts
    for name, other in re.findall(r"(\w+)\s*:=\s*(p\d+);", code):
        named[name] = named[other]
    found = []
    for name, arguments in re.findall(r"\b((?:Move(?!Ext)|Trigg(?!IO)|Search|Arc)\w*)\s+([^;]*);", code):
        parts = re.split(r",(?![^\[\(]*[\]\)])", re.sub(r"\[[^;]*?\]\]", lambda m: m[0].replace(",", "~"), arguments))
        parts = [p.replace("~", ",").strip() for p in parts if not p.strip().startswith("\\")]
        wobj = re.search(r"\\WObj\s*:=\s*(\w+)", arguments, re.IGNORECASE)
        base = frames[wobj[1]] if wobj else np.eye(4)
        first = 2 if name.startswith("Search") else 0
        count = 2 if re.match(r"\w+?C(?:$|[A-Z])", name) else 1
        words = [re.split(r"\\(?![^()]*\))", p)[0].strip() for p in parts]
        tool = next(frames[w] for w in reversed(words) if w in frames)
        for target in words[first : first + count]:
            for body in _robtargets(target, named):
                v = numbers(body)
                if re.match(r"\[\[[^\]]*\],\s*\[[^\]]*\]\]$", body):
                    found.append(Motion(None, np.radians(v[:6]), tool, base))
                else:
                    T = from_quaternion(v[:3], v[3:7])
                    found.append(Motion(_moved(T, target), None, tool, base))
    return found


def _robtargets(target: str, named: dict[str, list[str]]) -> list[str]:
    name = re.sub(r"^(Offs|RelTool)\s*\(\s*(\w+).*", r"\2", target)
    if name.startswith("["):
        return [name]
    if element := re.match(r"(\w+)\{(\d+)\}", name):
        return [named[element[1]][int(element[2]) - 1]]
    if element := re.match(r"(\w+)\{", name):
        return named[element[1]][:1]
    return named[re.sub(r"\{.*", "", name)]


def _moved(T: Array, target: str) -> Array:
    if target.startswith("Offs"):
        shift = numbers(target.split(",", 1)[1].replace("2*15", "30"))
        return frame(T[:3, :3], T[:3, 3] + np.array(shift) / 1e3)
    if target.startswith("RelTool"):
        v = numbers(target.split(",", 1)[1])
        turned = T @ frame(np.eye(3), np.array(v[:3]) / 1e3)
        for axis, angle in re.findall(rf"\\R([xyz])\s*:=\s*({N})", target):
            turned = turned @ frame(turn_about({"x": X, "y": Y, "z": Z}[axis], np.radians(float(angle))), np.zeros(3))
        return turned
    return T


def urscript(text: str, tool: Array) -> list[Motion]:
    settings = {tuple(numbers(s)) for s in re.findall(r"set_tcp\((.*)\)", text)}
    if len(settings) == 1:  # a function may stand before the one tool that is set
        tool = from_vector(list(settings.pop()))
    named: dict[str, str] = {}
    found = []
    for line in re.sub(r"#.*", "", text).replace("\r", "").splitlines():
        code = re.sub(r"d2r\(([^)]*)\)", lambda m: repr(float(np.radians(float(m[1])))), line.strip())
        if assigned := re.match(r"(?:global\s+|local\s+)?(\w+)\s*=\s*(.*)", code):
            for k, part in enumerate(re.findall(r"p?\[[^\[\]]*\]", assigned[2])):
                named[f"{assigned[1]}[{k}]"] = part
            if "[" in assigned[2]:
                named[assigned[1]] = assigned[2]
        elif setting := re.match(r"set_tcp\((.*)\)", code):
            tool = from_vector(numbers(setting[1]))
        elif move := re.match(r"(movej|movel|movep|movec|servoj|servoc)\((.*)\)", code):
            texts = re.findall(r"pose_trans\(.*?\]\s*\)|p?\[[^\]]*\]|\b(?!pose_trans)\w+(?:\[\w+\])?", move[2])
            texts = [re.sub(r"\[i\]", "[0]", t) for t in texts]
            targets = [named.get(t, t) for t in texts if t in named or "[" in t or t.startswith("pose_trans")]
            for target in targets[: 2 if move[1] == "movec" else 1]:
                parts = [from_vector(numbers(p)) for p in re.findall(r"p\[([^\]]*)\]", target)]
                if target.startswith("pose_trans"):
                    names = [named[n] for n in re.findall(r"\b\w+\b(?![\[(])", target) if n in named]
                    parts = [from_vector(numbers(n)) for n in names] + parts
                T = parts[0] @ parts[1] if len(parts) > 1 else parts[0] if parts else None
                found.append(Motion(T, None if parts else np.array(numbers(target)), tool, np.eye(4)))
    return found


def fanuc(text: str, tools: dict | None = None, bases: dict | None = None) -> list[Motion]:
    tools, bases = {0: np.eye(4), **(tools or {})}, {0: np.eye(4), **(bases or {})}
    found = []
    for body in re.findall(r"^P\[\d+[^\]]*\]\s*\{(.*?)\};", text, re.MULTILINE | re.DOTALL):
        own = re.split(r"GP2", body)[0]
        frames = re.search(r"UF\s*:\s*(\d+),\s*UT\s*:\s*(\d+)", own)
        values = {k: float(v) for k, v in re.findall(rf"\b([XYZWPR]|J\d)\s*=\s*({N})", own)}
        tool, base = tools[int(frames[2])], bases[int(frames[1])]
        if "J1" in values:
            found.append(Motion(None, np.radians([values[f"J{k}"] for k in range(1, 7)]), tool, base))
        else:
            T = from_zyx([values[k] for k in "XYZ"], values["R"], values["P"], values["W"])
            found.append(Motion(T, None, tool, base))
    return found


PARSERS = {"krl": krl, "rapid": rapid, "urscript": urscript, "fanuc": fanuc}
