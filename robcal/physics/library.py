"""The whole library of causes: every module of this package that has `ENTRIES` adds them."""

import importlib
import pkgutil
from collections.abc import Mapping
from functools import cache
from types import ModuleType

from robcal import physics
from robcal.cause import Kind
from robcal.physics.cause import Entry, LinearCause, ObservationData
from robcal.physics.site import RobotSite


@cache
def entries() -> tuple[Entry, ...]:
    """All entries, modules in alphabetical order."""
    return tuple(entry for module in _modules() for entry in vars(module).get("ENTRIES", ()))


@cache
def kinds() -> Mapping[str, Kind]:
    """All kinds of causes by name: a kind is known by standing in a module of this package."""
    found = (value for module in _modules() for value in vars(module).values() if isinstance(value, Kind))
    return {kind.name: kind for kind in found}


def words_of(name: str) -> str:
    """A cause's name in words."""
    known = kinds().get(name)
    return name.replace("_", " ") if known is None else known.words


def all_causes(site: RobotSite, data: ObservationData, ids: tuple[int, ...], body: str) -> tuple[LinearCause, ...]:
    """Every cause that may act on this robot and show in this kind of recording, at every place it may act."""
    robot = (cause for entry in entries() if entry.on_robot is not None for cause in entry.on_robot(site))
    shown = (
        cause
        for entry in entries()
        if entry.on_observations is not None
        for cause in entry.on_observations(data, ids, body)
    )
    return (*robot, *shown)


def _modules() -> list[ModuleType]:
    names = [module.name for module in pkgutil.walk_packages(physics.__path__, f"{physics.__name__}.")]
    return [importlib.import_module(name) for name in names]
