"""What a diagnosis works on: recordings, their correlations, the fit, the result."""
