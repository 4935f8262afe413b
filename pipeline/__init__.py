"""Campaigns and runs: files, stages, command line."""

import os

# Read by OpenCV when it is loaded: an image header that promises more pixels than this is refused, not allocated.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(400_000_000))
os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
