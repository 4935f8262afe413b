"""Targets of a station that carry each other's number, reported by the marks that the orientation had to leave out."""

from collections import Counter
from collections.abc import Mapping

import numpy as np
from scipy import stats

from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import project
from robcal.photogrammetry.station.contradictions import TARGET_SWAPPED
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.physics.cause import Array
from robcal.transforms import invert, transform

LEAST_MARKS = 5
LEAST_SHARE = 0.5
"""A target is suspect where at least so many of its marks, and this share of them, were left out."""
NEAR = 0.05
"""A mark belongs to another target if it misses its place by less than this share of the way to its own."""


def exchanged_targets(
    orientation: StationOrientation, marks: Mapping[str, StationMarks], given: Body
) -> tuple[ImageFinding, ...]:
    """Pairs of targets each of which is seen where the body has the other.

    Parameters
    ----------
    marks : all identified marks, also those left out. given : the body with the coordinates of its file.

    Weakness: only targets whose marks were left out are looked at; what the orientation took for shifted targets is
    judged from the shifts.
    """
    rejected = Counter(r.target for r in orientation.rejected if r.target >= 0)
    measured = Counter(int(t) for m in marks.values() for t in m.target)
    suspects = [t for t, n in rejected.items() if n >= max(LEAST_MARKS, LEAST_SHARE * measured[t])]
    suspects = [t for t in suspects if int(given.index([t])[0]) >= 0 and given.known[int(given.index([t])[0])]]
    if len(suspects) < 2:
        return ()
    residuals = np.array([[_exchange_residual(orientation, marks, given, a, b) for b in suspects] for a in suspects])
    found, taken = [], set()
    for i, first in enumerate(suspects):
        j = int(np.argmin(residuals[i]))
        mutual = int(np.argmin(residuals[j])) == i and i != j
        if (
            not mutual
            or first in taken
            or residuals[i, j] > NEAR * residuals[i, i]
            or residuals[j, i] > NEAR * residuals[j, j]
        ):
            continue
        second = suspects[j]
        taken |= {first, second}
        count = rejected[first] + rejected[second]
        off = np.sqrt(0.5 * (residuals[i, i] ** 2 + residuals[j, j] ** 2))
        kept = len(orientation.marks)
        before = float(np.sqrt((kept * orientation.rms_px**2 + count * 0.5 * off**2) / (kept + count)))
        # sign test: all these marks lie nearer to the other target, which chance does in half of them
        p_value = float(stats.binom.sf(count - 1, count, 0.5))
        found.append(
            ImageFinding(
                TARGET_SWAPPED,
                str(first),
                None,
                {"with": int(second)},
                {},
                p_value,
                (),
                (before, orientation.rms_px),
                TARGET_SWAPPED.describe(str(first), {"with": second}),
            )
        )
    return tuple(found)


def _exchange_residual(
    orientation: StationOrientation, marks: Mapping[str, StationMarks], given: Body, label: int, target: int
) -> float:
    """Median distance (px) of the marks labelled `label` from the image of `target`."""
    point = given.points[int(given.index([target])[0])]
    distances: list[Array] = []
    for c, name in enumerate(orientation.names):
        m = marks.get(name)
        if m is None:
            continue
        rows = np.flatnonzero((m.target == label) & np.isin(m.pose, orientation.poses))
        if not len(rows):
            continue
        exterior = orientation.world_T_exterior[orientation.exterior_of(c, m.pose[rows])]
        body = orientation.world_T_body[np.searchsorted(orientation.poses, m.pose[rows])]
        seen = project(orientation.cameras[c], transform(invert(exterior) @ body, np.tile(point, (len(rows), 1))))
        distances.append(np.linalg.norm(m.xy[rows] - seen, axis=1))
    return float(np.nanmedian(np.concatenate(distances))) if distances else np.inf
