"""Sections of result.json and the notes beside them: surveys, station, verification and noise, in mm and deg."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from robcal.calibration.noise_parts import NoiseParts
from robcal.calibration.tolerance import Conformity
from robcal.calibration.verdict import Verdict
from robcal.calibration.verification import ErrorStatistics
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.photogrammetry.survey.types import SurveyResult
from robcal.recipe.verification import RobotVerification


def survey_notes(done: SurveyResult) -> list[str]:
    """What was left out or assumed, a sentence each."""
    notes = [*done.notes, *done.network.notes]
    notes += [f"image {image} not used: {reason}" for image, reason in done.unused_images]
    if done.unseen_ids:
        notes.append(f"targets not surveyed: {', '.join(map(str, done.unseen_ids))}")
    return notes


def survey_section(done: SurveyResult) -> dict[str, Any]:
    """One body of the section `survey`."""
    network = done.network
    checked = network.check_lengths or network.scale_bars
    return {
        "images": len(network.image_names),
        "targets": len(network.ids),
        "sigma0_px": network.sigma0_px,
        "rms_px": network.rms_px,
        "length_error_mm": max((abs(c.error) for c in checked), default=float("nan")) * 1000,
        "sigma0": network.sigma0,
        "redundancy": network.redundancy_total,
        "unknowns": network.unknowns,
        "rank": network.rank,
        "datum": network.datum,
        "condition": network.condition,
        "correlated": [[c.first, c.second, c.value] for c in network.correlations],
        "lengths": [
            {
                "targets": list(c.ids),
                "kind": c.kind,
                "stated_mm": c.expected * 1000,
                "error_mm": c.error * 1000,
                "sigma_mm": c.sigma * 1000,
            }
            for c in (*network.check_lengths, *network.scale_bars)
        ],
        "marks": len(network.marks),
        "rejected": len(network.rejected),
        "sigma_mm": float(np.sqrt(np.mean(network.points_sigma**2)) * 1000),
        "frame": done.frame,
        "scale": done.scale,
        "engine": done.engine,
    }


def station_section(orientation: StationOrientation, marks: Mapping[str, StationMarks]) -> dict[str, Any]:
    """Section `station`."""
    return {
        "cameras": {
            name: {
                "marks": len(marks[name]),
                "images": len(np.unique(marks[name].pose)),
                "noise_factor": orientation.noise.get(name),
                "free_interior": list(orientation.free_interior.get(name, ())),
            }
            for name in orientation.names
        },
        "poses": len(orientation.poses),
        "sigma0": orientation.sigma0,
        "rms_px": orientation.rms_px,
        "redundancy": orientation.redundancy_total,
        "rejected": len(orientation.rejected),
        "evidence": [e.name for e in orientation.evidence],
        "converged": orientation.converged,
    }


def _statistics(tools: Mapping[str, ErrorStatistics]) -> dict[str, dict[str, float]]:
    return {name: {key: value * 1000 for key, value in vars(errors).items()} for name, errors in tools.items()}


def verification_section(found: RobotVerification) -> dict[str, Any]:
    """Section `verification`."""
    outcome = found.delivered
    delivered = _statistics(outcome.tools)["0"]
    result: dict[str, Any] = {
        "kind": outcome.kind,
        "poses": outcome.poses,
        "delivered": {name: delivered[name] for name in ("mean", "max", "rms")},
        "as_recorded": None if found.recorded is None else _statistics(found.recorded.tools),
        "tools": _statistics(outcome.tools),
        "nominal": None if outcome.nominal is None else _statistics(outcome.nominal),
        "p_value": outcome.p_value,
        "coverage_95": outcome.coverage_95,
        "predicted_sigma_mm": float(np.sqrt(np.mean(outcome.predicted**2)) * 1000),
        "normalised_error_squared": float(np.sum(outcome.normalised * outcome.degrees) / max(outcome.degrees.sum(), 1)),
    }
    if outcome.iso is not None:
        result["iso9283"] = {
            "AP_mean_mm": outcome.iso.ap_mean * 1000,
            "AP_max_mm": outcome.iso.ap_max * 1000,
            "AP_orientation_mean_deg": float(np.degrees(outcome.iso.ap_orientation_mean)),
            "AP_orientation_max_deg": float(np.degrees(outcome.iso.ap_orientation_max)),
            "RP_mean_mm": outcome.iso.rp_mean * 1000,
            "RP_max_mm": outcome.iso.rp_max * 1000,
            "groups": outcome.iso.groups,
        }
    return result


def verdict_section(judged: Verdict, kept: Conformity | None) -> dict[str, Any]:
    """Section `verdict`; `tolerance` where the campaign states one."""
    reported: dict[str, Any] = {"grade": judged.grade, "text": judged.text, "reasons": list(judged.reasons)}
    if kept is not None:
        reported["tolerance"] = {
            "tolerance_mm": kept.tolerance * 1000,
            "kept": kept.kept,
            "places": kept.places,
            "within": kept.within,
            "beyond": kept.beyond,
            "undecided": kept.undecided,
            "largest_mm": kept.largest * 1000,
            "uncertainty_mm": kept.uncertainty * 1000,
            "share_kept_95": kept.share,
            "statement": kept.statement,
        }
    return reported


def noise_section(noise: NoiseParts) -> dict[str, Any]:
    """Section `noise`."""
    return {
        "measurement_mm": 1e3 * noise.measurement,
        "source": noise.source,
        "stated_mm": None if noise.stated is None else 1e3 * noise.stated,
        "joint_scatter_deg": None if noise.joint_scatter is None else float(np.degrees(noise.joint_scatter)),
        "lack_of_fit_mm": 1e3 * noise.lack_of_fit,
        "repeats": noise.repeats,
        "p_value": noise.p_value,
    }
