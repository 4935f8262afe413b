"""Least-squares estimation: iterations, robust weights, normal equations, covariance, reliability."""
