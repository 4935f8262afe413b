"""Cameras that watch the robot: identification, start, adjustment, cleaning."""
