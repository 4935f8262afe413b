"""The recipe: how photogrammetry, identification and diagnosis are joined into one calibration."""
