"""Laser sensors near what they measure: raw readings to points, and their calibration."""
