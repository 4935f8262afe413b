"""A wire's correction from outside: a function of a module beside campaign.yaml, or of an installed one."""

import importlib
import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from robcal.errors import InvalidInput
from robcal.recipe.wires import Correction
from robcal.transforms import Array


def module_file(name: str, folder: Path) -> list[Path]:
    """The file of a module beside the campaign, which is an input of the run; none of an installed one."""
    path = folder / f"{name.partition(':')[0]}.py"
    return [path] if path.is_file() else []


def load_correction(name: str, folder: Path, where: str) -> Correction:
    """The function ``module:function`` as one of metres; it takes and gives a length in mm.

    It is called with the length and with the direction (three numbers, of length one, in the wire's world) from where
    the wire leaves to the robot's point.

    Raises
    ------
    InvalidInput : no such module or function, or one that gives no length.
    """
    module, _, function = name.partition(":")
    if not module or not function:
        raise InvalidInput(f"{where}: correction '{name}' must be module:function")
    try:
        found: Any = getattr(_module(module, folder), function)
    except (ImportError, AttributeError, SyntaxError) as error:
        raise InvalidInput(f"{where}: correction '{name}' cannot be loaded: {error}") from None
    if not callable(found):
        raise InvalidInput(f"{where}: correction '{name}' is no function")
    return _in_metres(found, name, where)


def _in_metres(function: Callable[..., Any], name: str, where: str) -> Correction:
    def corrected(length: float, direction: Array) -> float:
        try:
            given = float(function(1e3 * length, tuple(map(float, direction))))
        except Exception as error:
            raise InvalidInput(f"{where}: correction '{name}' fails at {1e3 * length:.3f} mm: {error!r}") from error
        if not math.isfinite(given) or given <= 0:
            raise InvalidInput(f"{where}: correction '{name}' gives {given} for {1e3 * length:.3f} mm: no length")
        return given / 1e3

    return corrected


def _module(name: str, folder: Path) -> Any:
    files = module_file(name, folder)
    if not files:
        return importlib.import_module(name)
    spec = importlib.util.spec_from_file_location(name, files[0])
    if spec is None or spec.loader is None:
        raise ImportError(f"{files[0]} is no Python module")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
