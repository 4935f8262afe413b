"""Compensated poses as programs of robot controllers whose formats are public: KUKA KRL, ABB RAPID, URScript.

Joint values go out as they are commanded; corrected Cartesian targets ``F*`` in the controller's own way of writing
orientations: KRL's A, B, C are yaw, pitch, roll (KUKA System Software, operating and programming instructions), RAPID's
are quaternions with the scalar first (ABB, Technical reference: RAPID overview, ``orient``), URScript's are rotation
vectors in metres and radians (Universal Robots, script manual).

Weakness: speeds are left at a slow default; sliding joints (a track) become the external axis in KRL and RAPID,
URScript has none.
"""

import re
import unicodedata
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from robcal.errors import InvalidInput
from robcal.robot.chain import Chain, chain_of, check_joint_angles
from robcal.robot.inverse import check_frames
from robcal.robot.model import RobotModel
from robcal.transforms import Array, log_so3, xyzrpy_from_frame

_NO_EXTERNAL = "9E9"
_WORDS = """
alias and axis b_and b_exor b_not b_or backward bas bool brake break c_dis c_ori c_ptp c_vel case char circ
circ_rel connect const continue decl def default defdat deffct delay distance div dnum do e6axis e6pos elif else
elseif end enddat endfct endfor endfunc endif endloop endmodule endproc endrecord endswitch endtest endtrap
endwhile enum error exit exor false for frame func global goto halt if import inf int interrupt is join
jointtarget kill lin lin_rel local loop main mod module moveabsj movec movej movel movep nan none nostepin not
noview num off on or pass pers popup pos pose proc ptp ptp_rel public raise readonly real record repeat resume
retry return robtarget run sec servoj set_tcp signal sleep speeddata speedj speedl step stopj stopl string struc
switch sync sysmodule task test textmsg then thread to tool0 tooldata trap trigger true trynext undo until var
viewonly wait when while with wobj0 wobjdata xor zonedata
"""
RESERVED = frozenset(_WORDS.split())
"""Words of KRL, RAPID or URScript, and the routine of a RAPID module: no names of programs (in lower case)."""


def joint_program(model: RobotModel, q: ArrayLike, dialect: str, name: str = "robcal_poses") -> str:
    """Program that drives through joint values (n, N), stopping at each.

    Raises
    ------
    InvalidInput : unknown dialect, a name that is no identifier, values that are not finite, or more joints than the
        controller's format has room for.
    """
    return _program(_joint_lines(model, q, dialect), dialect, name)


def _joint_lines(model: RobotModel, q: ArrayLike, dialect: str) -> list[str]:
    chain = chain_of(model)
    values = check_joint_angles(chain, q)
    rotary = np.flatnonzero(~chain.prismatic)
    external = np.flatnonzero(chain.prismatic)
    if len(rotary) > 6 or len(external) > 6:
        raise InvalidInput(f"{dialect} has six rotary and six external axes at most, the robot {chain.n_joints} joints")
    lines = {"krl": _krl_joints, "rapid": _rapid_joints, "urscript": _urscript_joints}
    return _pick(lines, dialect)(chain, values, rotary, external)


def frame_program(
    frames: ArrayLike,
    dialect: str,
    name: str = "robcal_targets",
    flange_T_tool: Array | None = None,
    *,
    model: RobotModel | None = None,
    q: ArrayLike | None = None,
) -> str:
    """Program that drives to corrected Cartesian targets (n, 4, 4) in base coordinates (``Compensation.F_star``).

    Parameters
    ----------
    flange_T_tool : (4, 4) the calibrated tool, identity if not given; the program makes it the active one, with targets
        in base coordinates. RAPID's tool has a load of 1 kg, to be replaced by the real one.
    model, q : the robot and the joint values (n, N) of the targets: the first one is then driven to by joint values, so
        that the configuration does not depend on where the robot happens to stand, and sliding joints are external
        axes of the targets. Without them the configuration is the present one's.

    Raises
    ------
    InvalidInput : unknown dialect, a name that is no identifier, frames that are not rigid, sliding joints in URScript.
    """
    T = check_frames(frames)
    tool = np.eye(4) if flange_T_tool is None else check_frames(np.asarray(flange_T_tool)[None])[0]
    lines = {"krl": _krl_frames, "rapid": _rapid_frames, "urscript": _urscript_frames}
    track = np.zeros((len(T), 0))
    first: list[str] = []
    if model is not None and q is not None:
        chain = chain_of(model)
        values = check_joint_angles(chain, q)
        track = 1e3 * values[:, chain.prismatic]
        first = _joint_lines(model, values[:1], dialect)
    moves = _pick(lines, dialect)(T, track)
    return _program(
        [*_tool_lines(tool, dialect, track.shape[1]), *(first or moves[:1]), *moves[1:]], dialect, name, tool
    )


def _tool_lines(tool: Array, dialect: str, n_track: int) -> list[str]:
    """Statements that make the calibrated tool and the base's coordinates the active ones."""
    if dialect == "krl":
        # with a track, base coordinates are those in which the track stands still
        return [f"$TOOL = {{{_krl_place(tool)}}}", f"$BASE = {'$NULLFRAME' if n_track else '$ROBROOT'}"]
    if dialect == "urscript":
        return [f"set_tcp(p[{', '.join(_numbers(_urscript_six(tool), 9))}])"]
    return []


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


def _krl_place(T: Array) -> str:
    x, y, z, roll, pitch, yaw = xyzrpy_from_frame(T)
    place = _numbers(1e3 * np.array([x, y, z]), 4) + _numbers(np.rad2deg([yaw, pitch, roll]), 6)
    return ", ".join(f"{k} {v}" for k, v in zip("XYZABC", place, strict=True))


def _krl_frames(T: Array, track: Array) -> list[str]:
    external = ["".join(f", E{k + 1} {v}" for k, v in enumerate(_numbers(row, 4))) for row in track]
    return [f"PTP {{E6POS: {_krl_place(target)}{more}}}" for target, more in zip(T, external, strict=True)]


def _rapid_joints(chain: Chain, q: Array, rotary: Array, external: Array) -> list[str]:
    out = []
    for row in q:
        robot = _numbers(np.rad2deg(row[rotary]), 6)
        robot += ["0"] * (6 - len(robot))
        track = _numbers(1e3 * row[external], 4)
        track += [_NO_EXTERNAL] * (6 - len(track))
        out.append(f"MoveAbsJ [[{','.join(robot)}],[{','.join(track)}]],v100,fine,tool0;")
    return out


def _rapid_frames(T: Array, track: Array) -> list[str]:
    external = [",".join([*_numbers(row, 4), *[_NO_EXTERNAL] * (6 - len(row))]) for row in track]
    return [
        f"MoveJ [{_rapid_place(target)},[0,0,0,0],[{more}]],v100,fine,tool_robcal\\WObj:=wobj0;"
        for target, more in zip(T, external, strict=True)
    ]


def _rapid_place(T: Array) -> str:
    return f"[{','.join(_numbers(1e3 * T[:3, 3], 4))}],[{','.join(_numbers(quaternion(T[:3, :3]), 9))}]"


def _urscript_joints(chain: Chain, q: Array, rotary: Array, external: Array) -> list[str]:
    if len(external):
        raise InvalidInput("urscript has no sliding joints; drive the track separately")
    return [f"movej([{', '.join(_numbers(row, 9))}], a=0.5, v=0.3)" for row in q]


def _urscript_frames(T: Array, track: Array) -> list[str]:
    if track.shape[1]:
        raise InvalidInput("urscript has no sliding joints; drive the track separately")
    return [f"movej(p[{', '.join(_numbers(_urscript_six(target), 9))}], a=0.5, v=0.3)" for target in T]


def _urscript_six(T: Array) -> Array:
    return np.concatenate([T[:3, 3], log_so3(T[:3, :3])])


def _program(lines: list[str], dialect: str, name: str, tool: Array | None = None) -> str:
    if not re.fullmatch(r"[A-Za-z]\w{0,23}", name, re.ASCII):
        raise InvalidInput(
            f"'{name}' is no program name: a letter, then up to 23 letters, digits or underscores (ASCII)"
        )
    if name.lower() in RESERVED:
        raise InvalidInput(f"'{name}' is a word of a controller's language and no program name: choose another")
    declared = ""
    if tool is not None:
        declared = f"  PERS tooldata tool_robcal := [TRUE,[{_rapid_place(tool)}],[1,[0,0,1],[1,0,0,0],0,0,0]];\n"
    head, foot = {
        "krl": (f"DEF {name}()\nBAS(#INITMOV, 0)", "END"),
        # without monitoring, the configuration nearest to the present one is taken
        "rapid": (f"MODULE {name}\n{declared}  PROC main()\n    ConfJ \\Off;", "  ENDPROC\nENDMODULE"),
        "urscript": (f"def {name}():", "end"),
    }[dialect]
    indent = {"krl": "", "rapid": "    ", "urscript": "  "}[dialect]
    return "\n".join([head, *(indent + line for line in lines), foot, ""])


def program_name(text: str) -> str:
    """A name that every controller takes, as near to the text as possible (umlauts lose their dots)."""
    plain = unicodedata.normalize("NFKD", text.replace("ß", "ss")).encode("ascii", "ignore").decode()
    word = re.sub(r"\W+", "_", plain)[:24]
    fits = re.match(r"[A-Za-z]", word) and word.lower() not in RESERVED
    return word if fits else f"robcal_{word}"[:24]
