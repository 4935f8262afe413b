"""Start values of base and tool by construction, without a guess, from any kind of observation.

- Frames: ``M_i = W T_i F`` for all poses. Rotations by the singular vectors of ``sum M_i (x) T_i`` (Li, Wang, Wu 2010,
  robot-world and hand-eye calibration by the Kronecker product), translations by linear least squares.
- Points: three or more of a pose make a frame. One target: ``p_i = R_W (R_i x + t_i) + t_W`` is
  linear in R_W, its products with x, and t_W.
- Distances: ``d^2`` is linear in x, the wire's origin and their products.
- A sensor in the hand is a target at the mean measured point; its turn is found by trying 24 orientations.
- Pixels: two or more cameras intersect points, one camera gives the frame of a body by resection.
"""

from collections.abc import Sequence
from itertools import permutations, product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal import transforms as tf
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    Observations,
    PixelObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.errors import DegenerateGeometry, RobcalError
from robcal.photogrammetry.core.camera import normalise

Array = NDArray[np.float64]
Pair = tuple[Array, Array]
PointRows = tuple[NDArray[Any], NDArray[Any], Array, Array]
"""Rows of points: pose, target, coordinates on the tool, coordinates in the world."""

OUTLIER_FACTOR = 6.0
LEAST_TURN = 2e-3
"""RMS turn (rad) of the flange below which the place of the tool is not taken from the measurements."""


def candidates(
    base_T_flange: Array,
    observations: Sequence[Observations],
    flange_T_tool: Array | None = None,
    turn: Array | None = None,
) -> list[Pair]:
    """Pairs (world_T_base, flange_T_tool) worth trying, best founded first; empty if nothing can be constructed.

    Parameters
    ----------
    base_T_flange : (n, 4, 4) of the nominal robot at the poses.
    observations : what was measured.
    flange_T_tool : (4, 4) stated tool, whose place holds where the orientations leave it open; default the flange.
    turn : (3, 3) orientation of a sensor in the hand, where it is known at least roughly.
    """
    near = np.zeros(3) if flange_T_tool is None else flange_T_tool[:3, 3]
    out: list[Pair] = []
    frames = _all_frames(observations)
    if frames is not None and len(frames[0]) >= 2:
        pose, measured = frames
        T = base_T_flange[pose]
        pair = _trimmed_hand_eye(T, measured, near)
        if pair is not None:
            return [pair]
        origin = measured[:, :3, 3]
        for W, x in _one_target(T, origin, near):
            out.append((W, _with_turn(T, measured, W, x)))
        return out
    points = _all_points(observations)
    if points is not None:
        out += _from_points(base_T_flange, *points, near)
    for o in observations:
        if isinstance(o, SensorPointObservations) and len(o.pose) >= 4:
            centre = o.p_sensor.mean(axis=0)
            for W, x in _one_target(base_T_flange[o.pose], o.p_world, near):
                for R in _orientations() if turn is None else [turn]:
                    out.append((W, tf.frame(R, x - R @ centre)))
        elif type(o) is DistanceObservations and len(o.pose) >= 4 and not out:
            out += _from_distances(base_T_flange[o.pose], o.distance)
    return out


def hand_eye(T: Array, measured: Array, near: Array | None = None) -> tuple[Pair, float]:
    """Closed form of ``measured = W T F``; also the ratio of the two largest singular values (near 1: ambiguous).

    Parameters
    ----------
    T, measured : (n, 4, 4). near : (3,) place of the tool where the orientations leave it open; default the flange.
    """
    K = np.einsum("nab,ncd->acbd", measured[:, :3, :3], T[:, :3, :3]).reshape(9, 9)
    U, s, Vt = np.linalg.svd(K)
    # W' M = T F, so sum_b M_ab..: the largest pair of singular vectors holds W (rows a, c) and F (rows d, b)
    R_W, R_F = U[:, 0].reshape(3, 3), Vt[0].reshape(3, 3).T
    if np.linalg.det(R_W) < 0:
        R_W = -R_W
    if np.linalg.det(R_F) < 0:
        R_F = -R_F
    R_W, R_F = _rotation(R_W), _rotation(R_F)
    x, origin = _separate(R_W, T, measured[:, :3, 3], np.zeros(3) if near is None else near)
    return (tf.frame(R_W, origin), tf.frame(R_F, x)), float(s[1] / max(s[0], 1e-300))


def _trimmed_hand_eye(T: Array, measured: Array, near: Array) -> Pair | None:
    """Hand-eye solution without the poses whose residual is far above the median; None if ambiguous."""
    rows = np.ones(len(T), dtype=bool)
    pair: Pair | None = None
    for _ in range(3):
        (W, F), ratio = hand_eye(T[rows], measured[rows], near)
        if ratio > 0.995:
            return None
        pair = (W, F)
        residual = np.linalg.norm((W @ T @ F)[:, :3, 3] - measured[:, :3, 3], axis=1)
        keep = residual <= OUTLIER_FACTOR * max(float(np.median(residual)), 1e-9)
        if np.array_equal(keep, rows) or keep.sum() < max(3, len(T) // 2):
            break
        rows = keep
    return pair


def _one_target(T: Array, p: Array, near: Array) -> list[tuple[Array, Array]]:
    """Candidates (world_T_base, x) of ``p = W T x`` for one target x on the flange."""
    n, R, t = len(T), T[:, :3, :3], T[:, :3, 3]
    starts = [near]
    if n >= 14:
        # per world axis a: p_a = sum_bc (W_ab x_c) R_bc + sum_b W_ab t_b + t_Wa
        A = np.concatenate([R.reshape(n, 9), t, np.ones((n, 1))], axis=1)
        solution = np.linalg.lstsq(A, p, rcond=1e-9)[0]
        W = solution[9:12].T
        if np.linalg.det(W) > 1e-6:
            W = _rotation(W)
            starts.insert(0, np.einsum("ba,abc->c", W.T, solution[:9].T.reshape(3, 3, 3)) / 3.0)
    reach = float(np.linalg.norm(t - t.mean(axis=0), axis=1).max(initial=0.0))
    starts += [0.3 * reach * np.array(s) for s in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))]
    found: list[tuple[float, Array, Array]] = []
    for x in starts:
        try:
            found.append(_alternate(T, p, x, near))
        except RobcalError:
            continue
        if found[-1][0] < 0.01 * max(reach, 1e-9):
            break
    found.sort(key=lambda f: f[0])
    return [(W, x) for _, W, x in found[:2]]


def _alternate(T: Array, p: Array, x: Array, near: Array) -> tuple[float, Array, Array]:
    """Fit W for fixed x and (x, t_W) for fixed turn in turn; returns the RMS residual, W, x."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    W, last, residual = np.eye(4), np.inf, np.inf
    for _ in range(60):
        W = tf.fit_frame(p, t + R @ x)
        x, origin = _separate(W[:3, :3], T, p, near)
        W = tf.frame(W[:3, :3], origin)
        residual = float(np.sqrt(np.mean((tf.transform(W, t + R @ x) - p) ** 2)))
        if last - residual < 1e-3 * residual:
            break
        last = residual
    return residual, W, x


def _separate(R_W: Array, T: Array, p: Array, near: Array) -> tuple[Array, Array]:
    """Point x (3,) on the flange and world origin (3,) of ``p = R_W (R_i x + t_i) + t_W``, by linear least squares.

    Along directions in which the flange turns less than :data:`LEAST_TURN`, x stays at ``near``.
    """
    A = R_W @ T[:, :3, :3]
    b = p - T[:, :3, 3] @ R_W.T
    centred = (A - A.mean(axis=0)).reshape(-1, 3)
    size, least = float(np.linalg.norm(centred, 2)), LEAST_TURN * np.sqrt(len(T))
    x = near
    if size > least:
        left = (b - b.mean(axis=0)).ravel() - centred @ near
        x = near + np.linalg.lstsq(centred, left, rcond=least / size)[0]
    return x, b.mean(axis=0) - A.mean(axis=0) @ x


def _with_turn(T: Array, measured: Array, W: Array, x: Array) -> Array:
    """flange_T_tool with translation x and the mean turn that the measured frames ask for."""
    turns = np.swapaxes((W @ T)[:, :3, :3], 1, 2) @ measured[:, :3, :3]
    return tf.frame(_rotation(turns.mean(axis=0)), x)


def _from_points(
    base_T_flange: Array, pose: Array, target: Array, p_tool: Array, p_world: Array, near: Array
) -> list[Pair]:
    out: list[Pair] = []
    ids, counts = np.unique(target, return_counts=True)
    places: dict[object, tuple[Array, Array]] = {}
    for main in ids[np.argsort(-counts)][:1]:
        rows = target == main
        for W, _ in _one_target(base_T_flange[pose[rows]], p_world[rows], near):
            places.clear()
            for other in ids:
                mine = target == other
                back = tf.transform(tf.invert(W @ base_T_flange[pose[mine]]), p_world[mine])
                places[other] = (np.median(back, axis=0), p_tool[mine][0])
            on_flange, in_tool = (np.array(v) for v in zip(*places.values(), strict=True))
            # turns that the targets leave open (about a point or a line) are any
            spread = (on_flange - on_flange.mean(axis=0)).T @ (in_tool - in_tool.mean(axis=0))
            R = _rotation(spread) if len(places) > 1 else np.eye(3)
            out.append((W, tf.frame(R, (on_flange - in_tool @ R.T).mean(axis=0))))
    return out


def _from_distances(T: Array, d: Array) -> list[Pair]:
    """Wire's origin c in the base and end x on the flange of ``d = |t + R x - c|``; the world is put at the wire."""
    n, R, t = len(T), T[:, :3, :3], T[:, :3, 3]
    found: list[tuple[float, Array, Array]] = []
    starts: list[tuple[Array, Array]] = []
    if n >= 17:
        b = d**2 - np.sum(t * t, axis=1)
        A = np.concatenate([2 * np.einsum("nij,ni->nj", R, t), -2 * t, -2 * R.reshape(n, 9), np.ones((n, 1))], axis=1)
        solution = np.linalg.lstsq(A, b, rcond=1e-9)[0]
        starts.append((solution[:3], solution[3:6]))
    reach = float(np.median(d))
    starts += [(np.zeros(3), reach * np.array(s) / np.linalg.norm(s)) for s in product((-1.0, 0.3, 1.0), repeat=3)]
    for x, c in starts:
        for _ in range(40):
            v = t + R @ x - c
            length = np.linalg.norm(v, axis=1)
            u = v / np.maximum(length, 1e-12)[:, None]
            A = np.concatenate([np.einsum("nij,ni->nj", R, u), -u], axis=1)
            A_damped = np.concatenate([A, 1e-6 * np.eye(6)])
            step = np.linalg.lstsq(A_damped, np.concatenate([d - length, np.zeros(6)]), rcond=1e-12)[0]
            x, c = x + step[:3], c + step[3:]
            if np.linalg.norm(step) < 1e-9:
                break
        residual = float(np.sqrt(np.mean((np.linalg.norm(t + R @ x - c, axis=1) - d) ** 2)))
        found.append((residual, x, c))
        if len(found) == 1 and residual < 0.005 * reach:
            break
    found.sort(key=lambda f: f[0])
    return [(tf.frame(np.eye(3), -c), tf.frame(np.eye(3), x)) for _, x, c in found[:2]]


def _all_frames(observations: Sequence[Observations]) -> tuple[NDArray[np.int64], Array] | None:
    """Measured frames of poses, from frames, from three or more points, or by resection; None if there are none."""
    pose: list[int] = []
    frames: list[Array] = []
    for o in observations:
        if isinstance(o, FrameObservations):
            pose += o.pose.tolist()
            frames += list(o.world_T_tool)
        elif isinstance(o, PointObservations):
            for k in np.unique(o.pose):
                rows = o.pose == k
                if rows.sum() >= 3:
                    try:
                        frames.append(tf.fit_frame(o.p_world[rows], o.p_tool[rows]))
                        pose.append(int(k))
                    except DegenerateGeometry:
                        continue
        elif isinstance(o, PixelObservations):
            for k, T in _resections(o):
                pose.append(k)
                frames.append(T)
    return (np.array(pose), np.array(frames)) if frames else None


def _resections(o: PixelObservations) -> list[tuple[int, Array]]:
    """Frames of a body of four or more targets in one image, by OpenCV's resection."""
    out: list[tuple[int, Array]] = []
    for k in np.unique(o.pose):
        for c in np.unique(o.camera[o.pose == k]):
            rows = (o.pose == k) & (o.camera == c)
            if rows.sum() < 4:
                continue
            ideal = normalise(o.cameras[int(c)], o.xy[rows])
            good = np.all(np.isfinite(ideal), axis=1)
            if good.sum() < 4:
                continue
            done, turn, shift = cv2.solvePnP(
                o.p_tool[rows][good], ideal[good], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
            )
            if done:
                camera_T_tool = tf.frame(tf.exp_so3(turn.ravel()), shift.ravel())
                out.append((int(k), tf.invert(o.camera_T_world[int(c)]) @ camera_T_tool))
    return out


def _all_points(observations: Sequence[Observations]) -> PointRows | None:
    parts: list[PointRows] = []
    for o in observations:
        if isinstance(o, PointObservations):
            parts.append((o.pose, o.target, o.p_tool, o.p_world))
        elif isinstance(o, FrameObservations):
            parts.append((o.pose, np.full(len(o.pose), -1), np.zeros((len(o.pose), 3)), o.world_T_tool[:, :3, 3]))
        elif isinstance(o, PixelObservations):
            parts.append(_intersections(o))
    parts = [p for p in parts if len(p[0])]
    if not parts:
        return None
    pose, target, p_tool, p_world = (np.concatenate(column) for column in zip(*parts, strict=True))
    return pose, target, p_tool, p_world


def _intersections(o: PixelObservations) -> PointRows:
    """Points seen by two or more cameras, as the points nearest to their rays."""
    rays: dict[tuple[int, tuple[float, ...]], list[tuple[Array, Array]]] = {}
    ideal = np.concatenate([np.zeros((len(o.pose), 2)), np.ones((len(o.pose), 1))], axis=1)
    for c, camera in enumerate(o.cameras):
        rows = o.camera == c
        ideal[rows, :2] = normalise(camera, o.xy[rows])
    for k in range(len(o.pose)):
        world_T_camera = tf.invert(o.camera_T_world[int(o.camera[k])])
        direction = world_T_camera[:3, :3] @ ideal[k]
        key = (int(o.pose[k]), tuple(o.p_tool[k]))
        rays.setdefault(key, []).append((world_T_camera[:3, 3], direction / np.linalg.norm(direction)))
    names: dict[tuple[float, ...], int] = {}
    rows_out = []
    for (pose, place), lines in rays.items():
        if len(lines) < 2:
            continue
        across = [np.eye(3) - np.outer(u, u) for _, u in lines]
        p = np.linalg.solve(sum(across), sum(P @ c for P, (c, _) in zip(across, lines, strict=True)))
        if np.all(np.isfinite(p)):
            rows_out.append((pose, names.setdefault(place, len(names)), place, p))
    if not rows_out:
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros((0, 3)), np.zeros((0, 3))
    columns = [np.array(column) for column in zip(*rows_out, strict=True)]
    return columns[0], columns[1], columns[2], columns[3]


def _orientations() -> list[Array]:
    """The 24 turns of a cube."""
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0:
                out.append(R)
    return out


def _rotation(M: Array) -> Array:
    """Nearest rotation of a matrix."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)
