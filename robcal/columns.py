"""Tables in columns: frozen dataclasses whose arrays have one row for each item."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Columns:
    """What all such tables can do; fields that are no arrays hold for the whole table and are kept."""

    def _arrays(self) -> dict[str, Any]:
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {name: value for name, value in fields.items() if isinstance(value, np.ndarray)}

    def select(self, rows: ArrayLike) -> Self:
        """The given rows (indices or mask)."""
        chosen = np.asarray(rows)
        return replace(self, **{name: column[chosen] for name, column in self._arrays().items()})

    def put(self, rows: ArrayLike, other: Self, chosen: ArrayLike = slice(None)) -> None:  # type: ignore[assignment]
        """The ``chosen`` rows of another table into ``rows`` of this one, in place."""
        for name, column in self._arrays().items():
            column[rows] = getattr(other, name)[chosen]

    def replaced(self, rows: ArrayLike, other: Self) -> Self:
        """A copy with ``rows`` taken from another table."""
        copy = replace(self, **{name: column.copy() for name, column in self._arrays().items()})
        copy.put(rows, other)
        return copy

    def joined(self, other: Self) -> Self:
        """The rows of this table, then those of the other."""
        return self.concatenated([self, other])

    @classmethod
    def concatenated(cls, parts: Sequence[Self]) -> Self:
        """The rows of all tables, one or more, in order."""
        first = parts[0]
        return replace(first, **{n: np.concatenate([getattr(p, n) for p in parts]) for n in first._arrays()})
