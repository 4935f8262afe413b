"""Compiled functions where there is no folder for them."""

import pytest

from robcal.jit import compiled

pytestmark = pytest.mark.unit


def test_without_a_folder_for_the_cache_a_function_is_compiled_all_the_same() -> None:
    scope: dict = {}
    exec("def twice(x):\n    return 2 * x", scope)  # of no file: nothing beside which a cache could stand
    assert compiled(scope["twice"])(21) == 42
