"""Faults in a recording, found before any statistics: each is reported only where correcting it proves itself.

A robot misses its nominal model by millimetres; a wrong sense, an exchanged column, a slipped row or a wrong unit by
decimetres. So the nominal robot with the best base and tool is enough to tell.
"""

from robcal.calibration.recording_errors.recorded import (
    Recorded,
    RecordingFault,
    empty_readings,
    frozen_readings,
    outside_limits,
)
from robcal.calibration.recording_errors.search import find_faults, mirror_residuals

__all__ = [
    "Recorded",
    "RecordingFault",
    "empty_readings",
    "find_faults",
    "frozen_readings",
    "mirror_residuals",
    "outside_limits",
]
