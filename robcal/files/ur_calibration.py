"""Universal Robots' ``calibration.conf`` as the controller keeps it: deviations from the nominal table.

``[mounting]`` holds ``delta_theta``, ``delta_a``, ``delta_d`` and ``delta_alpha``, six values each (rad, m), which are
added to the standard Denavit-Hartenberg table of the arm's kind. That table is the section ``[DH]`` of the same file or
of ``urcontrol.conf`` beside it (``a``, ``d``, ``alpha``; on the controller both lie in one folder).

Weakness: axes 2 and 3 are parallel, so the maker's ``delta_d`` there may be metres with opposite signs: the chain is
right, single lengths mean little.
"""

import configparser
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robcal.errors import InvalidInput
from robcal.files.schemas import LARGEST
from robcal.files.storage import read_bytes
from robcal.robot.dh import DHRow

NOMINAL = "urcontrol.conf"
_MAX_BYTES = 1_000_000
_DELTAS = ("delta_theta", "delta_a", "delta_d", "delta_alpha")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def read_ur_calibration(path: Path) -> list[DHRow]:
    """The calibrated table of the arm.

    Raises
    ------
    InvalidInput : a value is missing, or no nominal table lies in the file or beside it.
    """
    own = _sections(path)
    if "mounting" not in own:
        raise InvalidInput(f"{path}: has no section [mounting]: is it the calibration.conf of the controller?")
    theta, a, d, alpha = (_six(path, own["mounting"], name) for name in _DELTAS)
    beside = path.with_name(NOMINAL)
    source, nominal = (path, own) if "dh" in own else (beside, _sections(beside) if beside.is_file() else {})
    if "dh" not in nominal:
        raise InvalidInput(
            f"{path}: holds deviations only: put {NOMINAL} of the same controller (its [DH] table) beside it"
        )
    table = {name: _six(source, nominal["dh"], name) for name in ("a", "d", "alpha")}
    return [DHRow(theta[k], table["d"][k] + d[k], table["a"][k] + a[k], table["alpha"][k] + alpha[k]) for k in range(6)]


def _sections(path: Path) -> dict[str, dict[str, str]]:
    parser = configparser.RawConfigParser(strict=False, comment_prefixes=("#", ";"), inline_comment_prefixes=("#",))
    try:
        parser.read_string(read_bytes(path, _MAX_BYTES).decode("utf-8-sig", errors="replace"))
    except configparser.Error as error:
        raise InvalidInput(f"{path}: no configuration of a controller: {' '.join(str(error).split())[:160]}") from None
    return {name.strip().lower(): dict(parser.items(name)) for name in parser.sections()}


def _six(path: Path, section: dict[str, str], name: str) -> Sequence[float]:
    text = section.get(name, "").strip()
    cells = [cell.strip() for cell in text.strip("[]").split(",")]
    if len(cells) != 6 or not all(_NUMBER.fullmatch(cell) for cell in cells):
        raise InvalidInput(f"{path}: {name} must be six numbers in brackets, found '{text[:60]}'")
    values = [float(cell) for cell in cells]
    if not np.all(np.abs(values) < LARGEST):
        raise InvalidInput(f"{path}: {name} holds a number beyond all measure: '{text[:60]}'")
    return values
