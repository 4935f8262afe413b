"""Targets that carry each other's number: found from distances alone, before anything is fitted to them."""

from dataclasses import replace

import numpy as np

from robcal.calibration.observations import PointObservations
from robcal.diagnosis.core.recording import Recording
from robcal.physics.cause import Array

LEAST_DEVIATION = 1e-3
"""Metres: mean length deviations below this are no matter of numbers."""
LEFT_OVER = 0.02
"""Share of the sum of squares of length deviations that may remain once the numbers are exchanged."""


def find_swaps(recording: Recording, most: int = 3) -> tuple[tuple[int, int], ...]:
    """Pairs of ids whose exchange makes the measured distances agree with the body.

    Weakness: where the exchange leaves all distances as they are (a symmetric body) nothing shows here.
    """
    obs = recording.observations
    if not isinstance(obs, PointObservations):
        return ()
    ids, first = np.unique(obs.target, return_index=True)
    if len(ids) < 3:
        return ()
    body = obs.p_tool[first]
    measured = _median_distances(obs, ids)
    found: list[tuple[int, int]] = []
    number = np.arange(len(ids))
    for _ in range(most):
        now = _misfit(measured, body[number])
        if np.sqrt(now) < LEAST_DEVIATION:
            break
        trials = {}
        for i in range(len(ids)):
            for j in range(i + 1, len(ids)):
                order = number.copy()
                order[[i, j]] = order[[j, i]]
                trials[i, j] = _misfit(measured, body[order])
        (i, j), best = min(trials.items(), key=lambda item: item[1])
        if best > (LEFT_OVER if len(found) == most - 1 else 0.7) * now:
            break
        number[[i, j]] = number[[j, i]]
        found.append((int(ids[i]), int(ids[j])))
    if found and _misfit(measured, body[number]) > LEFT_OVER * _misfit(measured, body):
        return ()
    return tuple(found)


def relabelled(recording: Recording, swaps: tuple[tuple[int, int], ...]) -> Recording:
    """The recording with the numbers (and so the body coordinates) of the pairs exchanged back."""
    obs = recording.observations
    if not swaps or not isinstance(obs, PointObservations):
        return recording
    p_tool, target = obs.p_tool.copy(), obs.target.copy()
    place = {int(t): obs.p_tool[int(np.flatnonzero(obs.target == t)[0])] for t in np.unique(obs.target)}
    for i, j in swaps:
        was_i, was_j = target == i, target == j
        target[was_i], target[was_j] = j, i
        p_tool[was_i], p_tool[was_j] = place.get(j, p_tool[was_i]), place.get(i, p_tool[was_j])
    return replace(recording, observations=replace(obs, p_tool=p_tool, target=target))


def _median_distances(obs: PointObservations, ids: Array) -> Array:
    """(t, t) median over the poses of the distance between each two targets, NaN where never seen together."""
    row = np.searchsorted(ids, obs.target)
    poses = np.unique(obs.pose)
    where = np.full((len(poses), len(ids), 3), np.nan)
    where[np.searchsorted(poses, obs.pose), row] = obs.p_world
    gaps = np.linalg.norm(where[:, :, None] - where[:, None, :], axis=3)
    seen = np.any(np.isfinite(gaps), axis=0)
    return np.where(seen, np.nanmedian(np.where(seen, gaps, 0.0), axis=0), np.nan)


def _misfit(measured: Array, body: Array) -> float:
    expected = np.linalg.norm(body[:, None] - body[None], axis=2)
    off = ~np.eye(len(body), dtype=bool) & np.isfinite(measured)
    if not off.any():  # no two targets in one pose: there is no distance to judge by
        return 0.0
    return float(np.mean((measured - expected)[off] ** 2))
