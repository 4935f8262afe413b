"""Step by step from a scan to the causes that are accepted."""
