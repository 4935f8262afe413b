"""Points and frames of the measuring body in the world, with covariance."""
