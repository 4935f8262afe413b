"""Generator of measuring poses: admissible, informative, as few as needed, in a short and balanced order."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.calibration.collision import HalfSpace, link_capsules, obstacle_clearance, place_capsules
from robcal.calibration.identification import IdentifyOptions, identify
from robcal.calibration.observations import FrameObservations
from robcal.calibration.pose_candidates import Cell, check_poses, find_candidates
from robcal.calibration.pose_choice import (
    Design,
    balanced_approaches,
    choose_d_optimal,
    choose_worst_case,
    covariance_of,
    exchange,
    joint_ranges,
    path_length,
    predicted_errors,
    short_order,
    spread,
)
from robcal.calibration.poses import PoseRequest, generate_poses
from robcal.calibration.visibility import Viewpoint, VisibilityRules, measurable, seen_targets
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.robot.chain import chain_of, forward
from robcal.robot.kernel import Kernel
from robcal.robot.model import Frame, RobotModel
from robcal.transforms import frame, frame_from_xyzrpy, retract, transform
from tests.robot.chains import kr_like

LIMITS = [(-3.0, 3.0), (-2.4, 0.2), (-2.0, 2.5), (-3.1, 3.1), (-2.1, 2.1), (-3.1, 3.1)]
MODEL = kr_like()
MODEL = replace(
    MODEL, frames=tuple(replace(f, limits=LIMITS[MODEL.joint_of(f.name)]) if f.axis else f for f in MODEL.frames)
)
PLATE = Body(
    "plate",
    np.arange(5),
    np.array([[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0], [0, 0, 0.06]]),
    diameters=np.full(5, 0.012),
)


def looking_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    z = np.subtract(target, eye)
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    return frame(np.stack([x, np.cross(z, x), z], axis=1), np.array(eye))


CAMERA = Camera(2448, 2048, 3600.0, 3600.0, 1223.5, 1023.5)
VIEWS = tuple(
    Viewpoint(name, CAMERA, looking_at((4.8, y, 1.6), (1.4, 0, 1.2))) for name, y in (("left", 1.2), ("right", -1.2))
)
CELL = Cell(
    np.eye(4),
    frame_from_xyzrpy([0, 0, 0.1, 0, 0, 0]),
    PLATE,
    VIEWS,
    VisibilityRules(),
    link_capsules(MODEL, 0.15),
    (HalfSpace((0, 0, 1), 0.0),),
)
REQUEST = PoseRequest(MODEL, CELL, count=24, verify=6, candidates=150, payload="dumbbell")


def small_design(seed: int = 0, n: int = 60, p: int = 8) -> Design:
    rng = np.random.default_rng(seed)
    return Design(rng.normal(size=(n, 6, p)) * rng.uniform(0.2, 3, (n, 1, 1)), rng.normal(size=(20, 3, p)))


@pytest.fixture(scope="module")
def plan():
    return generate_poses(REQUEST)


def test_every_pose_is_admissible(plan):
    chain = chain_of(MODEL)
    assert plan.q.shape == (30, 6)
    assert plan.verify.sum() == 6
    assert np.all((plan.q >= chain.lower) & (plan.q <= chain.upper))
    assert np.all((plan.via >= chain.lower) & (plan.via <= chain.upper))
    T = forward(chain, plan.q) @ CELL.flange_T_body
    assert plan.world_T_body == pytest.approx(T, abs=1e-12)
    placed = place_capsules(MODEL, plan.q, CELL.capsules)
    seen = seen_targets(T, PLATE, VIEWS, CELL.rules, placed)
    assert measurable(seen, CELL.rules).all()
    assert np.array_equal(seen.sum(axis=2), plan.seen)
    assert obstacle_clearance(placed, CELL.obstacles).min() > CELL.clearance
    assert check_poses(MODEL, CELL, plan.q).all()
    assert len(np.unique(np.round(plan.q, 9), axis=0)) == 30


def test_the_same_request_gives_the_same_poses(plan):
    assert np.array_equal(generate_poses(REQUEST).q, plan.q)


def test_approaches_are_balanced_and_real(plan):
    assert np.all(np.abs(plan.approach.sum(axis=0)) <= 1)
    assert np.all(plan.approach != 0)
    # the last movement before each pose has the stated direction
    before = np.vstack([plan.via[:1], plan.q[:-1]])
    moved = np.where(plan.via != plan.q, plan.q - plan.via, plan.q - before)
    assert np.array_equal(np.sign(moved).astype(int), plan.approach)


def test_optimal_poses_predict_less_error_than_equidistant_ones(plan):
    even = generate_poses(replace(REQUEST, method="equidistant"))
    worst = generate_poses(replace(REQUEST, method="worst_case"))
    assert plan.predicted[1] < even.predicted[1]
    assert worst.predicted[1] < even.predicted[1]


def test_as_few_poses_as_the_accuracy_needs():
    counts = []
    for accuracy in (3e-4, 1.5e-4):
        few = generate_poses(replace(REQUEST, method="worst_case", accuracy=accuracy, count=60, verify=0))
        assert few.reached
        assert few.predicted[1] <= accuracy
        counts.append(len(few.q))
    assert counts[0] < counts[1] < 60
    missed = generate_poses(replace(REQUEST, accuracy=1e-6, count=10, verify=0))
    assert not missed.reached
    assert len(missed.q) == 10


def test_predicted_error_is_that_of_an_identification():
    """The covariance of scaled parameters is the inverse of the normal matrix with the prior."""
    design = small_design()
    chosen = [3, 7, 7, 20]
    normal = np.eye(8) + sum(design.rows[k].T @ design.rows[k] for k in chosen)
    assert covariance_of(design, chosen) == pytest.approx(np.linalg.inv(normal), abs=1e-12)
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal(np.zeros(8), np.linalg.inv(normal), 20000)
    scatter = np.sqrt(np.mean(np.sum((design.checks @ draws.T) ** 2, axis=1), axis=1))
    assert predicted_errors(design, covariance_of(design, chosen)) == pytest.approx(scatter, rel=0.03)


def test_greedy_choices_beat_random_ones_and_exchange_improves():
    design = small_design(2)
    rng = np.random.default_rng(0)

    def volume(chosen: list[int]) -> float:
        return float(np.linalg.slogdet(covariance_of(design, chosen))[1])

    greedy = choose_d_optimal(design, 6)
    assert len(set(greedy)) == 6
    assert volume(greedy) < min(volume(list(rng.choice(60, 6, replace=False))) for _ in range(50))
    poor = list(range(6))
    better = exchange(design, poor)
    assert len(set(better)) == 6
    assert volume(better) < volume(poor)
    assert volume(exchange(design, greedy)) <= volume(greedy) + 1e-9
    worst = choose_worst_case(design, 6)

    def worst_error(chosen: list[int]) -> float:
        return float(np.max(predicted_errors(design, covariance_of(design, chosen))))

    random = [worst_error(list(rng.choice(60, 6, replace=False))) for _ in range(50)]
    assert worst_error(worst) < np.median(random)


def test_spread_takes_the_corners_first():
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 10, 5)), -1).reshape(-1, 2)
    chosen = grid[spread(grid, np.array([1.0, 10.0]), 5, start=12)]
    corners = {(0.0, 0.0), (1.0, 0.0), (0.0, 10.0), (1.0, 10.0)}
    assert {tuple(map(float, c)) for c in chosen[1:]} == corners


def test_order_is_much_shorter_than_random_and_a_permutation():
    rng = np.random.default_rng(3)
    q = rng.uniform(-1, 1, (50, 6))
    ranges = np.full(6, 2.0)
    order = short_order(q, ranges)
    assert sorted(order.tolist()) == list(range(50))
    assert path_length(q[order], ranges) < 0.75 * path_length(q, ranges)
    from_start = short_order(q, ranges, start=q[17])
    assert from_start[0] == 17


def test_order_on_a_line_is_the_line():
    q = np.array([[0.0], [3.0], [1.0], [4.0], [2.0]])
    assert short_order(q, np.ones(1)).tolist() == [0, 2, 4, 1, 3]


def test_approaches_respect_the_limits():
    model = RobotModel("one", (Frame("a", "z", limits=(0.0, 1.0)), Frame("end", xyz=(1, 0, 0))))
    chain = chain_of(model)
    q = np.array([[0.0], [1.0], [0.0], [0.5]])
    found = balanced_approaches(chain, q, np.random.default_rng(0))
    assert np.all((found.via >= 0) & (found.via <= 1))
    assert found.direction[0, 0] == -1
    assert found.direction[1, 0] == 1


def test_arm_without_cameras_and_with_a_sliding_joint():
    """A SCARA before a tracker: nothing to see, four joints of two kinds."""
    model = RobotModel(
        "scara",
        (
            Frame("a1", "z", limits=(-2, 2), xyz=(0, 0, 0.4)),
            Frame("a2", "z", limits=(-2.5, 2.5), xyz=(0.3, 0, 0)),
            Frame("quill", "z", True, -1, (0, 0.2), xyz=(0.3, 0, 0)),
            Frame("a4", "z", limits=(-3, 3)),
            Frame("flange", rpy=(np.pi, 0, 0)),
        ),
    )
    cell = Cell(np.eye(4), frame_from_xyzrpy([0.05, 0, 0.05, 0, 0, 0]))
    plan = generate_poses(PoseRequest(model, cell, count=15, candidates=80))
    assert plan.q.shape == (15, 4)
    assert plan.predicted[1] < 1e-3
    assert joint_ranges(chain_of(model), plan.q) == pytest.approx([4, 5, 0.2, 6])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"count": 0}, "positive"),
        ({"method": "best"}, "d_optimal, worst_case or equidistant"),
        ({"accuracy": -1.0}, "positive length"),
        ({"payload": "anvil"}, "known: dumbbell"),
        ({"margin": 0.7}, "margin"),
        ({"sigma_px": 0.0}, "positive"),
        ({"start": np.zeros(3)}, "6 joint values"),
        ({"count": 500}, "500 poses|506 poses"),
    ],
)
def test_bad_requests_are_refused(changes, words):
    with pytest.raises(InvalidInput, match=words):
        generate_poses(replace(REQUEST, **changes))


def test_cell_without_view_says_so():
    behind = tuple(Viewpoint(v.name, v.camera, looking_at((4.8, 0, 1.6), (9.0, 0.0, 1.2))) for v in VIEWS)
    with pytest.raises(InvalidInput, match="most fail by visibility"):
        find_candidates(MODEL, replace(CELL, viewpoints=behind), 5, np.random.default_rng(0), most=5000)


def test_predicted_accuracy_is_what_an_identification_reaches():
    """Robots drawn, measured at the planned poses and identified: their tool errors scatter as predicted."""
    cell = Cell(frame_from_xyzrpy([0.3, 0.2, 0.1, 0, 0.01, 0.5]), frame_from_xyzrpy([0.05, 0, 0.2, 0, 0.1, 0]))
    points = ((0.0, 0.0, 0.0), (0.2, 0.2, 0.4))
    request = PoseRequest(MODEL, cell, count=45, parameters="geometry", candidates=300, test_points=points)
    plan = generate_poses(request)
    rng = np.random.default_rng(8)
    kinds = ("x", "y", "z", "roll", "pitch", "yaw")
    elsewhere = find_candidates(MODEL, cell, 200, rng).q
    squares = []
    for _ in range(4):
        values = {f"{f.name}.{k}": 5e-4 * rng.normal() for f in MODEL.frames for k in kinds}
        real = replace(MODEL, world_T_base=cell.world_T_base, flange_T_tool=cell.flange_T_body).with_parameters(values)
        kernel = Kernel(real)
        T = kernel.frames(kernel.theta0, kernel.poses(plan.q))
        noise = rng.normal(size=(len(T), 6)) * np.repeat(request.sigma, 3)
        measured = FrameObservations.isotropic(retract(T, noise), *request.sigma)
        found = identify(MODEL, kernel.poses(plan.q), [measured], IdentifyOptions(parameters="geometry"))
        predicted, _ = found.predict(found.kernel.poses(elsewhere))
        truth = kernel.frames(kernel.theta0, kernel.poses(elsewhere))
        squares += [np.sum((transform(predicted, p) - transform(truth, p)) ** 2, axis=1) for p in points]
    reached = np.sqrt(np.mean(squares))
    assert reached == pytest.approx(plan.predicted[0], rel=0.2)
