"""The whole library of causes for one recording."""

from __future__ import annotations

from robcal.physics.cause import Family, ObservationData
from robcal.physics.joint import joint_families
from robcal.physics.measuring import measuring_families
from robcal.physics.site import RobotSite
from robcal.physics.structure import structure_families


def all_families(site: RobotSite, data: ObservationData, ids: tuple[int, ...], body: str) -> tuple[Family, ...]:
    """Every cause that may act on this robot and show in this kind of recording, at every place it may act."""
    return (*joint_families(site), *structure_families(site), *measuring_families(data, ids, body))
