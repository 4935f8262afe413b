"""Sag of a robot whose masses nobody stated: compliance times unknown first moments, known functions of the angles."""

from collections.abc import Iterator

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import DEFLECTION, DEG, Array, Basis, Constants, Entry, RobotCause
from robcal.physics.site import LETTER_OF_KIND, Joint, RobotSite, each_joint
from robcal.robot.gravity_regressor import direction_of_gravity, expressions, regressor
from robcal.robot.model import RobotModel

GRAVITY_SAG = Kind(
    "gravity_sag",
    "robot",
    "sag under weights that are not stated",
    "{where} sags about {direction} by {sag_deg:.4f} deg under weights that the robot file does not state",
    expected=True,
)
KNOWN_TO_GIVE = 3.0
"""Prior weight of the sag about a joint's own axis: every joint gives way there, and every arm has weight."""
ACROSS = 0.5
"""The same for both angles across the axis together."""
LARGEST = 0.03
"""rad: no arm that carries itself sags more."""
MOST_LINKS = 4
"""Bodies behind a joint that are told apart; those farther out move with the last of them or are light."""


def without_masses(model: RobotModel) -> bool:
    """Whether a robot has no mass that could make it sag."""
    return not any(f.mass for f in model.frames)


def _gravity_sag(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    if joint.prismatic or site.model.has_loops or not without_masses(site.model):
        return
    for angle in (joint.own_angle, *joint.cross_angles):
        own = angle == joint.own_angle
        cause = _about(site, joint, angle, KNOWN_TO_GIVE if own else ACROSS / 2.0)
        if cause is not None:
            yield cause


def _about(site: RobotSite, joint: Joint, angle: str, weight: float) -> RobotCause | None:
    frames, gravity = site.model.frames, direction_of_gravity(site.model)
    grid: list[Constants] = []
    counts = {0}
    for links in range(1, MOST_LINKS + 1):
        count = len(regressor(frames, gravity, joint.frame, angle, links))
        if count not in counts:  # a further body that adds nothing is no other law
            grid.append({"links": float(links)})
        counts.add(count)
    if not grid:
        return None
    kind = "q" if angle == joint.own_angle else angle

    def bases(c: Constants) -> tuple[Basis, ...]:
        laws = regressor(frames, gravity, joint.frame, angle, int(c["links"]))
        return tuple(Basis(joint.frame, kind, text, f"c{i}") for i, law in enumerate(laws) for text in expressions(law))

    def report(v: Array, c: Constants) -> dict[str, object]:
        laws = bases(c)
        value = {f"c{i}": float(x) for i, x in enumerate(v)}
        sag = np.sum([value[b.parameter] * b.value(site.variables) for b in laws], axis=0)
        formula = " + ".join(f"{value[b.parameter]:.6g}*({b.expression})" for b in laws)
        variables = [f"q{j.number}_deg" for j in site.joints if any(f"q{j.number})" in b.template for b in laws)]
        return {
            "sag_deg": 0.5 * float(np.ptp(sag)) * DEG,
            "moment_free": True,
            "term": {"variables": variables, "kind": "formula", "formula": formula},
        }

    return RobotCause(
        GRAVITY_SAG,
        joint.where,
        LETTER_OF_KIND[angle],
        (),
        (),
        report,
        grid=tuple(grid),
        ordered={"links": tuple(point["links"] for point in grid)},
        bases=bases,
        covariates=tuple(f"q{j.number}" for j in site.joints),
        weight=weight,
        default_prior=DEFLECTION,
        limits=(-LARGEST, LARGEST),
    )


ENTRIES = (Entry(on_robot=each_joint(_gravity_sag)),)
