"""Empirical terms for what the library has no name for: smooth bumps, harmonics and products in covariates.

Each is a cause like the named causes, with the cause `unknown`, and competes with them by evidence. Its parameters
are the coefficients of radial bumps over the covariate; their common prior makes it a coarse Gaussian process.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import Array, Basis, Constants, RobotCause
from robcal.physics.site import LETTER_OF_KIND, Joint, RobotSite
from robcal.robot.terms import identifier

UNKNOWN = Kind("unknown", "robot", "unknown, described by an empirical term", named=False)

BUMPS = (4, 7, 12)
"""Numbers of bumps over the range of a covariate: three lengths over which it may vary."""
EMPIRICAL_WEIGHT = 0.5
"""Prior weight of all empirical causes together, against one for each named cause: the library holds most."""

LEAST_IN_BUMP = 3
"""Poses within `REACH` widths of the centre of a bump that stands alone."""
REACH = 1.5
SLACK = (0.15, 0.4, 0.65)
"""Shares of half a joint's range within which a cable hangs slack."""
PULL_PRIOR = 3e-4
"""Typical pull of a taut cable at the end of a joint's range, rad."""


def empirical_causes(site: RobotSite) -> Iterator[RobotCause]:
    """Smooth laws in the joint's own angle, other angles, its torque, time, temperature and order; and products."""
    causes: list[RobotCause] = []
    joints = [joint for joint in site.joints if site.varies(f"q{joint.number}", 1e-6)]
    for joint in joints:
        kinds = ("q", *joint.cross_angles) if not joint.prismatic else ("q",)
        for kind in kinds:
            own = [f"q{joint.number}", f"torque{joint.number}"]
            others = [f"q{other.number}" for other in joints if other.number != joint.number]
            if kind != "q":
                own.append(f"{identifier(joint.frame)}_m{kind}")
            covariates = own + (others if kind == "q" else []) + ["index"] * (kind == "q")
            covariates += ["time_s"] * (kind == "q") + list(site.temperatures() if kind == "q" else ())
            for covariate in covariates:
                if site.varies(covariate, 1e-6):
                    causes.append(_smooth(site, joint, kind, covariate))
        causes.extend(_product(joint, first, second) for i, first in enumerate(joints) for second in joints[i + 1 :])
        causes.extend(bump for bump in [_bump(site, joint)] if bump.grid)
        causes.extend(_taut(site, joint, other) for other in joints if other.number != joint.number)
    yield from (replace(cause, weight=EMPIRICAL_WEIGHT / len(causes)) for cause in causes)


def _place(joint: Joint, kind: str) -> str:
    return LETTER_OF_KIND[joint.own_angle if kind == "q" else kind]


def _term(variables: list[str], kind: str, formula: str) -> dict[str, object]:
    shown = [f"{v}_deg" if v[0] == "q" and v[1:].isdigit() else v for v in variables]
    return {"variables": shown, "kind": kind, "formula": formula}


def _formula(bases: tuple[Basis, ...], values: Array) -> str:
    return " + ".join(f"{value:.6g}*({b.expression})" for b, value in zip(bases, values, strict=True))


def describe_covariate(covariate: str) -> str:
    """A covariate in words."""
    if covariate in ("time_s", "index"):
        return "time" if covariate == "time_s" else "the order of the poses"
    if covariate.startswith("temp_"):
        return f"the temperature '{covariate.removeprefix('temp_').removesuffix('_c')}'"
    for start, words in (("torque", "the load torque of axis {}"), ("q", "the angle of axis {}")):
        number = covariate.removeprefix(start)
        if covariate.startswith(start) and number.isdigit():
            return words.format(number)
    frame, _, angle = covariate.rpartition("_m")
    return f"the moment about {LETTER_OF_KIND[angle]} of {frame}" if angle in LETTER_OF_KIND else covariate


def _smooth(site: RobotSite, joint: Joint, kind: str, covariate: str) -> RobotCause:
    """A smooth law of a covariate; beyond the values recorded it stays as at their end."""
    values = site.variables[covariate]
    low, high = float(np.min(values)), float(np.max(values))

    def bases(c: Constants) -> tuple[Basis, ...]:
        count = int(c["bumps"])
        centres = np.linspace(low, high, count).tolist()
        width = (high - low) / (count - 1)
        return tuple(
            Basis(
                joint.frame,
                kind,
                f"exp(-0.5*((minimum(maximum({covariate}, low), high) - centre)/width)**2)",
                f"c{i}",
                {"low": low, "high": high, "centre": x, "width": width},
            )
            for i, x in enumerate(centres)
        )

    def report(v: Array, c: Constants) -> dict[str, object]:
        return {"term": _term([covariate], "gaussian_process", _formula(bases(c), v))}

    # number of parameters changes with the grid, so each number of bumps is a grid point of its own width
    return RobotCause(
        UNKNOWN,
        joint.where,
        _place(joint, kind),
        (),
        (),
        report,
        "Something the library has no name for acts on {where} and follows " + describe_covariate(covariate),
        grid=tuple({"bumps": float(n)} for n in BUMPS),
        bases=bases,
        covariates=(covariate,),
    )


def _product(joint: Joint, first: Joint, second: Joint) -> RobotCause:
    a, b = f"q{first.number}", f"q{second.number}"

    def bases(c: Constants) -> tuple[Basis, ...]:
        n, m = c["first_order"], c["second_order"]
        laws = [f"{f}(first_order*{a})*{g}(second_order*{b})" for f in ("cos", "sin") for g in ("cos", "sin")]
        if n == m == 1.0:
            laws.append(f"{a}*{b}")
        return tuple(Basis(joint.frame, "q", law, f"c{i}", c) for i, law in enumerate(laws))

    return RobotCause(
        UNKNOWN,
        joint.where,
        _place(joint, "q"),
        (),
        (),
        lambda v, c: {"term": _term([a, b], "harmonic", _formula(bases(c), v))},
        f"Something the library has no name for acts on {{where}} and follows {describe_covariate(a)} together with "
        f"{describe_covariate(b)}",
        grid=tuple({"first_order": n, "second_order": m} for n in (1.0, 2.0) for m in (1.0, 2.0)),
        bases=bases,
        covariates=(a, b),
    )


def _bump(site: RobotSite, joint: Joint) -> RobotCause:
    k = joint.number
    values = site.variables[f"q{k}"]
    low, high = float(np.min(values)), float(np.max(values))
    least = max(0.01, 1.5 / len(values))
    widths = [share * (high - low) for share in (least, *(s for s in (0.025, 0.05) if s > 1.2 * least))]

    def wide_enough(centre: float, width: float) -> bool:
        # what shows at one or two poses is a gross error there, not a law
        return width > 1e-6 and int(np.sum(np.abs(values - centre) < REACH * width)) >= LEAST_IN_BUMP

    tried = [(float(x), w) for w in widths for x in np.arange(low, high + w, w) if wide_enough(x, w)]
    grid = tuple({"centre": x, "width": w} for x, w in tried)

    def bases(c: Constants) -> tuple[Basis, ...]:
        return (Basis(joint.frame, "q", f"exp(-0.5*((q{k} - centre)/width)**2)", "c0", c),)

    return RobotCause(
        UNKNOWN,
        joint.where,
        _place(joint, "q"),
        (),
        (),
        lambda v, c: {"term": _term([f"q{k}"], "formula", _formula(bases(c), v))},
        "{where} is disturbed around one angle only (a damaged tooth, a dent)",
        grid=grid,
        continuous={"centre": (low, high), "width": (least * (high - low), 0.2 * (high - low))},
        bases=bases,
        covariates=(f"q{k}",),
    )


def _taut(site: RobotSite, joint: Joint, other: Joint) -> RobotCause:
    """Nothing until another joint has gone so far to either side, then a pull that grows: hoses and cables."""
    name = f"q{other.number}"
    values = site.variables[name]
    low, high = float(np.min(values)), float(np.max(values))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)

    def bases(c: Constants) -> tuple[Basis, ...]:
        ends = {"low": low, "high": high, **c}
        held = f"minimum(maximum({name}, low), high)"
        return (
            Basis(joint.frame, "q", f"maximum(0.0, {held} - above)", "c0", ends),
            Basis(joint.frame, "q", f"maximum(0.0, below - {held})", "c1", ends),
        )

    return RobotCause(
        UNKNOWN,
        joint.where,
        _place(joint, "q"),
        (),
        (),
        lambda v, c: {"term": _term([name], "formula", _formula(bases(c), v))},
        "Something the library has no name for pulls at {where} once axis " + f"{other.number} has gone far",
        grid=tuple({"above": middle + share * half, "below": middle - share * half} for share in SLACK),
        bases=bases,
        covariates=(name,),
        default_prior=PULL_PRIOR / max(half, 1e-9),
    )
