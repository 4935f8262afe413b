"""Inside one image: blobs, sub-pixel ellipse centres with covariance, codes."""
