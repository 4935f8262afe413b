"""Joint adjustment: exact derivatives, a robot whose covariance holds in the cameras' world, faults told."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from fixtures.own_files import make_own
from fixtures.own_station import OwnTruth, kept_out_frames
from pipeline.artifacts import IDENTIFICATION, MARKS, ORIENTATION
from pipeline.campaign_reader import read_campaign
from pipeline.json_io import read_json
from pipeline.runner import run_campaign
from pipeline.stages.identify import load_calibrated
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.errors import InvalidInput
from robcal.joint_adjustment.adjustment import adjust_jointly
from robcal.joint_adjustment.assembly import assemble
from robcal.joint_adjustment.result import JointAdjustment
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.transforms import difference
from tests.pipeline.conftest import edit_yaml


@dataclass(frozen=True)
class Campaign:
    """A recorded campaign, its station by itself, and the robot from that station's frames."""

    truth: OwnTruth
    log: JointLog
    marks: Mapping[str, StationMarks]
    orientation: StationOrientation
    staged: IdentifiedRobot
    rows: Rows

    def adjusted(self, **changes: object) -> JointAdjustment:
        now = replace(self, **changes)  # type: ignore[arg-type]
        return adjust_jointly(now.orientation, now.marks, now.staged, now.log, now.rows)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, OwnTruth]:
    """A small arm before two cameras, a tenth of the marks hidden, single targets in some images; the truth."""
    folder = tmp_path_factory.mktemp("joint")
    truth = make_own(
        folder / "campaign",
        seed=4,
        robot="ur10",
        poses=30,
        verify=4,
        kept_out=60,
        hidden=0.1,
        alone=0.1,
        joint_repeatability_rad=2e-5,
    )
    settings = {"diagnosis": {"enabled": False}, "model": {"adjustment": "joint"}}
    edit_yaml(folder / "campaign" / "campaign.yaml", lambda d: d.update(settings))
    return folder, truth


@pytest.fixture(scope="module")
def campaign(folder: tuple[Path, OwnTruth]) -> Campaign:
    """The campaign oriented and identified in stages."""
    place, truth = folder
    run = run_campaign(place / "campaign", place / "run", until="identify").run
    log, staged = read_campaign(place / "campaign").poses, run.load(IDENTIFICATION)
    assert log is not None
    return Campaign(truth, log, run.load(MARKS), run.load(ORIENTATION), staged.robot, np.flatnonzero(~log.verify))


@pytest.fixture(scope="module")
def found(campaign: Campaign) -> JointAdjustment:
    """The campaign adjusted jointly."""
    return campaign.adjusted()


def test_normal_equations_against_differences_of_the_cost(campaign: Campaign) -> None:
    problem, state, _ = assemble(campaign.orientation, campaign.marks, campaign.staged, campaign.log, campaign.rows)
    rng = np.random.default_rng(0)
    state = replace(state, scatter=rng.normal(0.0, 0.3, state.scatter.shape) * problem.tied[:, None])
    assert not problem.tied.all()  # kept-out poses orient the cameras only
    here = problem.at(state, None)
    normals = problem.normals(here, None)
    a, n = len(normals.b), len(normals.s)
    shared, own = 1.0 / np.sqrt(np.diag(normals.A)), 1.0 / np.sqrt(np.einsum("nii->ni", normals.V))

    def slope(step: np.ndarray, scatter: np.ndarray) -> float:
        """Of the cost along a step, by a difference."""
        ahead, behind = (problem.at(problem.moved(state, k * step, k * scatter), None) for k in (1e-3, -1e-3))
        return (ahead.half_cost - behind.half_cost) / 2e-3

    for k in range(0, a, 3):
        step = np.where(np.arange(a) == k, shared, 0.0)
        assert slope(step, np.zeros((n, 6))) == pytest.approx(-normals.b @ step, rel=2e-3, abs=5e-3)
    for i, k in ((0, 0), (3, 5), (int(np.flatnonzero(~problem.tied)[0]), 2)):
        step = np.zeros((n, 6))
        step[i, k] = own[i, k]
        assert slope(np.zeros(a), step) == pytest.approx(-np.sum(normals.s * step), rel=2e-3, abs=5e-3)


def test_second_derivatives_against_differences_of_the_right_side(campaign: Campaign, found: JointAdjustment) -> None:
    """Without residuals the derivative of the right side is the normal matrix: blocks of shared unknowns and poses."""
    problem, state, _ = assemble(found.orientation, campaign.marks, found.robot, campaign.log, campaign.rows)
    here = problem.at(state, None)
    exact = replace(problem, marks=replace(problem.marks, xy=problem.marks.xy - _pixels(here.lin)))
    here = exact.at(state, None)
    normals = exact.normals(here, None)
    a, n = len(normals.b), len(normals.s)
    unit = 1.0 / np.sqrt(np.diag(normals.A))
    rng = np.random.default_rng(1)
    for _ in range(4):
        step, scatter = 1e-2 * unit * rng.normal(size=a), 1e-3 * rng.normal(size=(n, 6))
        there = exact.normals(exact.at(exact.moved(state, step, scatter), None), None)
        back = exact.normals(exact.at(exact.moved(state, -step, -scatter), None), None)
        expected = normals.A @ step + np.einsum("nai,ni->a", normals.G, scatter)
        assert np.allclose(unit * (back.b - there.b) / 2, unit * expected, atol=2e-3 * np.abs(unit * expected).max())
        expected = np.einsum("nai,a->ni", normals.G, step) + np.einsum("nij,nj->ni", normals.V, scatter)
        assert np.allclose((back.s - there.s) / 2, expected, atol=2e-3 * np.abs(expected).max())


def test_the_stage_delivers_the_robot_that_the_library_finds(
    folder: tuple[Path, OwnTruth], campaign: Campaign, found: JointAdjustment
) -> None:
    done = run_campaign(folder[0] / "campaign", folder[0] / "run", until="adjust")
    assert done.ran == ("adjust",)
    section = read_json(done.run.result)["adjustment"]
    assert (section["kind"], section["poses"], section["marks"]) == ("joint", 30, found.marks)
    assert "adjusted jointly" in " ".join(done.result["notes"])
    assert np.allclose(load_calibrated(done.run).covariance, found.robot.covariance, rtol=1e-6, atol=0.0)
    assert (folder[0] / "run" / "cameras" / "joint" / "left.yaml").is_file()


def _pixels(lin) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Residuals (m, 2) in pixels."""
    return np.linalg.solve(lin.whitening, lin.residual[..., None])[..., 0]


def _exchange_residual(robot: CalibratedRobot, truth: OwnTruth) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 3) of the tool's place at the kept-out poses, and their stated covariance."""
    T, C = robot.predict(robot.kernel.poses(truth.kept_out.q, truth.kept_out.circumstances.payload))
    return difference(T, kept_out_frames(truth))[:, :3], C[:, :3, :3]


def _distance(robot: CalibratedRobot, truth: OwnTruth) -> float:
    return float(np.linalg.norm(_exchange_residual(robot, truth)[0], axis=1).mean())


def test_robot_and_cameras_stiffen_each_other(campaign: Campaign, found: JointAdjustment) -> None:
    assert found.summary.converged
    assert not found.loose
    assert len(found.rejected) <= 1
    assert found.marks > len(campaign.orientation.marks)  # marks of images that carry no pose by themselves
    assert 0.95 < found.sigma0 < 1.05
    assert 1e-5 < found.joint_sigma[0] < 4e-5
    assert _distance(found.robot, campaign.truth) < 0.5 * _distance(campaign.staged, campaign.truth)
    e = 6 * len(found.orientation.world_T_exterior)
    before, after = (np.diag(o.covariance)[6 : e + 4] for o in (campaign.orientation, found.orientation))
    assert np.all(after <= 1.5 * before)
    assert np.median(after / before) < 0.7


def test_covariance_holds_in_the_world_of_the_cameras(campaign: Campaign, found: JointAdjustment) -> None:
    square = [
        float(np.mean(np.einsum("ni,nij,nj->n", d, np.linalg.inv(C), d))) / 3.0
        for d, C in (_exchange_residual(robot, campaign.truth) for robot in (campaign.staged, found.robot))
    ]
    assert square[0] > 10.0  # what all frames share is not in the covariance of a robot from frames
    assert square[1] < 2.5


def test_a_pose_that_stands_elsewhere_is_told(campaign: Campaign) -> None:
    q = campaign.log.q.copy()
    moved = int(campaign.rows[7])
    q[moved, 1] += np.radians(0.05)
    found = campaign.adjusted(log=replace(campaign.log, q=q))
    assert moved in found.loose
    assert len(found.loose) <= 2
    assert _distance(found.robot, campaign.truth) < 0.5 * _distance(campaign.staged, campaign.truth)


def test_gross_errors_of_marks_are_told(campaign: Campaign) -> None:
    table, rng = campaign.orientation.marks, np.random.default_rng(3)
    rows = rng.choice(len(table), 8, replace=False)
    xy = table.xy.copy()
    xy[rows] += rng.choice([-1.0, 1.0], (8, 2)) * rng.uniform(1.0, 5.0, (8, 2))
    orientation = replace(campaign.orientation, marks=replace(table, xy=xy))
    found = campaign.adjusted(orientation=orientation)
    names, poses, ids = orientation.names, orientation.poses, orientation.body.ids
    wrong = {(names[table.camera[i]], int(poses[table.pose[i]]), int(ids[table.target[i]])) for i in rows}
    told = {(r.camera, r.pose, r.target) for r in found.rejected}
    assert wrong <= told
    assert len(told - wrong) <= 2
    assert _distance(found.robot, campaign.truth) < 0.5 * _distance(campaign.staged, campaign.truth)


def test_poses_of_the_robot_without_marks_are_refused(campaign: Campaign) -> None:
    with pytest.raises(InvalidInput, match="none is left"):
        campaign.adjusted(rows=np.zeros(0, dtype=np.int64))
