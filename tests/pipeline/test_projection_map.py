"""The report's maps of the uncertainty of projection."""

import numpy as np

from pipeline.report.projection_map import of_station
from robcal.photogrammetry.station.orientation import orient_station
from tests.photogrammetry.stations import simulate


def test_every_camera_of_a_station_has_its_map() -> None:
    s = simulate(points=8, flat=False, poses=20)
    figures = of_station(orient_station(s.marks, s.body, s.rough, s.sizes))
    assert len(figures) == 2
    for figure, name in zip(figures, s.cameras, strict=True):
        assert name in figure.alt
        assert "NaN" not in figure.payload
        sigma = np.array(figure.data[0]["z"], dtype=float)
        # outside of what the marks cover the lens is known worse
        middle = sigma[sigma.shape[0] // 2, sigma.shape[1] // 2]
        assert 0 < middle < sigma.max() < 5.0
