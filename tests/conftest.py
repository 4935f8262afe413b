"""For all tests: properties are tried without a clock, and quick tests of single modules are marked ``unit``."""

from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("patient", deadline=None, print_blob=True)
settings.load_profile("patient")

HERE = Path(__file__).parent
UNIT = (
    "benchmarks",
    "calibration",
    "estimation",
    "physics",
    "photogrammetry/core",
    "photogrammetry/orientation",
    "robot",
    "test_errors.py",
    "test_transforms.py",
)
"""Folders and files of quick tests."""
LONG = ("calibration/test_poses.py", "calibration/test_coverage_battery.py", "robot/export")
"""Among them those that are not quick."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what lies where the quick tests are, and doctests."""
    for item in items:
        place = item.path.relative_to(HERE).as_posix() if item.path.is_relative_to(HERE) else ""
        quick = place.startswith(UNIT) and not place.startswith(LONG) and item.get_closest_marker("slow") is None
        if quick or isinstance(item, pytest.DoctestItem):
            item.add_marker(pytest.mark.unit)
