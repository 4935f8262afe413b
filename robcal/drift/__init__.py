"""Cyclic compensation of thermal drift by a sensor in the hand that looks at a body at rest."""
