"""Compiled functions: the same on every way to them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from robcal.jit import compiled

_DETECT = """
import hashlib, numpy as np
from robcal.imaging.detect import detect_targets
from tests.imaging.rendering import Dot, expose, render

random = np.random.default_rng(3)
dots = [Dot(x + random.uniform(0, 1), y + random.uniform(0, 1), 6, 4.5, 0.4)
        for x in range(30, 370, 40) for y in range(30, 370, 40)]
found = detect_targets(expose(render(400, 400, dots), random))
print(len(found.xy), hashlib.sha256(found.xy.tobytes() + found.covariance.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_a_process_that_compiles_and_one_that_loads_give_the_same_bytes(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", _DETECT]
    runs = [subprocess.run(command, env=environment, capture_output=True, text=True, check=True) for _ in range(2)]
    assert runs[0].stdout.startswith("81 ")
    assert runs[0].stdout == runs[1].stdout


@pytest.mark.unit
def test_without_a_folder_for_the_cache_a_function_is_compiled_all_the_same() -> None:
    scope: dict = {}
    exec("def twice(x):\n    return 2 * x", scope)  # of no file: nothing beside which a cache could stand
    assert compiled(scope["twice"])(21) == 42
