"""Observation operators, identification, verification, measuring poses, mastering, cell, drift."""
