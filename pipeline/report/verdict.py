"""The top of the report: one verdict a person can act on."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.artifacts import CORRECTED, HAND_EYE
from pipeline.report.blocks import Grade, KeyFigure, Verdict
from pipeline.report.diagnosis_chapter import short_statement
from pipeline.report.hand_eye_chapter import hand_eye_verdict
from pipeline.report.material import Material, is_platform
from pipeline.report.style import number, percent, probability
from pipeline.report.verification_chapter import error_table, noise_by_tool
from robcal.calibration.observations import FrameObservations
from robcal.calibration.verification import Verification
from robcal.photogrammetry.measure.frames import MeasuredFrames
from robcal.photogrammetry.station.network import StationOrientation
from robcal.photogrammetry.survey.types import SurveyResult
from robcal.physics.library import kinds

LEVEL = 0.01
"""Probability below which errors are called larger than predicted, or a rest unexplained."""


def verdict_of(material: Material) -> Verdict:
    """Verdict on whatever the run holds: a robot, a station, a survey."""
    if material.verification is not None:
        return _robot(material, material.verification[0])
    seen = material.find(HAND_EYE)
    if seen is not None:
        return hand_eye_verdict(material, seen)
    if material.surveys or material.station is not None:
        return _measuring(material)
    if material.stages:
        return Verdict(
            "none",
            "No verdict",
            "The run holds no verified robot and no survey.",
            "See the chapters below.",
            "Nothing yet.",
            diagnosis_sentence(material),
        )
    return Verdict("none", "Nothing done yet", "No stage of this campaign has finished.", "–", "Nothing yet.")


def diagnosis_sentence(material: Material) -> str:
    """The diagnosis in one sentence, empty without one."""
    d = material.diagnosis
    if d is None:
        return ""
    text = short_statement(d)
    left = d.get("unexplained") or {}
    p = left.get("p_value")
    if p is not None and p < LEVEL:
        text += f" Something stays unexplained (p = {probability(p)}" + (
            f", {left['pattern']})." if left.get("pattern") else ")."
        )
    return text


def not_named(diagnosis: Mapping[str, Any] | None) -> bool:
    """Whether a cause has no name, but an empirical term."""
    return any(not kinds()[cause["cause"]].named for cause in (diagnosis or {}).get("causes", []))


def _robot(material: Material, v: Verification) -> Verdict:
    noise = noise_by_tool(material)
    after, before = v.tools["0"], v.nominal["0"] if v.nominal else None
    gain = before.mean / after.mean if before is not None and after.mean > 0 else float("nan")
    told = material.result.get("verdict", {})
    grade: Grade = told.get("grade", "none")
    doubts = list(told.get("reasons", []))
    word = str(told.get("text", "No verdict")).split(":")[0].rstrip(".")
    change = (
        f"The robot's mean error falls from {number(before.mean * 1e3)} to {number(after.mean * 1e3)} mm "
        f"({gain:.{1 if gain < 10 else 0}f} times better), the largest from {number(before.max * 1e3)} to "
        f"{number(after.max * 1e3)} mm"
        if before is not None
        else f"The robot's mean error is {number(after.mean * 1e3)} mm, the largest {number(after.max * 1e3)} mm"
    )
    but = f", but {'; '.join(doubts)}" if doubts else ""
    kept = (
        f"Tested on {v.poses} poses kept out of the identification and of every choice"
        if v.kind == "verify-set"
        else f"Cross-validated: each of {v.poses} poses predicted by a robot identified without it"
    )
    reason = f"{kept}; {percent(v.coverage_95)} of them lie inside the predicted 95 % region."
    reason += _measurement(material.result.get("noise") or {})
    reason += _taken_out(material, v)
    load = (
        "robot_calibrated.yaml; corrected targets or joint angles by 'pipeline compensate', code for the controller by "
        "'pipeline export'."
    )
    if is_platform(material):
        load = "robot_calibrated.yaml; leg lengths or corrected targets by 'pipeline compensate'."
    if before is not None and after.rms >= before.rms:
        load = "Keep the nominal robot: the identified one is no better at poses that were kept out."
    elif grade == "bad":
        load = "Settle the doubts before anything is loaded into the controller."
    return Verdict(
        grade,
        word,
        f"{change}{but}.",
        reason,
        load,
        diagnosis_sentence(material),
        _keys(material, v, noise, gain),
        error_table(v, noise, full=False),
        _enough(told.get("tolerance")),
    )


def _enough(kept: Mapping[str, Any] | None) -> str:
    """The user's tolerance against the kept-out errors, in words."""
    if kept is None:
        return "State tolerance_mm in campaign.yaml, and the errors are judged by it here."
    answer = "Yes" if kept["kept"] else "No"
    if kept["undecided"]:
        answer = "Perhaps" if kept["kept"] else "Not surely" if not kept["beyond"] else answer
    text = f"{answer}: {kept['statement']}."
    if kept["uncertainty_mm"] > 0:
        text += (
            f" An error within {number(kept['uncertainty_mm'], 2)} mm of the tolerance is too close to tell, as the "
            "measurement errs by that much itself (ISO 14253-1, 95 %)."
        )
    return text + (
        f" Of further poses drawn like these at least {percent(kept['share_kept_95'])} keep it (95 % sure)."
        if kept["share_kept_95"] > 0
        else ""
    )


_SOURCES = {
    "stated": "as stated",
    "repeats": "from repeated poses",
    "lengths": "from lengths on the body",
    "residuals": "from what is left",
}


def _measurement(noise: Mapping[str, Any]) -> str:
    """What the measurement alone scatters by, from the source that holds; what the model misses is no part of it."""
    source, value = _SOURCES.get(str(noise.get("source"))), noise.get("measurement_mm")
    if source is None or value is None:
        return ""
    return (
        f" The measurement alone scatters by {number(float(value))} mm (RMS over the identification poses; {source})."
    )


def _taken_out(material: Material, v: Verification) -> str:
    """Faults of the measuring system that were found, and how far the prediction is to be trusted."""
    freed = material.find(CORRECTED)
    if freed is None or material.identification is None:
        return ""
    shifts = [
        np.linalg.norm(a.world_T_tool[:, :3, 3] - b.world_T_tool[:, :3, 3], axis=1)
        for a, b in zip(material.identification.recording.observations, freed.observations, strict=True)
        if isinstance(a, FrameObservations) and isinstance(b, FrameObservations)
    ]
    if not shifts:
        return ""
    moved, sigma = (1e3 * float(np.sqrt(np.mean(x**2))) for x in (np.concatenate(shifts), v.predicted))
    return (
        f" Faults of the measuring system that were found ({number(moved, 2)} mm RMS) are in these errors; the "
        f"region is judged without them. A predicted place is known to {number(sigma, 2)} mm a direction."
    )


def _keys(material: Material, v: Verification, noise: dict[str, float], gain: float) -> tuple[KeyFigure, ...]:
    after, before = v.tools["0"], v.nominal["0"] if v.nominal else None
    keys = [
        KeyFigure(
            number(after.mean * 1e3),
            "mm",
            "Mean error after calibration",
            f"before {number(before.mean * 1e3)} mm" if before else "",
        ),
        KeyFigure(
            number(after.max * 1e3),
            "mm",
            "Largest error after",
            f"before {number(before.max * 1e3)} mm" if before else "",
        ),
    ]
    if np.isfinite(gain):
        keys.append(KeyFigure(f"{gain:.1f}", "times", "Improvement", f"over {v.poses} poses"))
    if "0" in noise:
        keys.append(KeyFigure(number(noise["0"] * 1e3), "mm", "Noise of the measurement", "RMS at the poses kept out"))
    if v.iso is not None:
        keys.append(
            KeyFigure(
                number(v.iso.ap_mean * 1e3),
                "mm",
                "AP, ISO 9283",
                f"largest {number(v.iso.ap_max * 1e3)} mm, {v.iso.groups} poses",
            )
        )
    return tuple(keys)


def _sentence(parts: list[str]) -> str:
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


_WORDS: Mapping[Grade, str] = {"good": "Good", "care": "Usable, with care", "bad": "Not usable"}


@dataclass
class _Judged:
    """A verdict while it is collected."""

    grade: Grade = "good"
    parts: list[str] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    keys: list[KeyFigure] = field(default_factory=list)

    def care(self, why: str) -> None:
        """A doubt, which makes a good verdict one with care."""
        self.grade = "care" if self.grade == "good" else self.grade
        self.parts.append(why)


def _measuring(material: Material) -> Verdict:
    judged = _Judged()
    for name, survey in material.surveys.items():
        _judge_survey(judged, name, survey)
    if material.station is not None:
        _judge_station(judged, material.station, material.frames)
    diagnosis = material.diagnosis or {}
    left = (diagnosis.get("unexplained") or {}).get("p_value")
    if (left is not None and left < LEVEL) or not_named(diagnosis):
        judged.care("but the images show something that the camera model does not explain")
    return Verdict(
        judged.grade,
        _WORDS.get(judged.grade, ""),
        _sentence(judged.parts),
        _sentence(judged.reasons),
        ("bodies/*.yaml (surveyed coordinates with sigmas) and " if material.surveys else "")
        + "cameras/*.yaml (calibrated cameras).",
        diagnosis_sentence(material),
        tuple(judged.keys),
    )


def _judge_survey(judged: _Judged, name: str, survey: SurveyResult) -> None:
    n = survey.network
    sigma = number(float(np.sqrt(np.mean(n.points_sigma**2)) * 1e3))
    judged.parts.append(f"{len(n.ids)} targets of {name} are known to {sigma} mm from {len(n.image_names)} images")
    judged.keys += [
        KeyFigure(sigma, "mm", f"Sigma of a coordinate, {name}", f"{len(n.ids)} targets"),
        KeyFigure(number(n.sigma0_px), "px", "Sigma0 of a mark", f"redundancy {n.redundancy_total}"),
    ]
    checked = n.check_lengths
    if not checked:
        judged.reasons.append(f"redundancy {n.redundancy_total}; no check length tests the scale of {name}")
        return
    worst = number(max(abs(c.error) for c in checked) * 1e3)
    judged.keys.append(
        KeyFigure(worst, "mm", "Length error, VDI/VDE 2634-1", f"largest of {len(checked)} check lengths")
    )
    judged.reasons.append(f"{len(checked)} check lengths took no part in the adjustment")
    if any(abs(c.w) > 3.3 for c in checked):
        judged.care("but check lengths deviate by more than their sigma allows")


def _judge_station(judged: _Judged, station: StationOrientation, frames: MeasuredFrames | None) -> None:
    oriented = f"{len(station.names)} cameras are oriented from {len(station.poses)} poses"
    if frames is not None and len(frames.pose):
        own = number(np.sqrt(np.median(np.trace(frames.covariance[:, :3, :3], axis1=1, axis2=2)) / 3) * 1e3)
        oriented += f" and measure the body's place to {own} mm"
        judged.keys.append(KeyFigure(own, "mm", "Sigma of a measured place", f"median of {len(frames.pose)} poses"))
        deviation = np.abs(frames.pairs.deviation) * 1e3
        if len(deviation):
            largest = f"largest {number(deviation.max())} mm of {len(deviation)}"
            judged.keys.append(
                KeyFigure(number(deviation.mean()), "mm", "Deviation of lengths between targets", largest)
            )
    judged.parts.append(oriented)
    judged.keys.append(KeyFigure(number(station.rms_px), "px", "Residuals of the station", "RMS"))
    judged.reasons.append(f"redundancy {station.redundancy_total:.0f} of the station, sigma0 {number(station.sigma0)}")
    if not station.converged:
        judged.grade = "bad"
        judged.parts.append("but the station's adjustment did not converge")
