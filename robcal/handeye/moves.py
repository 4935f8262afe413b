"""A board or a camera that was pushed while the images were taken: from some image on it stands elsewhere."""

from dataclasses import dataclass

import numpy as np

from robcal.transforms import Array, difference, invert, retract

LEAST_GAIN = 0.5
"""Share of what the images miss by that a move must take away to be believed."""


@dataclass(frozen=True)
class Jump:
    """``kind`` 'board' or 'camera', ``image`` first one after, ``early`` true where the earlier ones were displaced.

    ``change`` (6,) right twist of Z (board) or X (camera) from the images that the start fits to the others.
    """

    kind: str
    image: int
    early: bool
    change: Array
    gain: float


def find_jump(views: Array, measured: Array, lever: float) -> Jump | None:
    """A jump so large that the start fits the images on one side of it only; None if there is none.

    Parameters
    ----------
    views, measured : (n, 4, 4) ``camera_T_board`` as the start predicts it and of single images (NaN where none).
    lever : m, by which turns count as ways.
    """
    rows = np.flatnonzero(np.isfinite(measured).all(axis=(1, 2)))
    if len(rows) < 6:
        return None
    # a board displaced by D sits at views D, a camera displaced by D sees inverse(D) views
    twists = {
        "board": difference(views[rows], measured[rows]),
        "camera": difference(invert(views[rows]), invert(measured[rows])),
    }
    best: Jump | None = None
    for kind, twist in twists.items():
        size = _size(twist, lever)
        scale = max(float(np.quantile(size, 0.35)), 1e-6)
        nothing = float(np.sum(_capped(size / scale)))
        for k in range(2, len(rows) - 1):
            for early in (False, True):
                late = np.arange(len(rows)) >= k
                moved = ~late if early else late
                change = np.median(twist[moved], axis=0)
                left = _capped(_size(twist - moved[:, None] * change, lever) / scale)
                gain = 1.0 - float(np.sum(left)) / max(nothing, 1e-300)
                if best is None or gain > best.gain:
                    best = Jump(kind, int(rows[k]), early, change, gain)
    return best if best is not None and best.gain > LEAST_GAIN else None


def moved_frames(frame: Array, jump: Jump) -> Array:
    """(2, 4, 4) a frame before and after a jump, of the one that fits the other images."""
    other = retract(frame, jump.change)
    return np.array([other, frame] if jump.early else [frame, other])


def _size(twist: Array, lever: float) -> Array:
    return np.sqrt(np.sum(twist[:, :3] ** 2, axis=1) + lever**2 * np.sum(twist[:, 3:] ** 2, axis=1))


def _capped(size: Array) -> Array:
    return np.minimum(size**2, 36.0)
