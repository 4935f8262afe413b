"""Tangent columns of causes at a fit."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from robcal.diagnosis.core.fitting import fit
from robcal.diagnosis.scan.tangents import tangents
from robcal.physics.library import all_causes
from robcal.physics.site import RobotSite
from tests.diagnosis.recordings import concealed


def test_moved_base_and_moved_station_span_the_same_beside_common_errors(tmp_path: Path) -> None:
    # a law is multiplied to motions before errors common to all poses mix their rows
    found, recording, _, _ = concealed(tmp_path, seed=4, robot="ur10", poses=40, verify=5)
    rng = np.random.default_rng(1)
    recording = replace(recording, common=1e-3 * rng.standard_normal((len(recording.observations.pose), 3, 12)))
    present = fit(found.model, recording, found.names)
    at = tangents(present, recording)
    site = RobotSite(present.model, at.variables, frozenset(present.free), frozenset())
    causes = {f.name: f for f in all_causes(site, at.data, recording.ids, recording.body)}
    base, station = (at.columns(causes[name], {"pose": 20.0}) for name in ("base_moved", "camera_moved"))
    unit = station / np.linalg.norm(station, axis=0)
    Q = np.linalg.qr(base / np.linalg.norm(base, axis=0))[0]
    assert np.linalg.norm(unit - Q @ (Q.T @ unit), axis=0).max() < 1e-3
