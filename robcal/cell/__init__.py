"""The cell around a calibrated robot: its tool, objects and base from touches, and the robot as measuring machine."""
