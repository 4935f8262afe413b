"""The calibrated robot for controllers: C, programs."""
