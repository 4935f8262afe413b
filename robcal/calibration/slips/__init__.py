"""Slips in a recording, found before any statistics: each is told only where mending it proves itself.

A robot misses its nominal model by millimetres; a wrong sense, an exchanged column, a slipped row or a wrong unit by
decimetres. So the nominal robot with the best base and tool is enough to tell.
"""

from robcal.calibration.slips.readings import empty_readings, frozen_readings
from robcal.calibration.slips.recorded import Recorded, Slip, outside_limits
from robcal.calibration.slips.search import find_slips, mirror_misses

__all__ = ["Recorded", "Slip", "empty_readings", "find_slips", "frozen_readings", "mirror_misses", "outside_limits"]
