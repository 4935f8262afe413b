"""What contradicts itself in a campaign.yaml, apart from any file that it names."""

from collections.abc import Iterator

from pipeline.campaign_schema import CampaignEntry, InstrumentEntry
from robcal.files.schemas import proposal

Place = tuple[str | int, ...]
Contradiction = tuple[Place, str]


def contradictions(entry: CampaignEntry) -> Iterator[Contradiction]:
    """What of a campaign.yaml excludes or lacks something else of it: where, and a sentence with the remedy."""
    surveyed = any(body.survey for body in entry.bodies.values())
    measured = bool(entry.measurements) or bool(entry.instruments)
    if entry.station is not None and entry.measurements and not entry.instruments:
        yield (("measurements",), "'measurements' stand instead of 'station': keep one of them")
    if measured and entry.poses is None:
        yield (("measurements",), "measurements need the table of their poses: add 'poses: poses.csv'")
    if measured and entry.robot is None and not entry.bodies:
        yield (("measurements",), "measurements need a robot or a body: add 'robot: robot.yaml'")
    if entry.robot is not None and entry.poses is None and (measured or entry.station is not None):
        yield (("robot",), "a robot needs its joint angles: add 'poses: poses.csv'")
    if not (surveyed or measured or entry.station is not None or entry.hand_eye is not None):
        yield ((), "nothing to work on: give a body a 'survey', or add a 'station', 'measurements' or 'hand_eye'")
    if entry.model.adjustment == "joint":
        yield from _joint(entry)
    yield from _hand_eye(entry)
    carried = entry.station.body if entry.station else None
    for key, place in ((entry.body, ("body",)), (carried, ("station", "body"))):
        if key is not None and key not in entry.bodies:
            yield (place, f"there is no body '{key}' under 'bodies'{proposal(key, list(entry.bodies))}")


def _joint(entry: CampaignEntry) -> Iterator[Contradiction]:
    place: Place = ("model", "adjustment")
    if entry.station is None or entry.robot is None or entry.instruments or entry.measurements:
        yield (
            place,
            "'adjustment: joint' adjusts a robot with the marks of its own station: it needs 'robot', and a 'station' "
            "with images or observations as the only instrument; else write 'adjustment: staged'",
        )
    known = [key for key in ("world_T_base", "flange_T_tool") if getattr(entry, key) is not None]
    known += ["model.priors"] if entry.model.priors else []
    if known:
        yield (
            place,
            f"'adjustment: joint' knows nothing of what {' and '.join(known)} state{'s' * (len(known) == 1)} of the "
            "robot: leave that out, or write 'adjustment: staged'",
        )


def _hand_eye(entry: CampaignEntry) -> Iterator[Contradiction]:
    use = entry.hand_eye
    if use is None:
        return
    if use.board not in entry.bodies:
        told = f"there is no body '{use.board}' under 'bodies'{proposal(use.board, list(entry.bodies))}"
        yield (("hand_eye", "board"), told)
    driven = entry.robot is not None and entry.poses is not None
    if driven == (use.flange is not None):
        yield (
            ("hand_eye",),
            "a hand-eye calibration needs to know where the flange was: either 'robot' and 'poses' (joint angles), "
            "or 'flange: frames.csv' (pose, x_mm ... yaw_deg of the flange in base coordinates)",
        )
    if use.camera.hold and use.camera.calibration is None:
        yield (("hand_eye", "camera", "hold"), "'hold: true' needs the 'calibration' that is to be held")


def instrument_contradictions(name: str, use: InstrumentEntry, kind: str, bodies: list[str]) -> Iterator[Contradiction]:
    """What an instrument states that its kind of measurements does not know."""
    place = ("instruments", name, "body")
    if use.body is not None and use.body not in bodies:
        yield (place, f"there is no body '{use.body}' under 'bodies'{proposal(use.body, bodies)}")
    if (use.mounted == "hand") != (kind == "sensor_points"):
        where = "measures in the hand" if kind == "sensor_points" else f"has {kind}"
        wanted = "mounted: hand" if kind == "sensor_points" else "mounted: world"
        yield (("instruments", name), f"instrument '{name}' {where}: state '{wanted}'")
    if use.pulley is not None and (kind != "distances" or not any(use.pulley.axis)):
        yield (
            ("instruments", name, "pulley"),
            f"instrument '{name}' has {kind}: a pulley belongs to distances, and its axis needs a direction",
        )
    for key in ("tension_N", "correction"):
        if getattr(use, key) is not None and kind != "distances":
            yield (("instruments", name, key), f"instrument '{name}' has {kind}: '{key}' belongs to a wire's lengths")
