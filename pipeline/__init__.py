"""Campaigns and runs: files, stages, command line."""
