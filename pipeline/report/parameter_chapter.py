"""Chapter: what was identified, how certain it is, and what the data could not tell apart."""

import re
from typing import Any

import numpy as np

from pipeline.report.blocks import Block, Chapter, Table, Text, table
from pipeline.report.material import Material
from pipeline.report.style import number, probability, to_sigma
from robcal.calibration.identification import IdentifiedRobot
from robcal.estimation.dependence import Eliminated
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel, parameter_unit
from robcal.transforms import xyzrpy_from_frame

_UNITS = {"m": ("mm", 1e3), "rad": ("deg", 180 / np.pi), "rad/(N m)": ("deg/kNm", 180e3 / np.pi), "kg": ("kg", 1.0)}


def parameter_chapter(material: Material) -> Chapter:
    """Identified parameters with sigmas, eliminated ones, correlations, condition."""
    blocks: list[Block] = []
    calibrated, identification = material.calibrated, material.identification
    adjusted = material.result.get("adjustment")
    if adjusted is not None:
        blocks.append(Text(_adjustment(adjusted)))
    if calibrated is not None:
        blocks += [_parameters(calibrated), _placements(calibrated.model)]
        if calibrated.model.terms:
            blocks.append(_terms(calibrated.model))
    if identification is not None:
        blocks += _gauges(identification.robot, calibrated is not None and bool(calibrated.model.terms))
    return Chapter(
        "parameters",
        "Identified parameters",
        "Deviations from the nominal robot, each with its standard deviation; those beyond three sigma are marked. "
        "What the data could not tell apart was eliminated, and is named with what it is tied to.",
        tuple(blocks),
    )


def _adjustment(section: dict[str, Any]) -> str:
    """How marks, cameras, body and robot were adjusted together."""
    scatter = number(max(section["joint_scatter_deg"]), 2)
    return (
        f"One adjustment of {section['marks']} marks: cameras, body, base, tool and robot together, in "
        f"{section['poses']} poses whose joints scatter by {scatter} deg. The uncertainty of the parameters holds in "
        "the world of the cameras."
    )


def in_units(model: RobotModel, name: str, value: float) -> tuple[float, str]:
    """A parameter's value in the unit for people."""
    inside = parameter_unit(model, name)
    unit, factor = _UNITS.get(inside, (inside, 1.0))
    return value * factor, "" if unit == "1" else unit


def _parameters(calibrated: Any) -> Table:
    model = calibrated.model
    kernel = Kernel(model, calibrated.statics)
    sigma = np.sqrt(np.clip(np.diag(calibrated.covariance), 0, None))
    terms = {t.name for t in model.terms}
    rows = []
    for name, s in zip(calibrated.names, sigma, strict=True):
        if name.startswith(("base.", "tool.")):
            continue
        theta = float(kernel.theta0[kernel.index[name]])
        value, unit = in_units(model, name, theta)
        spread, _ = in_units(model, name, float(s))
        ratio = abs(theta) / s if s > 0 else float("inf")
        unit = "SI" if not unit and name.split(".")[0] in terms else unit
        rows.append(
            [
                name,
                to_sigma(value, spread),
                number(spread, 2),
                unit,
                f"{ratio:.1f}" if np.isfinite(ratio) else "–",
                "●" if ratio > 3 else "",
            ]
        )
    return table(
        ["Parameter", "Value", "Sigma", "Unit", "Value / sigma", "Significant"],
        rows,
        ("" if model.is_hexapod else "Elastic parameters in degrees per kN m of static moment. ")
        + "Base and tool are given as frames below, their deviations are folded in.",
        text=(0, 3, 5),
        shown=80,
    )


def _placements(model: RobotModel) -> Table:
    rows = []
    placed = {"base in the measuring system": model.world_T_base, "tool on the flange": model.flange_T_tool}
    for name, frame in placed.items():
        if frame is None:
            continue
        six = xyzrpy_from_frame(np.asarray(frame))
        rows.append([name, *(f"{v * 1e3:.3f}" for v in six[:3]), *(f"{np.degrees(v):.4f}" for v in six[3:])])
    return table(["Frame", "x (mm)", "y (mm)", "z (mm)", "roll (deg)", "pitch (deg)", "yaw (deg)"], rows)


def _terms(model: RobotModel) -> Table:
    rows = [
        [
            t.name,
            t.cause or "",
            f"{t.frame} {t.kind}",
            _readable(t.expression),
            ", ".join(f"{k} = {number(v, 4)}" for k, v in t.parameters.items()),
        ]
        for t in model.terms
    ]
    return table(
        ["Term", "Cause", "Added to", "Expression (SI)", "Parameters (SI)"],
        rows,
        "Physics that the diagnosis added to the model.",
        text=(0, 1, 2, 3, 4),
    )


def _readable(expression: str) -> str:
    """An expression with its constants to four figures; the file keeps all of them."""
    return re.sub(r"\d+\.\d{4,}(?:e[-+]?\d+)?", lambda found: f"{float(found[0]):.4g}", expression)


_WHY = {"no influence": "no influence on any measured pose", "dependent": "others do exactly the same"}


def _why(found: IdentifiedRobot, e: Eliminated) -> str:
    """Why a parameter was eliminated, in words."""
    if e.reason in _WHY:
        return _WHY[e.reason]
    sigma, unit = in_units(found.model, e.name, e.sigma)
    return f"the data leave it open by {number(sigma, 2)} {unit}, more than such a part is off"


def _tied(model: RobotModel, e: Eliminated) -> str:
    """Changes of other parameters that do the same as one unit of this one, the strongest first."""
    own, unit = in_units(model, e.name, 1.0)
    told = []
    for name, change in sorted(e.tied_to.items(), key=lambda p: -abs(p[1])):
        other, its_unit = in_units(model, name, change)
        same = abs(other / own - 1) < 5e-4 and its_unit == unit
        told.append(name if same else f"{other / own:+.3g} {its_unit} {name}")
    if not told:
        return "nothing measured" if e.reason == "no influence" else "the parameters kept, all a little"
    listed = ", ".join(told[:5]) + (f" and {len(told) - 5} more" if len(told) > 5 else "")
    return listed if told[0] in e.tied_to and len(told) == 1 else f"1 {unit}: {listed}"


def _gauges(found: IdentifiedRobot, diagnosed: bool) -> list[Block]:
    blocks: list[Block] = []
    rows = [[name, _why(found, e), _tied(found.model, e)] for name, e in sorted(found.eliminated.items())]
    rows += [
        [name, f"no evidence for it (F-test, p = {probability(p)})", "nothing: taken as zero"]
        for name, p in sorted(found.rejected_elasticities.items())
    ]
    sentence = (
        f"{len(found.names)} parameters from {int(found.used.sum())} poses, {found.iterations} iterations in "
        f"{found.seconds:.2f} s. Condition of the scaled normal equations {number(found.condition)} (of the raw "
        f"ones {number(found.condition_raw)}), redundancy {found.redundancy}, sigma0 {number(found.sigma0)} "
        f"(one where residuals agree with the stated covariance; p = {probability(found.p_value)})."
    )
    blocks.append(Text(f"Before the diagnosis added its terms: {sentence}" if diagnosed else sentence))
    if rows:
        blocks.append(
            table(
                ["Eliminated", "Why", "Tied to: does the same as"],
                rows,
                "Eliminated parameters stay at their nominal values; nothing is lost within the measured poses.",
                text=(0, 1, 2),
                shown=12,
            )
        )
    correlation = np.asarray(found.correlations)
    if correlation.ndim == 2 and len(correlation):
        names = found.names
        i, j = np.nonzero(np.triu(np.abs(correlation), 1) > 0.95)
        order = np.argsort(-np.abs(correlation[i, j]))[:30]
        pairs = [[names[i[k]], names[j[k]], f"{correlation[i[k], j[k]]:+.3f}"] for k in order]
        if pairs:
            blocks.append(
                table(
                    ["Parameter", "Hard to tell from", "Correlation"],
                    pairs,
                    "Correlations above 0.95: their sum or difference is known much better than each.",
                    text=(0, 1),
                    shown=12,
                )
            )
    return blocks
