"""What fixes the frame of a network: inner constraints over targets, or targets held at given coordinates.

Images alone leave seven freedoms: shift, turn and scale of body and stations together; scale bars take the scale.
Source: inner constraints (free network) after Granshaw (1980), Photogrammetric Record 10(56):181-207.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import linalg

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.core.network import IntArray, Lengths
from robcal.transforms import Array, skew


@dataclass(frozen=True)
class Datum:
    """Resolved datum of a network of t points.

    Attributes
    ----------
    kind : 'inner' constraints, or coordinates held 'fixed'.
    rows : rows of the points that carry it.
    scale : true if the scale too is a freedom to be constrained.
    description : for the report.
    """

    kind: Literal["inner", "fixed"]
    rows: IntArray
    scale: bool
    description: str

    @property
    def defect(self) -> int:
        """Number of inner constraints (0 where points are fixed)."""
        return 0 if self.kind == "fixed" else 6 + int(self.scale)

    def null_space(self, points: Array) -> Array:
        """(3t, defect) changes of the coordinates that no image can see: shift, turn about the centroid, scale."""
        centred = points - points[self.rows].mean(axis=0)
        reach = max(float(np.sqrt(np.mean(np.sum(centred**2, axis=1)))), 1e-12)
        unit = np.broadcast_to(np.eye(3), (len(points), 3, 3))
        blocks = [unit, -skew(centred) / reach]
        if self.scale:
            blocks.append(centred[:, :, None] / reach)
        return np.concatenate(blocks, axis=2).reshape(3 * len(points), -1)

    def constraints(self, points: Array) -> Array:
        """(3t, defect) orthonormal columns B; corrections dx of the coordinates obey ``B' dx = 0``."""
        B = self.null_space(points)
        mask = np.zeros(len(points), dtype=bool)
        mask[self.rows] = True
        B = B * np.repeat(mask, 3)[:, None]
        q, r = linalg.qr(B, mode="economic")
        if np.min(np.abs(np.diag(r))) < 1e-9 * np.max(np.abs(np.diag(r))):
            raise DegenerateGeometry(
                "the targets that should define the frame lie in one line: choose some that span a triangle"
            )
        return q


@dataclass(frozen=True)
class InnerOver:
    """Specification of inner constraints over some targets only (those whose given coordinates define the frame)."""

    ids: tuple[int, ...]


DatumSpec = Literal["free", "bars"] | tuple[int, ...] | InnerOver


def resolve_datum(spec: DatumSpec, ids: IntArray, points: Array, lengths: Lengths) -> tuple[Datum, str]:
    """The datum for a specification ('free', 'bars' or ids of fixed targets) and a note, '' if there is none.

    'bars': inner constraints over the end points of the scale bars; where these do not span a triangle (one bar), the
    free datum is taken instead and the note says so.

    Raises
    ------
    InvalidInput : unknown specification or ids.
    DegenerateGeometry : fewer than three fixed targets, or in one line.
    """
    known = {int(v): i for i, v in enumerate(ids)}
    scale = len(lengths) == 0
    everything = np.arange(len(ids), dtype=np.int64)
    if isinstance(spec, str):
        if spec == "free":
            return Datum("inner", everything, scale, "free network (inner constraints over all targets)"), ""
        if spec == "bars":
            rows = np.array(sorted({known[int(v)] for v in lengths.ids.ravel() if int(v) in known}), dtype=np.int64)
            if spans_triangle(points[rows]):
                return Datum("inner", rows, scale, "inner constraints over the targets of the scale bars"), ""
            note = "datum bars: the targets of the scale bars lie in one line, the free datum was taken instead"
            return Datum("inner", everything, scale, "free network (inner constraints over all targets)"), note
        raise InvalidInput(f"datum {spec!r} is unknown: give free, bars or the ids of fixed targets")
    if isinstance(spec, InnerOver):
        rows = np.array([known[int(v)] for v in spec.ids if int(v) in known], dtype=np.int64)
        if spans_triangle(points[rows]):
            return Datum("inner", rows, scale, f"inner constraints over {len(rows)} targets with given coordinates"), ""
        raise DegenerateGeometry("the targets that should define the frame do not span a triangle: name more of them")
    missing = sorted(int(v) for v in spec if int(v) not in known)
    if missing:
        raise InvalidInput(f"targets {missing} of the fixed datum are not measured in two images: choose other targets")
    rows = np.array([known[int(v)] for v in spec], dtype=np.int64)
    if not spans_triangle(points[rows]):
        raise DegenerateGeometry("a fixed datum needs three targets that span a triangle: name more of them")
    return Datum("fixed", rows, False, f"targets {sorted(int(v) for v in spec)} held fixed"), ""


def spans_triangle(points: Array) -> bool:
    """True if points (n, 3) are at least three and not in one line."""
    if len(points) < 3:
        return False
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(values[1] > 1e-3 * values[0])
