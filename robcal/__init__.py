"""robcal: photogrammetry, robot models, identification and diagnosis. Arrays and typed results, no files."""
