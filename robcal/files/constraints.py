"""Closed loops as a table: ``pose, constraint, kind, value_mm, sigma_mm``."""

from collections.abc import Mapping

import numpy as np

from robcal.calibration.closed_loops import KINDS
from robcal.files.tables import Table
from robcal.transforms import Array


def read_constraints(table: Table) -> tuple[np.ndarray, Mapping[str, str], Array, Array]:
    """Number (m,) of the constraint of each row, kinds by name in that order, values (m,) m and variances (m,) m2.

    ``value_mm`` is the height over a plane or the length of a bar; of a point it is not used and may be empty.

    Raises
    ------
    InvalidInput : an unknown kind, a constraint of two kinds, a bar without length, a pose twice in a constraint.
    """
    table.require(["pose", "constraint", "kind", "value_mm", "sigma_mm"])
    table.unique(["pose", "constraint"])
    names, kinds = table.texts("constraint"), table.texts("kind")
    known: dict[str, str] = {}
    for i, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        if kind not in KINDS:
            raise table.error(i, f"kind is '{kind[:40]}': a closed loop is a {', a '.join(KINDS)}")
        if known.setdefault(name, kind) != kind:
            raise table.error(i, f"constraint '{name}' is a {known[name]} before and a {kind} here: give it one kind")
    given = zip(kinds, table.columns["value_mm"], strict=True)
    cells = tuple("0" if kind == "point" and not cell else cell for kind, cell in given)
    values = Table(table.path, {**table.columns, "value_mm": cells}, table.rows).numbers("value_mm") / 1000
    for i, kind in enumerate(kinds):
        if kind == "length" and values[i] <= 0:
            raise table.error(i, f"value_mm is {1000 * values[i]:g}: the length of a bar is above zero")
    order = {name: k for k, name in enumerate(known)}
    number = np.array([order[name] for name in names], dtype=np.int64)
    return number, known, values, (table.numbers("sigma_mm", positive=True) / 1000) ** 2
