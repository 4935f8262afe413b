"""Which intrinsics are held together where images do not determine them, and what may not be held."""

import pytest

from robcal.errors import NotIdentifiable
from robcal.photogrammetry.bundle.held_intrinsics import FreeIntrinsics, hold_undetermined
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera

START = Camera(2400, 1800, 3000.0, 3003.0, 1200.0, 900.0)
NOW = Camera(2400, 1800, 3100.0, 3150.0, 1210.0, 905.0, -0.1, 0.05, 1e-3, 2e-3, 0.01)
ALL = FreeIntrinsics(INTRINSIC_NAMES)


def _hold(
    bad: tuple[str, ...], free: FreeIntrinsics = ALL, *, hold_focal: bool = False
) -> tuple[FreeIntrinsics, Camera]:
    return hold_undetermined(bad, free, NOW, START, undetermined="leave_out", hold_focal=hold_focal)


def test_pairs_are_held_together_at_their_start_values() -> None:
    free, camera = _hold(("p2",))
    assert set(INTRINSIC_NAMES) - set(free.names) == {"p1", "p2"}
    assert (camera.p1, camera.p2) == (0.0, 0.0)
    assert camera.k1 == NOW.k1
    assert [name for name, _ in free.left_out] == ["p1", "p2"]


def test_only_the_first_group_is_held_at_a_time() -> None:
    free, camera = _hold(("k3", "cx", "cy"))
    assert "k3" not in free.names
    assert {"cx", "cy"} <= set(free.names)
    assert camera.cx == NOW.cx


def test_two_focal_lengths_become_one_before_anything_else() -> None:
    free, camera = _hold(("fy", "fx"))
    assert free.names[0] == "f"
    assert not {"fx", "fy"} & set(free.names)
    assert camera.fy / camera.fx == pytest.approx(START.fy / START.fx)


def test_focal_length_is_held_only_where_that_is_allowed() -> None:
    one = FreeIntrinsics(("f", "k1"))
    with pytest.raises(NotIdentifiable, match="focal length"):
        _hold(("f",), one)
    free, camera = _hold(("f",), one, hold_focal=True)
    assert free.names == ("k1",)
    assert (camera.fx, camera.fy) == (START.fx, START.fy)


def test_nothing_is_held_silently_where_that_is_an_error() -> None:
    with pytest.raises(NotIdentifiable, match="k3"):
        hold_undetermined(("k3",), ALL, NOW, START, undetermined="raise", hold_focal=True)
