"""Hand-eye calibration: a camera in the hand of a robot, or beside it, from images of a board."""
