"""Worlds and tools of a campaign's instruments, from what campaign.yaml states of them."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from pipeline.campaign_schema import CampaignEntry, CellFrameEntry
from robcal.calibration.instruments import CellFrame
from robcal.calibration.instruments.cell_frame import FIXED, FREE
from robcal.errors import InvalidInput
from robcal.files.schemas import proposal
from robcal.robot.model import GEOMETRIC_KINDS

Stated = tuple[CellFrameEntry | None, CellFrameEntry | None]


def cell_frames(
    names: Sequence[str], stated: Mapping[str, Stated], alone: Stated, entry: CampaignEntry, hands: Collection[str] = ()
) -> tuple[dict[str, CellFrame], dict[str, CellFrame]]:
    """World and tool of every instrument by its name; those that share one have the very same.

    Parameters
    ----------
    stated : world_T_base and flange_T_tool of instruments. alone : those at the top level, for a single instrument.
    hands : instruments in the robot's hand; the orientation of their tool is that of a certificate.

    Raises
    ------
    InvalidInput : a coordinate is to be held and not given, an unknown name, or a shared frame that is stated twice.
    """
    out = []
    for which, (end, groups, key) in enumerate(
        (("base", entry.same_world, "same_world"), ("tool", entry.same_tool, "same_tool"))
    ):
        frames: dict[str, CellFrame] = {}
        for group in _groups(names, groups, key):
            entries = {n: e for n in group if (e := stated.get(n, alone)[which]) is not None}
            if len(entries) > 1:
                raise InvalidInput(
                    f"{key}: {' and '.join(entries)} share a frame, and more than one of them states it: state it once"
                )
            frame = cell_frame(
                group[0], end, next(iter(entries.values()), None), end == "tool" and set(group) <= set(hands)
            )
            frames.update(dict.fromkeys(group, frame))
        out.append(frames)
    return out[0], out[1]


def cell_frame(name: str, end: str, entry: CellFrameEntry | None, hand: bool = False) -> CellFrame:
    """What an entry says of a world ('base') or a tool; what it does not state is free.

    Angles of a sensor in the ``hand`` that are stated without more are those of a certificate: points hardly tell them.
    """
    if entry is None:
        return CellFrame(name, end)
    places = np.full(3, np.nan) if entry.xyz_mm is None else np.array(entry.xyz_mm) / 1000.0
    turns = np.full(3, np.nan) if entry.rpy_deg is None else np.radians(entry.rpy_deg)
    given = np.concatenate([places, turns])
    unit = (entry.sigma_mm, entry.sigma_deg)
    prior = [FIXED if s is None else s / 1000.0 if k == 0 else float(np.radians(s)) for k, s in enumerate(unit)]
    sigma = np.full(6, FREE)
    for k, kind in enumerate(GEOMETRIC_KINDS):
        uncertain = unit[k // 3] is not None
        held = uncertain if entry.free is None else entry.free != "all" and kind not in entry.free
        named = isinstance(entry.free, list) or uncertain
        if held and (np.isfinite(given[k]) or named):
            sigma[k] = prior[k // 3]
    certified = hand and entry.rpy_deg is not None and entry.free is None and entry.sigma_deg is None
    if certified:
        sigma[3:] = FIXED
    return CellFrame(name, end, tuple(given.tolist()), tuple(sigma.tolist()), certified)


def _groups(names: Sequence[str], groups: Sequence[Sequence[str]], key: str) -> list[list[str]]:
    """Every name once, those of a group together."""
    owner = {name: name for name in names}
    for group in groups:
        for name in group:
            if name not in owner:
                raise InvalidInput(f"{key}: there is no instrument '{name}'{proposal(name, list(names))}")
        first = owner[group[0]] if group else ""
        joined = {owner[name] for name in group}
        owner = {name: first if old in joined else old for name, old in owner.items()}
    out: dict[str, list[str]] = {}
    for name in names:
        out.setdefault(owner[name], []).append(name)
    return list(out.values())
