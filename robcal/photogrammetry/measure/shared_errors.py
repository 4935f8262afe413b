"""Errors that measured frames share through the station and the body, less what a robot's base and tool absorb.

The errors of cameras and body coordinates are the same in all poses. Most of what they do to the frames is a constant
frame on the left (the world) or on the right (the body), which every robot calibration estimates anyway. The rest, a
field that varies over the workspace, looks like robot physics: whoever weights the frames by their noise alone takes
it for such.
"""

import numpy as np

from robcal.photogrammetry.measure.frames import MeasuredFrames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.transforms import Array, adjoint, invert, skew


def frame_sensitivities(points: MeasuredPoints, frames: MeasuredFrames) -> tuple[Array, Array]:
    """Derivatives of the frames' right perturbation by what they share.

    Returns
    -------
    by_station : (n, 6, k) by the parameters of ``points.station_covariance`` (k = 0 where there is none).
    by_body : (n, 6, 3t) by the coordinates of the body's targets. Zero for frames from resections.
    """
    n, body = len(frames.pose), frames.body
    k = 0 if points.station_jacobian is None else points.station_jacobian.shape[2]
    by_station, by_body = np.zeros((n, 6, k)), np.zeros((n, 6, 3 * len(body)))
    if points.covariance is None:
        return by_station, by_body
    for i, pose in enumerate(frames.pose):
        rows = np.flatnonzero((points.pose == pose) & np.isin(points.target, frames.targets[i]))
        if frames.method[i] == "resection" or len(rows) < 3:
            continue
        R = frames.world_T_body[i, :3, :3]
        at = body.index(points.target[rows])
        B = np.concatenate([np.broadcast_to(R, (len(rows), 3, 3)), -R @ skew(body.points[at])], axis=2)
        BW = np.swapaxes(B, 1, 2) @ np.linalg.inv(points.covariance[rows])
        N = np.sum(BW @ B, axis=0)
        if points.station_jacobian is not None:
            by_station[i] = np.linalg.solve(N, np.sum(BW @ points.station_jacobian[rows], axis=0))
        gain = np.linalg.solve(N, BW @ R)  # a target that lies farther out than its file says pulls the frame back
        for row, target in enumerate(at):
            by_body[i, :, 3 * target : 3 * target + 3] -= gain[row]
    return by_station, by_body


def unabsorbed_covariance(points: MeasuredPoints, frames: MeasuredFrames) -> Array:
    """(n, 6, 6) what station and body add to the uncertainty of each frame beside a constant world and body frame.

    Weakness: only each pose's own block is returned; the correlation between poses, which makes these errors look
    smooth, has to be neglected by whoever weights pose by pose.
    """
    by_station, by_body = frame_sensitivities(points, frames)
    n = len(frames.pose)
    left = adjoint(invert(frames.world_T_body)).reshape(-1, 6)
    constant = np.concatenate([left, np.tile(np.eye(6), (n, 1))], axis=1)
    lower = np.linalg.inv(np.linalg.cholesky(frames.covariance))
    whitened = (lower @ constant.reshape(n, 6, 12)).reshape(-1, 12)
    Q = np.linalg.svd(whitened, full_matrices=False)
    basis = Q[0][:, Q[1] > 1e-9 * Q[1][0]]
    total = np.zeros((n, 6, 6))
    for K, covariance in ((by_station, points.station_covariance), (by_body, frames.body.covariance)):
        if covariance is None or K.shape[2] == 0:
            continue
        rest = (lower @ K).reshape(-1, K.shape[2])
        rest -= basis @ (basis.T @ rest)
        K_rest = np.linalg.solve(lower, rest.reshape(n, 6, -1))
        total += K_rest @ np.nan_to_num(covariance) @ np.swapaxes(K_rest, 1, 2)
    return total
