"""Which causes are the same to the measurements: by their signatures, not by a list.

A cause that was answered spans, with its free amplitudes and over a grid of its constants, a set of subspaces of
whitened measurements. The share of the true effect's projected signature that the best of them can reproduce is its
cosine with the truth; above 0.99 no recording of that size and noise tells the two apart at the SNRs in question.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fixtures.effects import Effect
from fixtures.plan import STATION_VIEWPOINT, Truth
from fixtures.posing import identify_poses
from fixtures.rigid import Array
from fixtures.signature import Design

SAME = 0.99
AXES = "xyz"


@dataclass
class Equivalence:
    """Cosines of answered causes with the true effects of one truth; results are remembered."""

    truth: Truth
    design: Design
    _known: dict[Any, float] = field(default_factory=dict)

    def cosine(self, effect: Effect, answer: Mapping[str, Any]) -> float:
        """Share (norm) of the projected signature of a true effect that the answered cause can reproduce."""
        coupled = (answer.get("parameters") or {}).get("from")
        key = (id(effect), answer["cause"], str(answer["where"]), answer.get("direction"), coupled)
        if key not in self._known:
            self._known[key] = self._compute(effect, answer)
        return self._known[key]

    def same(self, effect: Effect, answer: Mapping[str, Any]) -> bool:
        """Whether the answer is the truth or has its signature."""
        if answer["cause"] == effect.cause and str(answer["where"]) == effect.where:
            both = answer.get("direction") and effect.direction
            if not both or answer["direction"] == effect.direction:
                return True
        return self.cosine(effect, answer) > SAME

    def _compute(self, effect: Effect, answer: Mapping[str, Any]) -> float:
        s = self.design.project(self.design.signature([effect]))
        size = float(np.linalg.norm(s))
        best = 0.0
        try:
            spans = list(self._spans(answer, effect))
        except (KeyError, ValueError, IndexError):  # a place that the true robot does not have
            return 0.0
        for columns in spans:
            U, sv, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
            basis = U[:, sv > 1e-6 * sv[0]] if len(sv) and sv[0] > 0 else U[:, :0]
            best = max(best, float(np.linalg.norm(basis.T @ s)) / size)
        return best

    def _spans(self, answer: Mapping[str, Any], effect: Effect) -> Iterator[Array]:
        """Projected columns (N, k) of an answered cause for each choice of its constants."""
        for members in self._members(answer, effect):
            columns = [self._column(member) for member in members]
            yield self.design.project(np.stack(columns, axis=1))

    def _column(self, effect: Effect) -> Array:
        column: Array = self.design.signature([effect])
        return column

    def _members(self, answer: Mapping[str, Any], effect: Effect) -> Iterator[list[Effect]]:
        cause, where = str(answer["cause"]), str(answer["where"])
        direction = answer.get("direction")
        robot = self.truth.healthy

        def one(direction: str | None = None, **parameters: Any) -> Effect:
            return Effect(cause, where, direction, parameters)

        def wave(order: int, amplitude: float = 0.002) -> list[Effect]:
            name = "torque_Nm" if cause == "counterbalance" else "amplitude_deg"
            way = direction if cause == "axis_wobble" else None
            return [one(way, order=order, phase_deg=p, **{name: amplitude}) for p in (0.0, 90.0)]

        def vector(name: str, size: float, **fixed: Any) -> list[Effect]:
            return [one(**{name: tuple(size * np.eye(3)[i])}, **fixed) for i in range(3)]

        if cause in ("joint_compliance", "link_compliance"):
            way = direction or AXES[robot.joint_axis[robot.joint(where)]]
            own = AXES[robot.joint_axis[robot.joint(where)]] == way
            name = "joint_compliance" if own else "link_compliance"
            yield [Effect(name, where, way, {"compliance_deg_per_kNm": 1e-4})]
        elif cause == "geometry":
            names = [n for n in answer.get("parameters") or {} if n.rsplit("_", 1)[-1] in ("mm", "deg")]
            if not names:  # a rival is told without parameters: either kind in its direction
                turn = {"x": "roll", "y": "pitch", "z": "yaw"}[str(direction)]
                names = [f"{direction}_mm", f"{turn}_deg"]
            for name in names:
                yield [one(**{name: 0.002})]
        elif cause == "stiffness_nonlinear":
            yield [one(cubic_deg_per_kNm3=1e-5), one(linear_deg_per_kNm=1e-5)]
        elif cause == "backlash":
            for threshold in {effect.value("threshold_Nm"), 0.0, 5.0, 20.0, 80.0, 1e9}:
                yield [one(width_deg=0.002, threshold_Nm=threshold)]
        elif cause == "hysteresis":
            yield [one(width_deg=0.002)]
        elif cause == "lost_motion":
            poses = identify_poses(self.truth)
            largest = float(np.abs(robot.load(poses.q, poses.circumstances).torque[:, robot.joint(where)]).max())
            for share in (0.01, 0.03, 0.1, 0.2, 0.4, 0.8):
                yield [one(amplitude_deg=0.002, torque_Nm=max(share * largest, 1e-3))]
            if "torque_Nm" in effect.parameters:
                yield [one(amplitude_deg=0.002, torque_Nm=effect.value("torque_Nm"))]
        elif cause in ("zero_jump", "base_moved", "camera_moved"):
            for index in self._indices(answer, effect):
                if cause == "zero_jump":
                    yield [one(jump_deg=0.002, index=index)]
                else:
                    yield [*vector("shift_mm", 0.01, index=index), *vector("turn_deg", 0.001, index=index)]
        elif cause in ("joint_eccentricity", "axis_wobble", "gear_ripple"):
            told = (answer.get("parameters") or {}).get("order")
            usual = (1, 2) if cause == "joint_eccentricity" else (1, 2, 3) if cause == "axis_wobble" else (3, 4, 5)
            orders = [round(float(told))] if told else [*usual, int(effect.value("order", usual[0]))]
            for order in orders:
                yield wave(order)
        elif cause == "counterbalance":
            yield wave(1, 5.0)
        elif cause == "transmission_ratio":
            yield [one(ratio_error_ppm=10.0)]
        elif cause == "joint_coupling":
            told_from = (answer.get("parameters") or {}).get("from")
            others = [robot.names[i] for i in robot.joint_frame if robot.names[i] != where]
            for driver in [told_from] if told_from else others:
                yield [one(**{"from": driver, "ratio": 1e-5})]
        elif cause == "payload_mass":
            mass = robot.payloads[where][0]
            yield [one(mass_kg=mass * 1.001)]
        elif cause == "payload_cog":
            cog = robot.payloads[where][1] * 1000.0
            yield [one(cog_mm=tuple(cog + np.eye(3)[i])) for i in range(3)]
        elif cause == "base_compliance":
            yield [one(compliance_deg_per_kNm=1e-5)]
        elif cause == "base_tilt":
            yield [one(tilt_deg=0.02, azimuth_deg=a) for a in (0.0, 90.0)]
        elif cause in ("thermal_growth", "thermal_zero_drift", "scale_drift", "body_thermal_growth", "sphere_growth"):
            yield from ([e] for e in self._warm(one, cause, direction, effect))
        elif cause == "scale_error":
            yield [one(ppm=10.0)]
        elif cause == "refraction":
            yield [one(curvature_per_km=0.001, viewpoint_mm=tuple(STATION_VIEWPOINT * 1000.0), up=(0.0, 0.0, 1.0))]
        elif cause == "target_shifted":
            yield vector("shift_mm", 0.01)
        elif cause == "wire_sag":
            yield [one(g_per_m=1.0)]
        elif cause in ("wire_stretch", "wire_scale", "wire_offset", "pulley_wrap", "sensor_scale"):
            name = {
                "wire_stretch": "ppm_per_m",
                "wire_scale": "ppm",
                "wire_offset": "mm",
                "pulley_wrap": "radius_mm",
                "sensor_scale": "ppm",
            }[cause]
            yield [one(**{name: 0.1 if name in ("mm", "radius_mm") else 10.0})]
        elif cause == "sensor_rotation":
            yield [one(axis, deg=0.002) for axis in AXES]
        elif cause in ("damaged_tooth", "cable_drag", "saturating_compliance", "joint_product"):
            yield [effect]

    def _indices(self, answer: Mapping[str, Any], effect: Effect) -> list[int]:
        told = (answer.get("parameters") or {}).get("pose")
        ids = self.truth.recorded.ids
        true = [int(effect.value("index"))] if "index" in effect.parameters else []
        if told in ids:  # the pose is a constant of the cause, which noise shifts by a few
            return [ids.index(str(told)), *true]
        if true:
            return true
        return list(range(5, len(ids) - 5, max(len(ids) // 15, 1)))

    def _warm(self, one: Any, cause: str, direction: str | None, effect: Effect) -> Iterator[Effect]:
        c = self.truth.recorded.circumstances
        kelvin, hour, size = {
            "thermal_growth": ("um_per_m_K", "rate_um_per_h", 1.0),
            "thermal_zero_drift": ("deg_per_K", "deg_per_h", 1e-4),
            "scale_drift": ("ppm_per_K", "ppm_per_h", 1.0),
            "body_thermal_growth": ("um_per_m_K", "", 1.0),
            "sphere_growth": ("um_per_m_K", "", 1.0),
        }[cause]
        way = direction if cause == "thermal_growth" else None
        for place in c.temperature:
            yield one(way, **{kelvin: size, "covariate": place})
        if hour:
            taus = [share * c.duration_h for share in (0.1, 0.25, 0.5, 1.0, 3.0)]
            for tau in [*taus, *([effect.value("tau_h")] if "tau_h" in effect.parameters else [])]:
                yield one(way, **{hour: size, "tau_h": tau})


__all__ = ["SAME", "Equivalence"]
