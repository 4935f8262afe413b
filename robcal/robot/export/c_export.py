"""A calibrated robot as C99 source for a controller: forward model and corrected commands.

The forward model is the kernel's graph (elasticities and extra terms included); its parameters stand in a table that
can be replaced while the controller runs, as a drift control does; the payload enters at run time by mass and centre
of gravity. The inverse is the nominal robot's, in closed form where its joint lines allow one
(:mod:`robcal.robot.structure`), Levenberg-Marquardt otherwise. Nothing is allocated; only ``math.h`` and ``string.h``
are included.

The algorithms are the C files in ``c/``, which include each other as usual; which loops, arm and inverse is chosen by
the macros LINE_ANGLES, ARM, CLOSED_FORM and INVERSE. Exported is one file: the robot's numbers (``robot_data.h.j2``),
then the C files that this robot needs in the order of their includes.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any

import casadi as ca
import jinja2
import numpy as np

from robcal.errors import InvalidInput
from robcal.robot.chain import Chain, chain_of
from robcal.robot.compensation import FLIP, LARGEST_STEP, cell_frames
from robcal.robot.export.c_expressions import array, function_body, number
from robcal.robot.inverse import carried_arm
from robcal.robot.inverse_analytic import perpendicular
from robcal.robot.inverse_numeric import NumericSettings, start_configurations
from robcal.robot.kernel import Kernel, pose_graph
from robcal.robot.model import Payload, RobotModel
from robcal.robot.structure import SphericalWrist, find_structure
from robcal.transforms import Array, invert

SOURCES = files("robcal.robot.export") / "c"
_LOAD = "load"
_STARTS = 24
_UNLIMITED = 1e30
_LINES = {False: "line_joints.h", True: "line_loops.h"}


@dataclass(frozen=True)
class CSource:
    """Exported source.

    Attributes
    ----------
    header_name, header, source_name, source : names and texts of the two files.
    covariates : in the order in which the functions expect them.
    data : the part of the source that is this robot's own (``robot_data.h``).
    choices : the files that the macros LINE_ANGLES, ARM, CLOSED_FORM and INVERSE of the C sources stand for.
    """

    header_name: str
    header: str
    source_name: str
    source: str
    covariates: tuple[str, ...]
    data: str
    choices: Mapping[str, str]


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
    if not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
        raise InvalidInput(f"'{name}' cannot begin the names of C functions: give a prefix of letters and digits")
    kernel = Kernel(model, statics)
    table = parameter_table(model)
    body, covariates = _real_robot(kernel, table)
    # a '*/' in a name must not end the comment
    common = {"prefix": name, "title": re.sub(r"[^\w .,()+-]", "_", model.name)}
    inverse, choices = _inverse(kernel)
    header = (
        _environment()
        .get_template("robot.h.j2")
        .render(
            common,
            joints=model.n_joints,
            covariates=covariates,
            payloads=_payloads(kernel),
            parameters=table,
            defaults=[(defaults or {}).get(covariate, 0.0) for covariate in covariates] or [0.0],
        )
    )
    data = _environment().get_template("robot_data.h.j2").render(common, **inverse, real_robot=body, parameters=table)
    source = f"/* {common['title']} */\n{data}{_amalgamated('commands.c', choices, {'robot_data.h'})}"
    return CSource(f"{name}.h", header, f"{name}.c", source, covariates, data, choices)


def parameter_table(model: RobotModel) -> dict[str, float]:
    """Parameters that stand in the table, by name: all that the model has, but those of payloads, base and tool.

    Base and tool are constants because the inverse uses them as well; payloads come with every call.
    """
    kernel = Kernel(model)
    held = ("payload.", "base.", "tool.")
    own = {*kernel.model.parameters, *(f"{t.name}.{k}" for t in kernel.model.terms for k in t.parameters)}
    values = zip(kernel.names, kernel.theta0.tolist(), strict=True)
    return {name: value for name, value in values if name in own and not name.startswith(held)}


@cache
def _environment() -> jinja2.Environment:
    """Templates with << >> and <% %>: double braces are C's own."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("robcal.robot.export", "c"),
        undefined=jinja2.StrictUndefined,
        variable_start_string="<<",
        variable_end_string=">>",
        block_start_string="<%",
        block_end_string="%>",
        comment_start_string="<#",
        comment_end_string="#>",
        trim_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.filters["number"] = number
    environment.filters["array"] = array
    environment.filters["rows"] = lambda values: "{\n    " + ",\n    ".join(array(v) for v in values) + "}"
    environment.filters["frame"] = lambda T: array(T[:3])
    return environment


def _amalgamated(name: str, choices: Mapping[str, str], done: set[str]) -> str:
    """Text of a C file behind the texts of all that it includes, each once."""
    done.add(name)
    own, before = [], []
    for line in (SOURCES / name).read_text(encoding="utf-8").splitlines():
        include = re.fullmatch(r'#include (?:"(\S+)"|([A-Z_]+))', line)
        if include is None:
            own += [line] if line != "#pragma once" else []
        elif (needed := include[1] or choices[include[2]]) not in done:
            before.append(_amalgamated(needed, choices, done))
    return "".join(before) + "\n" + "\n".join(own) + "\n"


def _real_robot(kernel: Kernel, table: Mapping[str, float]) -> tuple[str, tuple[str, ...]]:
    """Body of world_T_tool(q, load, covariates, parameters), entries row by row, and the covariates' names."""
    model, statics = kernel.model, kernel.statics
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
    parameters = ca.SX.sym("parameters", max(1, len(table)))
    arguments |= {name: parameters[i] for i, name in enumerate(table)}
    inserted = ca.vertcat(*(arguments[n] if n in arguments else ca.SX(float(numbers.get(n, 0.0))) for n in names))
    T = ca.substitute(
        [graph.world_T_tool],
        [theta, one_hot, W0, F0],
        [inserted, ca.SX(1.0), ca.SX(ca.DM(kernel.world_T_base[:3])), ca.SX(ca.DM(kernel.flange_T_tool[:3]))],
    )[0]
    function = ca.Function(
        "real_robot", [q, load, covariates, parameters], [ca.densify(ca.reshape(T.T, 12, 1))], {"cse": True}
    )
    return function_body(function, ("q", "load", "covariate", "ROBOT(parameters)"), ("T",)), graph.covariates


def _payloads(kernel: Kernel) -> list[dict[str, Any]]:
    """C name, mass (kg) and centre of gravity (m, flange) of each payload, deviations included."""
    rows = []
    for name, payload in kernel.model.payloads.items():
        at = kernel.index[f"payload.{name}.mass"]
        cog = np.array(payload.cog) + kernel.theta0[at + 1 : at + 4]
        word = re.sub(r"\W", "_", name, flags=re.ASCII)
        rows.append({"name": word, "mass": payload.mass + kernel.theta0[at], "cog": cog})
    return rows


def _bars(chain: Chain) -> Array:
    """Lengths, crank angle at zero and side of each four-bar, and a last row of zeros (C knows no empty arrays)."""
    bars = [bar for _, bar in chain.coupling.bars] if chain.coupling is not None else []
    return np.array([*([*bar.lengths, bar.crank_zero, bar.side] for bar in bars), [0.0] * 6])


def _inverse(kernel: Kernel) -> tuple[dict[str, Any], dict[str, str]]:
    """What the templates need for chain and inverse, and the C files of this robot's inverse."""
    world_T_base, flange_T_tool = cell_frames(kernel)
    nominal = chain_of(kernel.model)
    chain: Chain = replace(
        nominal,
        home=nominal.home @ flange_T_tool,
        lower=np.maximum(nominal.lower, -_UNLIMITED),
        upper=np.minimum(nominal.upper, _UNLIMITED),
    )
    settings = NumericSettings()
    values: dict[str, Any] = {
        "chain": chain,
        "world_T_base": world_T_base,
        "base_T_world": invert(world_T_base),
        "rotation_length": settings.weight(chain)[3],
        "largest_step": LARGEST_STEP,
        "flip": FLIP,
        "tilt_tolerance": settings.tilt_tolerance,
    }
    arm, first = carried_arm(chain)
    structure = find_structure(arm) if arm is not None else None
    if arm is None or structure is None:
        starts = start_configurations(chain, _STARTS)
        choices = {"LINE_ANGLES": _LINES[chain.coupling is not None], "INVERSE": "numeric_inverse.h"}
        return {**values, "structure": None, "starts": starts, "bars": _bars(chain)}, choices
    wrist = structure if isinstance(structure, SphericalWrist) else None
    closed = {"CLOSED_FORM": "spherical_wrist.h", "ARM": f"arm_{wrist.arm}.h"} if wrist else None
    values |= {
        "structure": structure,
        "first": first,
        "home_inverse": invert(chain.home),
        "probe": perpendicular(arm.axes[5] if wrist else arm.axes[1]),
        "shoulder": wrist.shoulder if wrist else None,
    }
    return values, {
        "LINE_ANGLES": _LINES[False],
        "INVERSE": "closed_inverse.h",
        **(closed or {"CLOSED_FORM": "parallel_arm.h"}),
    }
