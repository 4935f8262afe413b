"""Maps of how uncertain a calibrated camera's projection is over its image."""

import numpy as np

from pipeline.report.blocks import Block, Figure
from pipeline.report.style import layout, number, rounded
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.network import CameraNetwork
from robcal.photogrammetry.core.projection_uncertainty import projection_uncertainty
from robcal.photogrammetry.station.network import StationOrientation
from robcal.transforms import Array, invert, transform


def of_survey(name: str, network: CameraNetwork) -> list[Block]:
    """The map of a survey's camera at the distance of its targets."""
    depth = transform(network.camera_T_body[:, None], network.points)[..., 2]
    return _figure(f"survey of {name}", network.camera, network.intrinsics_covariance, float(np.median(depth)))


def of_station(station: StationOrientation) -> list[Block]:
    """The maps of a station's cameras at the distance of the body."""
    blocks: list[Block] = []
    for c, (name, camera) in enumerate(zip(station.names, station.cameras, strict=True)):
        stand = station.world_T_exterior[int(np.argmax(station.exterior_camera == c))]
        depth = transform(invert(stand), station.world_T_body[:, :3, 3])[:, 2]
        interior = station.camera_covariance(name)[1]
        blocks += _figure(f"camera {name}", camera, interior, float(np.median(depth)))
    return blocks


def _figure(name: str, camera: Camera, covariance: Array, distance: float) -> list[Block]:
    if not distance > 0 or not np.any(np.diag(covariance) > 0):
        return []  # all of it is held: nothing is known of its uncertainty
    found = projection_uncertainty(camera, covariance, distance)
    micrometres = 1e6 * found.pixel
    low, high = float(np.nanmin(found.sigma)), float(np.nanmax(found.sigma))
    data = {
        "type": "heatmap",
        "x": rounded(found.x),
        "y": rounded(found.y),
        "z": [rounded(row, 3) for row in found.sigma],
        "colorscale": "Cividis",
        "colorbar": {"title": {"text": "px"}},
        "name": name,
        "hovertemplate": "%{x:.0f}, %{y:.0f} px: %{z:.3g} px<extra></extra>",
    }
    tight = {"constrain": "domain"}
    shape = layout("x (px)", "y (px)", xaxis=tight, yaxis=tight | {"autorange": "reversed", "scaleanchor": "x"})
    told = (
        f"Uncertainty of projection, {name}, at {number(distance)} m: {number(low, 2)} to {number(high, 2)} px (one "
        f"standard deviation), {number(low * micrometres, 2)} to {number(high * micrometres, 2)} µm there, without "
        "what a motion of the camera takes up."
    )
    return [Figure((data,), shape, told, f"Map of the uncertainty of projection over the image, {name}", height=380)]
