"""Several instruments in one identification: each with a world and a tool of its own, all with the same robot."""

from robcal.calibration.instruments.cell_frame import CellFrame
from robcal.calibration.instruments.identification import identify_instruments
from robcal.calibration.instruments.instrument import Instrument
from robcal.calibration.instruments.result import IdentifiedInstruments, PlacedInstrument

__all__ = ["CellFrame", "IdentifiedInstruments", "Instrument", "PlacedInstrument", "identify_instruments"]
