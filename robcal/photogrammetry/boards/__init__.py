"""Printed boards as measuring bodies: layout, detection with identity, sub-pixel corners with covariance."""
