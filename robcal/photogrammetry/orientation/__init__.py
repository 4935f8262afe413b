"""Resection, relative and planar start orientations, forward intersection."""
