"""The errors raised on purpose."""

import pytest

from robcal.errors import DegenerateGeometry, InvalidInput, NotIdentifiable, RobcalError


@pytest.mark.parametrize("kind", [InvalidInput, DegenerateGeometry, NotIdentifiable])
def test_all_are_robcal_errors(kind: type[RobcalError]) -> None:
    with pytest.raises(RobcalError, match="what to do"):
        raise kind("what to do")


def test_not_identifiable_names_its_parameters() -> None:
    error = NotIdentifiable("fx and fy cannot be told from the distance", ["fx", "fy"])
    assert error.parameters == ("fx", "fy")
    assert NotIdentifiable("nothing named").parameters == ()
