"""Kinds of causes that a station's adjustment finds and frees by itself."""

from robcal.cause import Kind

CAMERA_MOVED = Kind(
    "camera_moved",
    "camera",
    "camera that moved",
    "Camera {where} moved before pose {pose}",
    of_station=True,
    moves="camera",
    of_order=True,
)
TARGET_SHIFTED = Kind(
    "target_shifted",
    "body",
    "shifted target",
    "Target {where} sits at another place than its file says, by {shift_mm} mm",
    moves="target",
)
TARGET_SWAPPED = Kind(
    "target_swapped",
    "body",
    "swapped targets",
    "Targets {where} and {with} carry each other's number",
    is_relabelling=True,
)
IMAGE_REJECTED = Kind("image_rejected", "image", "single image that contradicts the others")
_LEFT_OUT = "The lens of camera {where} has %s that its file leaves out"
LENS_RADIAL = Kind(
    "lens_radial",
    "camera",
    "radial distortion of the lens",
    _LEFT_OUT % "radial distortion",
    intrinsics=("k1", "k2", "k3"),
)
LENS_TANGENTIAL = Kind(
    "lens_tangential",
    "camera",
    "tangential distortion of the lens",
    _LEFT_OUT % "tangential distortion",
    intrinsics=("p1", "p2"),
)
LENS_AFFINITY = Kind(
    "lens_affinity",
    "camera",
    "affinity of the image",
    "The pixels of camera {where} are not square: fy differs from fx by {fy_minus_fx_px:.2f} px",
    intrinsics=("fx", "fy"),
)
LENS_KINDS = (LENS_RADIAL, LENS_TANGENTIAL, LENS_AFFINITY)
