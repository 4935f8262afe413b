"""Causes that show in images."""
