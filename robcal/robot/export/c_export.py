"""A calibrated robot as C99 source for a controller: forward model and corrected commands.

The forward model is the kernel's graph with all identified numbers inserted (elasticities and extra terms included);
the payload enters at run time by mass and centre of gravity. The inverse is the nominal robot's, in closed form where
its joint lines allow one (:mod:`robcal.robot.structure`), Levenberg-Marquardt otherwise. Nothing is allocated; only
``math.h`` and ``string.h`` are included.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from robcal.errors import InvalidInput
from robcal.robot.chain import Chain, chain_of
from robcal.robot.compensation import FLIP, LARGEST_STEP, cell_frames
from robcal.robot.export import c_inverse_templates as ci
from robcal.robot.export import c_numeric_templates as cn
from robcal.robot.export import c_templates as c
from robcal.robot.export.c_command_templates import COMMANDS
from robcal.robot.export.c_expressions import array, function_body, number
from robcal.robot.inverse import carried_arm
from robcal.robot.inverse_analytic import perpendicular
from robcal.robot.inverse_numeric import NumericSettings, start_configurations
from robcal.robot.kernel import Kernel
from robcal.robot.kernel_graph import pose_graph
from robcal.robot.model import Payload, RobotModel
from robcal.robot.structure import SphericalWrist, Structure, find_structure
from robcal.transforms import Array, invert

_LOAD = "load"


@dataclass(frozen=True)
class CSource:
    """Exported source: names and texts of the two files, and the covariates in the order the functions expect."""

    header_name: str
    header: str
    source_name: str
    source: str
    covariates: tuple[str, ...]


def export_c(
    model: RobotModel, prefix: str | None = None, statics: str = "one_step", defaults: Mapping[str, float] | None = None
) -> CSource:
    """C99 header and source of a robot.

    Parameters
    ----------
    model : calibrated robot; ``world_T_base`` and ``flange_T_tool`` become constants.
    prefix : of all public names; default the robot's name in lower case.
    statics : 'one_step' or 'converged', as the model was identified.
    defaults : covariates that hold where a call does not know better (a temperature, say); zero where missing.

    Raises
    ------
    InvalidInput : a prefix that is no C name, or a term that has no counterpart in C.
    """
    name = prefix if prefix is not None else re.sub(r"\W+", "_", model.name.lower()).strip("_")
    if not re.fullmatch(r"[A-Za-z]\w*", name):
        raise InvalidInput(f"'{name}' cannot begin the names of C functions: give a prefix of letters and digits")
    kernel = Kernel(model, statics)
    body, covariates = _real_robot(model, statics)
    world_T_base, flange_T_tool = cell_frames(kernel)
    nominal = chain_of(model)
    chain = replace(nominal, home=nominal.home @ flange_T_tool)
    # a '*/' in a name must not end the comment
    title = re.sub(r"[^\w .,()+-]", "_", model.name)
    values = {
        "@P@": name,
        "@N@": str(chain.n_joints),
        "@TITLE@": title,
        "@COVARIATES@": str(len(covariates)),
        "@COVARIATE_SIZE@": str(max(1, len(covariates))),
        "@COVARIATE_NOTE@": f" /* {', '.join(covariates)} */" if covariates else "",
        "@PAYLOADS@": _payloads(kernel, name) + _defaults(covariates, defaults or {}, name),
    }
    parts = [
        f'/* {title} */\n#include <math.h>\n#include <string.h>\n\n#include "{name}.h"\n\n#define N {chain.n_joints}',
        _tables(chain, world_T_base),
        *_inverse_parts(chain),
        "\nstatic void real_robot(const double *q, const double *load, const double *covariate, double *T)\n{\n"
        + body
        + "\n}\n",
        COMMANDS,
    ]
    source = "\n".join(parts)
    for key, text in values.items():
        source = source.replace(key, text)
    header = c.HEADER
    for key in ("@PAYLOADS@", "@COVARIATE_NOTE@", "@COVARIATE_SIZE@", "@COVARIATES@", "@TITLE@", "@N@", "@P@"):
        header = header.replace(key, values[key])
    return CSource(f"{name}.h", header, f"{name}.c", source, covariates)


def _real_robot(model: RobotModel, statics: str) -> tuple[str, tuple[str, ...]]:
    """Body of world_T_tool(q, load, covariates), entries row by row, and the covariates' names."""
    kernel = Kernel(model, statics)
    numbers = dict(zip(kernel.names, kernel.theta0, strict=True))
    # the payload of the call: a load of zero nominal mass whose deviations are the arguments
    loaded = replace(
        model,
        payloads={_LOAD: Payload(0.0)},
        parameters={n: v for n, v in model.parameters.items() if not n.startswith("payload.")},
    )
    graph = pose_graph(loaded, statics, derivatives=False)
    theta, q, one_hot, covariates, W0, F0 = graph.inputs
    names = Kernel(loaded, statics).names
    load = ca.SX.sym("load", 4)
    arguments = {f"payload.{_LOAD}.{k}": load[i] for i, k in enumerate(("mass", "x", "y", "z"))}
    inserted = ca.vertcat(*(arguments[n] if n in arguments else ca.SX(float(numbers.get(n, 0.0))) for n in names))
    T = ca.substitute(
        [graph.world_T_tool],
        [theta, one_hot, W0, F0],
        [inserted, ca.SX(1.0), ca.SX(ca.DM(kernel.world_T_base[:3])), ca.SX(ca.DM(kernel.flange_T_tool[:3]))],
    )[0]
    function = ca.Function("real_robot", [q, load, covariates], [ca.densify(ca.reshape(T.T, 12, 1))], {"cse": True})
    return function_body(function, ("q", "load", "covariate"), ("T",)), graph.covariates


def _payloads(kernel: Kernel, prefix: str) -> str:
    lines = []
    for name, payload in kernel.model.payloads.items():
        at = kernel.index[f"payload.{name}.mass"]
        mass = payload.mass + kernel.theta0[at]
        cog = np.array(payload.cog) + kernel.theta0[at + 1 : at + 4]
        word = re.sub(r"\W", "_", name)
        lines.append(f"#define {prefix}_payload_{word} {{{number(mass)}, {array(cog)}}}")
    head = "\n/* Payloads of the campaign: initialisers of the structure above. */\n"
    return head + "\n".join(lines) + "\n" if lines else ""


def _defaults(covariates: tuple[str, ...], values: Mapping[str, float], prefix: str) -> str:
    """Initialiser of the conditions: no payload, covariates as at the first recorded pose."""
    numbers = array(np.array([values.get(name, 0.0) for name in covariates] or [0.0]))
    return (
        "\n/* Conditions where nothing better is known: no payload, the rest as at the first recorded pose. */\n"
        f"#define {prefix}_conditions_default {{{{0.0, {{0.0, 0.0, 0.0}}}}, {numbers}}}\n"
    )


def _tables(chain: Chain, world_T_base: Array) -> str:
    def rows(name: str, values: Array) -> str:
        return f"static const double {name}[N][3] = {{\n    " + ",\n    ".join(array(v) for v in values) + "};"

    def frame(name: str, T: Array) -> str:
        return f"static const double {name}[12] = {array(T[:3].ravel())};"

    big = 1e30
    flags = ", ".join("1" if p else "0" for p in chain.prismatic)
    return "\n".join(
        [
            "/* joint lines at zero position, positive sense of q */",
            rows("AXIS", chain.axes),
            rows("POINT", chain.points),
            f"static const int PRISMATIC[N] = {{{flags}}};",
            f"static const double LOWER[N] = {array(np.maximum(chain.lower, -big))};",
            f"static const double UPPER[N] = {array(np.minimum(chain.upper, big))};",
            frame("HOME", chain.home),
            frame("WORLD_T_BASE", world_T_base),
            frame("BASE_T_WORLD", invert(world_T_base)),
        ]
    )


def _inverse_parts(chain: Chain) -> list[str]:
    settings = NumericSettings()
    length = settings.weight(chain)[3]
    parts = [c.VECTORS, c.CHAIN, f"\n#define ROTATION_LENGTH {number(length)}"]
    parts.append(f"#define LARGEST_STEP {number(LARGEST_STEP)}\n#define FLIP {number(FLIP)}")
    if chain.n_joints < 6:
        parts.append(f"#define TILT_TOLERANCE {number(settings.tilt_tolerance)}")
    parts.append(cn.NUMERIC)
    arm, first = carried_arm(chain)
    structure: Structure = find_structure(arm) if arm is not None else None
    if arm is None or structure is None:
        starts = start_configurations(chain, 24)
        table = ",\n    ".join(array(s) for s in starts)
        start_table = f"static const double START[STARTS][N] = {{\n    {table}}};"
        parts += ["#define HELD 0", f"#define STARTS {len(starts)}", start_table]
        return [*parts, cn.NUMERIC_INVERSE]
    probe = perpendicular(arm.axes[5] if isinstance(structure, SphericalWrist) else arm.axes[1])
    parts += [
        f"#define FIRST {first}",
        "#define HELD FIRST",
        f"static const double HOME_INVERSE[12] = {array(invert(chain.home)[:3].ravel())};",
        f"static const double CENTRE[3] = {array(structure.centre)};",
        f"static const double PROBE[3] = {array(probe)};",
        ci.SUBPROBLEMS,
    ]
    if isinstance(structure, SphericalWrist):
        if structure.shoulder is not None:
            parts.append(f"static const double SHOULDER[3] = {array(structure.shoulder)};")
        if structure.arm != "meeting_12":
            parts.append(ci.TO_PLANE)
        arms = {"parallel_23": ci.ARM_PARALLEL_23, "meeting_12": ci.ARM_MEETING_12, "parallel_12": ci.ARM_PARALLEL_12}
        parts += [ci.TWO_TURNS, arms[structure.arm], ci.SPHERICAL_WRIST]
    else:
        parts += [ci.TO_PLANE, ci.PARALLEL_ARM]
    return [*parts, ci.CLOSED_INVERSE]
