"""State, files and page of a drift control; the method is in :mod:`robcal.drift`."""
