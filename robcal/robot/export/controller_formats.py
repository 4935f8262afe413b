"""Compensated poses as programs of robot controllers whose formats are public: KUKA KRL, ABB RAPID, URScript.

Joint values go out as they are commanded; corrected Cartesian targets ``F*`` in the controller's own way of writing
orientations: KRL's A, B, C are yaw, pitch, roll (KUKA System Software, operating and programming instructions), RAPID's
are quaternions with the scalar first (ABB, Technical reference: RAPID overview, ``orient``), URScript's are rotation
vectors in metres and radians (Universal Robots, script manual).

Weakness: speeds are left at a slow default; sliding joints (a track) become the external axis in KRL and RAPID,
URScript has none.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from robcal.errors import InvalidInput
from robcal.robot.chain import Chain, chain_of, check_joint_angles
from robcal.robot.inverse import check_frames
from robcal.robot.model import RobotModel
from robcal.transforms import Array, log_so3, xyzrpy_from_frame

_NO_EXTERNAL = "9E9"


def joint_program(model: RobotModel, q: ArrayLike, dialect: str, name: str = "robcal_poses") -> str:
    """Program that drives through joint values (n, N), stopping at each.

    Raises
    ------
    InvalidInput : unknown dialect, a name that is no identifier, values that are not finite, or more joints than the
        controller's format has room for.
    """
    chain = chain_of(model)
    values = check_joint_angles(chain, q)
    rotary = np.flatnonzero(~chain.prismatic)
    external = np.flatnonzero(chain.prismatic)
    if len(rotary) > 6 or len(external) > 6:
        raise InvalidInput(f"{dialect} has six rotary and six external axes at most, the robot {chain.n_joints} joints")
    lines = {"krl": _krl_joints, "rapid": _rapid_joints, "urscript": _urscript_joints}
    return _program(_pick(lines, dialect)(chain, values, rotary, external), dialect, name)


def frame_program(
    frames: ArrayLike, dialect: str, name: str = "robcal_targets", flange_T_tool: Array | None = None
) -> str:
    """Program that drives to corrected Cartesian targets (n, 4, 4) in base coordinates (``Compensation.F_star``).

    The controller's tool and base must be those of the calibration; the configuration is the current one's. RAPID
    modules declare the tool ``flange_T_tool`` (4, 4), identity if not given, with a load of 1 kg to be replaced by the
    real one.

    Raises
    ------
    InvalidInput : unknown dialect, a name that is no identifier, frames that are not rigid.
    """
    T = check_frames(frames)
    lines = {"krl": _krl_frames, "rapid": _rapid_frames, "urscript": _urscript_frames}
    declared = ""
    if dialect == "rapid":
        F = np.eye(4) if flange_T_tool is None else check_frames(np.asarray(flange_T_tool)[None])[0]
        place = f"[{','.join(_numbers(1e3 * F[:3, 3], 4))}],[{','.join(_numbers(quaternion(F[:3, :3]), 9))}]"
        declared = f"  PERS tooldata tool_robcal := [TRUE,[{place}],[1,[0,0,1],[1,0,0,0],0,0,0]];\n"
    return _program(_pick(lines, dialect)(T), dialect, name, declared)


def quaternion(R: Array) -> Array:
    """Unit quaternions (..., 4), scalar first and not negative, of rotation matrices."""
    w = log_so3(R)
    angle = np.linalg.norm(w, axis=-1, keepdims=True)
    half = 0.5 * np.sinc(angle / (2.0 * np.pi))  # sin(angle / 2) / angle
    return np.concatenate([np.cos(0.5 * angle), half * w], axis=-1)


def _pick(table: dict[str, Callable[..., list[str]]], dialect: str) -> Callable[..., list[str]]:
    if dialect not in table:
        raise InvalidInput(f"controller format must be krl, rapid or urscript, not '{dialect}'")
    return table[dialect]


def _numbers(values: Array, digits: int) -> list[str]:
    return [f"{float(v) + 0.0:.{digits}f}" for v in values]


def _krl_joints(chain: Chain, q: Array, rotary: Array, external: Array) -> list[str]:
    out = []
    for row in q:
        parts = [f"A{k + 1} {v}" for k, v in enumerate(_numbers(np.rad2deg(row[rotary]), 6))]
        parts += [f"E{k + 1} {v}" for k, v in enumerate(_numbers(1e3 * row[external], 4))]
        out.append("PTP {E6AXIS: " + ", ".join(parts) + "}")
    return out


def _krl_frames(T: Array) -> list[str]:
    out = []
    for x, y, z, roll, pitch, yaw in xyzrpy_from_frame(T):
        place = _numbers(1e3 * np.array([x, y, z]), 4) + _numbers(np.rad2deg([yaw, pitch, roll]), 6)
        out.append("PTP {E6POS: " + ", ".join(f"{k} {v}" for k, v in zip("XYZABC", place, strict=True)) + "}")
    return out


def _rapid_joints(chain: Chain, q: Array, rotary: Array, external: Array) -> list[str]:
    out = []
    for row in q:
        robot = _numbers(np.rad2deg(row[rotary]), 6)
        robot += ["0"] * (6 - len(robot))
        track = _numbers(1e3 * row[external], 4)
        track += [_NO_EXTERNAL] * (6 - len(track))
        out.append(f"MoveAbsJ [[{','.join(robot)}],[{','.join(track)}]],v100,fine,tool0;")
    return out


def _rapid_frames(T: Array) -> list[str]:
    none = ",".join([_NO_EXTERNAL] * 6)
    return [
        f"MoveJ [[{','.join(_numbers(1e3 * t, 4))}],[{','.join(_numbers(q, 9))}],[0,0,0,0],[{none}]],v100,fine,"
        "tool_robcal\\WObj:=wobj0;"
        for t, q in zip(T[:, :3, 3], quaternion(T[:, :3, :3]), strict=True)
    ]


def _urscript_joints(chain: Chain, q: Array, rotary: Array, external: Array) -> list[str]:
    if len(external):
        raise InvalidInput("urscript has no sliding joints; drive the track separately")
    return [f"movej([{', '.join(_numbers(row, 9))}], a=0.5, v=0.3)" for row in q]


def _urscript_frames(T: Array) -> list[str]:
    six = np.concatenate([T[:, :3, 3], log_so3(T[:, :3, :3])], axis=1)
    return [f"movej(p[{', '.join(_numbers(row, 9))}], a=0.5, v=0.3)" for row in six]


def _program(lines: list[str], dialect: str, name: str, declared: str = "") -> str:
    if not re.fullmatch(r"[A-Za-z]\w{0,23}", name):
        raise InvalidInput(f"'{name}' is no program name: a letter, then up to 23 letters, digits or underscores")
    head, foot = {
        "krl": (f"DEF {name}()\nBAS(#INITMOV, 0)", "END"),
        # without monitoring, the configuration nearest to the present one is taken
        "rapid": (f"MODULE {name}\n{declared}  PROC main()\n    ConfJ \\Off;", "  ENDPROC\nENDMODULE"),
        "urscript": (f"def {name}():", "end"),
    }[dialect]
    indent = {"krl": "", "rapid": "    ", "urscript": "  "}[dialect]
    return "\n".join([head, *(indent + line for line in lines), foot, ""])
