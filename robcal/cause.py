"""A cause: what makes measurements differ from what a model says, of a kind that has a name, at one place."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Stage = Literal["robot", "camera", "image", "body", "wire", "sensor"]


@dataclass(frozen=True)
class Kind:
    """A kind of cause. Plain data: it is compared, stored, and looked up by its name.

    Attributes
    ----------
    name : as in diagnosis.json. stage : of the measuring chain, where it acts.
    words : for people. sentence : template, filled with the reported parameters, `where` and `direction`.
    named : false for what the library has no name for, which an empirical term describes.
    of_station : 3D points show it for the station as a whole only, whatever camera it is.
    moves : 'camera', 'base' or 'target' if that stands elsewhere (from a pose on, or than its file says).
    is_relabelling : two targets carry each other's number: their marks are read anew, nothing else changes.
    displaces_marks : marks in images stand elsewhere than the camera model says.
    of_order : bound to the order or the time of the poses: it says nothing of other poses.
    several_drivers : a place may have it several times, once for each covariate.
    intrinsics : numbers of a camera that a file leaves out.
    expected : every robot has it, so it takes no place among the few causes that a search may add.
    """

    name: str
    stage: Stage
    words: str
    sentence: str = ""
    named: bool = True
    of_station: bool = False
    moves: str = ""
    is_relabelling: bool = False
    displaces_marks: bool = False
    of_order: bool = False
    several_drivers: bool = False
    intrinsics: tuple[str, ...] = ()
    expected: bool = False

    def describe(self, where: str, reported: Mapping[str, object], direction: str | None = None) -> str:
        """The sentence for one place and its reported parameters."""
        return describe(self.sentence, where, direction, reported)


@dataclass(frozen=True)
class Cause:
    """A kind of cause at one place; variants say what it changes: the robot, observations, marks in images."""

    kind: Kind
    where: str
    direction: str | None

    @property
    def name(self) -> str:
        """Name of the kind."""
        return self.kind.name

    @property
    def stage(self) -> Stage:
        """Stage of the measuring chain."""
        return self.kind.stage


def describe(sentence: str, where: str, direction: str | None, reported: Mapping[str, object]) -> str:
    """Fill the template of a sentence: axis names are spelled out for people, lists shortened to three decimals."""

    def spelled(place: object) -> object:
        return re.sub(r"^axis(\d+)$", r"axis \1", place) if isinstance(place, str) else place

    shown = {
        name: ", ".join(f"{x:.3f}" for x in value) if isinstance(value, list) else spelled(value)
        for name, value in reported.items()
    }
    text = sentence.format(**{"where": spelled(where), "direction": direction or "", **shown})
    return text[0].upper() + text[1:]
