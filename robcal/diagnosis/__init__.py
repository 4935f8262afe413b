"""Diagnosis: noise, scan, location, naming, adequacy, gain on kept-out data, next poses."""
