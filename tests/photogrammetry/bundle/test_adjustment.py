"""Bundle adjustment against truth: derivatives, uncertainty, datum, gross errors, what cannot be determined."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

from robcal.errors import DegenerateGeometry, InvalidInput, NotIdentifiable
from robcal.estimation.schur import Factor
from robcal.photogrammetry.bundle.adjustment import AdjustSettings, adjust
from robcal.photogrammetry.bundle.datum import Datum, InnerOver
from robcal.photogrammetry.bundle.determinacy import intrinsics_basis
from robcal.photogrammetry.bundle.normals import MarkOrder, State, build_normals, linearise, linearise_lengths
from robcal.photogrammetry.bundle.solver import Bars, Problem, minimise
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera, project
from robcal.photogrammetry.core.network import CameraNetwork, ImageMarks, Lengths
from robcal.transforms import retract, transform
from tests.photogrammetry.networks import Truth, aligned_error, make_network


def near(truth: Truth, rng: np.random.Generator) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Approximate values as a start network leaves them."""
    c = truth.camera
    camera = Camera(c.width, c.height, 1.02 * c.fx, 1.02 * c.fx, (c.width - 1) / 2, (c.height - 1) / 2)
    poses = retract(truth.camera_T_body, rng.normal(0, 0.004, (len(truth.camera_T_body), 6)))
    return camera, poses, truth.points + rng.normal(0, 0.003, truth.points.shape)


def adjusted(truth: Truth, rng: np.random.Generator, **more: object) -> CameraNetwork:
    return adjust(truth.marks, *near(truth, rng), **more)  # type: ignore[arg-type]


def length_of(truth: Truth, i: int, j: int) -> float:
    return float(np.linalg.norm(truth.points[i] - truth.points[j]))


def test_normal_equations_against_a_dense_solution() -> None:
    """Step, cofactors of all unknowns and the datum, against plain dense matrices and differences."""
    rng = np.random.default_rng(0)
    truth = make_network(rng, images=4, targets=9)
    basis = intrinsics_basis(("fx", "fy", "cx", "k1"))
    marks = truth.marks
    n, t, k = 4, 9, 4
    order = MarkOrder(marks, n, t)
    state = State(truth.camera, truth.camera_T_body, truth.points)
    shift = np.zeros((len(marks), 2))
    lin = linearise(state, order, basis, shift)

    def residuals(x: np.ndarray) -> np.ndarray:
        moved = state.moved(basis, x[: k + 3 * t], x[k + 3 * t :].reshape(n, 6))
        p = transform(moved.camera_T_body[order.marks.image], moved.points[order.marks.target])
        return ((order.marks.xy - project(moved.camera, p)) / truth.sigma).ravel()

    size = k + 3 * t + 6 * n
    steps = np.full(size, 1e-6)
    steps[:3] = 1e-3
    J = np.stack(
        [-(residuals(h * e) - residuals(-h * e)) / (2 * h) for h, e in zip(steps, np.eye(size), strict=True)], 1
    )
    dense = np.zeros((len(marks), 2, size))
    for row, (i, j) in enumerate(zip(order.marks.image, order.marks.target, strict=True)):
        dense[row, :, :k] = lin.J[row, :, :k]
        dense[row, :, k + 3 * j : k + 3 * j + 3] = lin.J[row, :, k : k + 3]
        dense[row, :, k + 3 * t + 6 * i : k + 3 * t + 6 * i + 6] = lin.J[row, :, k + 3 :]
    dense = dense.reshape(-1, size)
    np.testing.assert_allclose(dense, J, rtol=1e-4, atol=1e-3)

    rows = np.array([[0, 5], [2, 7]])
    bars = linearise_lengths(truth.points, rows, np.array([0.3, 0.4]), np.array([1e-5, 2e-5]))
    bar_J = np.zeros((2, size))
    for b, (i, j) in enumerate(rows):
        bar_J[b, k + 3 * i : k + 3 * i + 3] = bars.direction[b]
        bar_J[b, k + 3 * j : k + 3 * j + 3] = -bars.direction[b]
    A = np.vstack([dense, bar_J])
    r = np.concatenate([lin.r.ravel(), bars.r])
    datum = Datum("inner", np.arange(t), False, "")
    B = np.zeros((size, 6))
    B[k : k + 3 * t] = datum.constraints(truth.points)
    bordered = np.block([[A.T @ A, 1e6 * B], [1e6 * B.T, np.zeros((6, 6))]])
    inverse = np.linalg.inv(bordered)[:size, :size]
    step = np.linalg.solve(bordered, np.concatenate([A.T @ r, np.zeros(6)]))[:size]

    normals = build_normals(lin, None, order, bars)
    factor = Factor(normals, datum.constraints(truth.points))
    dx, ds = factor.solve(normals.b, normals.s)
    scale = np.sqrt(np.diag(inverse))
    np.testing.assert_allclose(np.concatenate([dx, ds.ravel()]) / scale, step / scale, atol=1e-4)
    Q = factor.cofactors(datum.null_space(truth.points))
    Q_station, Q_mixed = factor.station_cofactors(Q)
    a = k + 3 * t
    unit = np.outer(scale, scale)
    np.testing.assert_allclose(Q / unit[:a, :a], inverse[:a, :a] / unit[:a, :a], atol=1e-5)
    np.testing.assert_allclose(Q_mixed.reshape(a, -1) / unit[:a, a:], inverse[:a, a:] / unit[:a, a:], atol=1e-5)
    for i in range(n):
        at = slice(a + 6 * i, a + 6 * i + 6)
        np.testing.assert_allclose(Q_station[i] / unit[at, at], inverse[at, at] / unit[at, at], atol=1e-5)


def test_the_minimum_is_that_of_an_independent_solver() -> None:
    rng = np.random.default_rng(1)
    truth = make_network(rng, images=5, targets=10)
    free = ("fx", "fy", "cx", "cy", "k1")
    start = truth.camera.with_vector([*truth.camera.vector[:5], 0.08, 2e-4, -3e-4, -0.01])
    net = adjust(
        truth.marks,
        start,
        truth.camera_T_body,
        truth.points,
        free_intrinsics=free,
        settings=AdjustSettings(snooping=False, robust=False),
    )
    basis = intrinsics_basis(free)
    state = State(start, truth.camera_T_body, truth.points)

    def fun(x: np.ndarray) -> np.ndarray:
        moved = state.moved(basis, x[:35] * np.r_[[100.0] * 4, [0.1] * 31], 0.1 * x[35:].reshape(5, 6))
        p = transform(moved.camera_T_body[truth.marks.image], moved.points[truth.marks.target])
        return ((truth.marks.xy - project(moved.camera, p)) / truth.sigma).ravel()

    best = optimize.least_squares(fun, np.zeros(65), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert net.summary.converged
    np.testing.assert_allclose(0.5 * np.sum((net.residuals / truth.sigma) ** 2), best.cost, rtol=1e-7)


@pytest.mark.parametrize("body", ["plate", "sphere"])
def test_estimated_uncertainty_is_the_true_one(body: str) -> None:
    """Normalised estimation error squared per degree of freedom over a small Monte Carlo."""
    rng = np.random.default_rng(7)
    truth = make_network(rng, body, images=16, targets=24 if body == "plate" else 45)
    clean = replace(truth.marks, xy=truth.marks.xy)
    p = transform(truth.camera_T_body[clean.image], truth.points[clean.target])
    exact = project(truth.camera, p)
    runs, points, intrinsics, stations = 24, 0.0, 0.0, 0.0
    bar = Lengths([[0, 5], [3, 9]], [length_of(truth, 0, 5), length_of(truth, 3, 9)], [2e-6, 2e-6])
    for _ in range(runs):
        marks = replace(truth.marks, xy=exact + rng.normal(0, truth.sigma, exact.shape))
        lengths = replace(bar, length=bar.length + rng.normal(0, bar.sigma))
        net = adjust(
            marks,
            truth.camera,
            truth.camera_T_body,
            truth.points,
            lengths=lengths,
            settings=AdjustSettings(robust=False, snooping=False),
        )
        e = aligned_error(net.points, truth.points[net.ids], scale=False).ravel()
        points += e @ np.linalg.pinv(net.points_covariance, rcond=1e-10, hermitian=True) @ e / (e.size - 6)
        d = net.camera.vector - truth.camera.vector
        intrinsics += d @ np.linalg.solve(net.intrinsics_covariance, d) / 9
        stations += float(np.mean(net.w**2))
    assert 0.8 < points / runs < 1.2
    assert 0.7 < intrinsics / runs < 1.35  # 216 degrees of freedom
    assert 0.9 < stations / runs < 1.1


def test_sigma0_and_redundancy_numbers() -> None:
    rng = np.random.default_rng(2)
    truth = make_network(rng, images=12, targets=20)
    doubted = replace(truth.marks, covariance=truth.marks.covariance / 4.0)
    start, bar = near(truth, rng), Lengths([[0, 19]], [length_of(truth, 0, 19)], [1e-6])
    net = adjust(doubted, *start, lengths=bar)
    m = len(net.marks)
    assert net.redundancy_total == 2 * m + 1 - 9 - 6 * 12 - 3 * 20 + 6
    np.testing.assert_allclose(net.redundancy.sum(), net.redundancy_total, atol=1e-3)
    assert (net.redundancy > 0).all()
    assert (net.redundancy < 1).all()
    assert abs(net.sigma0 - 2.0) < 0.25
    assert abs(net.sigma0_px / truth.sigma - 1.0) < 0.12
    honest = adjust(truth.marks, *start, lengths=bar)
    # stated twice too small or right: the same covariance comes out
    np.testing.assert_allclose(net.points_covariance, honest.points_covariance, rtol=1e-3, atol=1e-14)


def test_correlated_marks_keep_their_correlation() -> None:
    rng = np.random.default_rng(3)
    truth = make_network(rng, images=12, targets=25)
    C = truth.sigma**2 * np.array([[4.0, 1.5], [1.5, 1.0]])
    p = transform(truth.camera_T_body[truth.marks.image], truth.points[truth.marks.target])
    noise = rng.multivariate_normal([0, 0], C, len(p))
    marks = replace(truth.marks, xy=project(truth.camera, p) + noise, covariance=np.tile(C, (len(p), 1, 1)))
    net = adjust(marks, *near(truth, rng))
    assert 0.9 < net.sigma0 < 1.1
    assert 0.9 < np.mean(net.w**2) < 1.1
    assert 0.9 < np.mean(net.statistic) / 2.0 < 1.1


def test_free_network_is_the_same_in_every_datum() -> None:
    rng = np.random.default_rng(4)
    truth = make_network(rng, images=10, targets=16)
    start = near(truth, rng)
    pair = Lengths([[0, 9]], [length_of(truth, 0, 9)], [1e-6])
    nets = [
        adjust(truth.marks, *start, lengths=pair),
        adjust(truth.marks, *start, lengths=pair, datum=InnerOver((0, 3, 9, 12))),
    ]
    moved = retract(np.eye(4), [5.0, -3.0, 1.0, 0.4, 0.2, -0.7])
    poses = start[1] @ np.linalg.inv(moved)
    nets.append(adjust(truth.marks, start[0], poses, transform(moved, start[2]), lengths=pair))
    first = nets[0]
    for net in nets[1:]:
        np.testing.assert_allclose(aligned_error(net.points, first.points, scale=False), 0.0, atol=1e-9)
        np.testing.assert_allclose(net.residuals, first.residuals, atol=1e-6)
        np.testing.assert_allclose(net.redundancy, first.redundancy, atol=1e-6)
        np.testing.assert_allclose(net.intrinsics_covariance, first.intrinsics_covariance, rtol=1e-4, atol=1e-18)
        # what does not depend on the frame: the variance of a distance
        for a, b in ((1, 14), (2, 7)):
            u = first.points[a] - first.points[b]
            v = net.points[a] - net.points[b]
            np.testing.assert_allclose(_distance_variance(net, a, b, v), _distance_variance(first, a, b, u), rtol=1e-4)
    # the free datum has the smallest trace
    assert np.trace(first.points_covariance) <= np.trace(nets[1].points_covariance) * (1 + 1e-9)


def _distance_variance(net: CameraNetwork, a: int, b: int, u: np.ndarray) -> float:
    J = np.zeros((len(net.ids), 3))
    J[a], J[b] = u / np.linalg.norm(u), -u / np.linalg.norm(u)
    return float(J.ravel() @ net.points_covariance @ J.ravel())


def test_fixed_datum_holds_its_targets() -> None:
    rng = np.random.default_rng(5)
    truth = make_network(rng, images=10, targets=16)
    camera, poses, points = near(truth, rng)
    fixed = (0, 3, 12, 15)
    points[list(fixed)] = truth.points[list(fixed)]
    net = adjust(truth.marks, camera, poses, points, datum=fixed)
    np.testing.assert_array_equal(net.points[list(fixed)], truth.points[list(fixed)])
    assert (net.points_sigma[list(fixed)] == 0).all()
    free = np.setdiff1d(np.arange(16), fixed)
    assert (net.points_sigma[free] > 0).all()
    e = (net.points - truth.points)[free].ravel()
    rows = (3 * free[:, None] + np.arange(3)).ravel()
    chi2 = e @ np.linalg.solve(net.points_covariance[np.ix_(rows, rows)], e)
    assert stats.chi2.sf(chi2, e.size) > 1e-4
    assert net.redundancy_total == 2 * len(net.marks) - 9 - 60 - 36


def test_gross_errors_and_a_wrong_id_are_found() -> None:
    rng = np.random.default_rng(6)
    truth = make_network(rng, images=14, targets=25)
    xy, target = truth.marks.xy.copy(), truth.marks.target.copy()
    bad = [30, 117, 220]
    xy[bad] += [[0.6, 0.0], [-0.5, 0.5], [4.0, -9.0]]
    swap = np.flatnonzero(truth.marks.image == 5)[:2]
    target[swap] = target[swap[::-1]]
    net = adjust(replace(truth.marks, xy=xy, target=target), *near(truth, rng))
    found = {(r.image, r.target) for r in net.rejected}
    expected = {(str(truth.marks.image[b]), int(target[b])) for b in [*bad, *swap]}
    assert expected <= found
    assert len(found) <= len(expected) + 1
    assert 0.9 < net.sigma0 < 1.1
    e = aligned_error(net.points, truth.points, scale=True)
    assert np.sqrt(np.mean(e**2)) < 3e-5


def test_clean_data_lose_almost_nothing() -> None:
    rejected = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        rejected += len(adjusted(make_network(rng, images=8, targets=12), rng).rejected)
    assert rejected <= 1


def test_variance_components_of_two_groups() -> None:
    rng = np.random.default_rng(8)
    truth = make_network(rng, images=14, targets=30)
    group = (truth.marks.image >= 7).astype(int)
    p = transform(truth.camera_T_body[truth.marks.image], truth.points[truth.marks.target])
    noise = rng.normal(size=truth.marks.xy.shape) * truth.sigma * np.where(group, 3.0, 0.5)[:, None]
    marks = replace(truth.marks, xy=project(truth.camera, p) + noise, group=group)
    net = adjust(marks, *near(truth, rng), settings=AdjustSettings(snooping=False))
    np.testing.assert_allclose(net.group_sigma0, [0.5, 3.0], rtol=0.1)
    # nine bars that scatter four times more than certified
    pairs = [[0, 29], [1, 28], [2, 27], [3, 26], [4, 25], [5, 24], [0, 5], [24, 29], [2, 12]]
    true = np.array([length_of(truth, i, j) for i, j in pairs])
    scatter = np.array([1.3, -1.0, 0.4, 1.6, -0.7, -1.2, 0.8, -1.1, 0.3])
    bars = Lengths(pairs, true + 4 * 2e-4 * scatter, np.full(9, 2e-4))
    net = adjust(truth.marks, *near(truth, rng), lengths=bars, settings=AdjustSettings(bars_contradiction=30.0))
    assert 2.5 < net.bars_sigma0 < 6.5


def test_eccentricity_is_modelled_where_the_diameter_is_known() -> None:
    rng = np.random.default_rng(9)
    truth = make_network(rng, "sphere", images=24, targets=80, diameter=0.02, sigma=0.02)
    start = near(truth, rng)
    bar = Lengths([[38, 41]], [length_of(truth, 38, 41)], [1e-6])
    with_it = adjust(truth.marks, *start, lengths=bar, diameters=np.full(80, 0.02))
    without = adjust(truth.marks, *start, lengths=bar, settings=AdjustSettings(snooping=False))
    # on a sphere the focal length and the points absorb much of it: residuals hardly tell, the results do
    off = []
    for net in (with_it, without):
        d = net.camera.vector - truth.camera.vector
        off.append(d @ np.linalg.solve(net.intrinsics_covariance, d) / 9)
    assert off[0] < 2.7
    assert off[1] > 5.0


def test_a_plane_seen_frontally_does_not_give_the_focal_length() -> None:
    rng = np.random.default_rng(10)
    truth = make_network(rng, images=12, targets=20, tilt=(0.0, 0.004), distortion=(0.0,) * 5)
    with pytest.raises(NotIdentifiable, match="focal length") as caught:
        adjust(truth.marks, truth.camera, truth.camera_T_body, truth.points)
    assert set(caught.value.parameters) & {"fx", "fy", "f"}
    held = adjust(
        truth.marks, truth.camera, truth.camera_T_body, truth.points, settings=AdjustSettings(hold_focal=True)
    )
    assert {"f"} <= {name for name, _ in held.left_out} | ({"f"} if "fx" not in held.free_intrinsics else set())
    assert held.camera.fx == truth.camera.fx


def test_undetermined_distortion_is_left_out_and_said() -> None:
    rng = np.random.default_rng(11)
    truth = make_network(rng, images=6, targets=12, focal_factor=8.0, distortion=(0.0,) * 5, sigma=0.3)
    net = adjust(truth.marks, truth.camera, truth.camera_T_body, truth.points, settings=AdjustSettings(hold_focal=True))
    names = [name for name, _ in net.left_out]
    assert "k3" in names
    assert net.camera.k3 == 0.0
    assert net.intrinsics_covariance[INTRINSIC_NAMES.index("k3")].max() == 0.0
    with pytest.raises(NotIdentifiable, match="k3"):
        adjust(
            truth.marks, truth.camera, truth.camera_T_body, truth.points, settings=AdjustSettings(undetermined="raise")
        )


def test_contradictory_scale_bars_are_named() -> None:
    rng = np.random.default_rng(12)
    truth = make_network(rng, images=12, targets=20)
    pairs = [[0, 19], [4, 15], [0, 15]]
    true = np.array([length_of(truth, i, j) for i, j in pairs])
    good = Lengths(pairs, true + np.array([2e-6, -3e-6, 1e-6]), np.full(3, 5e-6))
    net = adjust(truth.marks, *near(truth, rng), lengths=good)
    assert all(abs(b.w) < 4 for b in net.scale_bars)
    with pytest.raises(InvalidInput, match=r"contradict.*worst 4-15") as caught:
        adjust(truth.marks, *near(truth, rng), lengths=replace(good, length=good.length + np.array([0.0, 1e-3, 0.0])))
    assert "mm" in str(caught.value)


def test_check_lengths_are_reported_not_used() -> None:
    rng = np.random.default_rng(13)
    truth = make_network(rng, images=14, targets=20)
    bar = Lengths([[0, 19]], [length_of(truth, 0, 19)], [1e-6])
    checks = Lengths([[4, 15], [0, 4]], [length_of(truth, 4, 15) + 1e-3, length_of(truth, 0, 4)], [np.nan, 1e-6])
    net = adjust(truth.marks, *near(truth, rng), lengths=bar, check_lengths=checks)
    plain = adjust(truth.marks, *near(truth, np.random.default_rng(0)), lengths=bar)
    np.testing.assert_allclose(aligned_error(net.points, plain.points, scale=False), 0.0, atol=1e-8)
    off, fine = net.check_lengths
    assert abs(off.error + 1e-3) < 1e-4
    assert abs(fine.w) < 4.5
    assert off.kind == "check"
    assert net.scale_bars[0].kind == "scale_bar"
    assert abs(net.scale_bars[0].error) < 1e-9


def test_bad_input_is_refused_with_a_remedy() -> None:
    rng = np.random.default_rng(14)
    truth = make_network(rng, images=6, targets=12)
    start = near(truth, rng)
    with pytest.raises(InvalidInput, match="sigma above zero"):
        adjust(truth.marks, *start, lengths=Lengths([[0, 1]], [1.0], [np.nan]))
    with pytest.raises(InvalidInput, match="not measured"):
        adjust(truth.marks, *start, lengths=Lengths([[0, 99]], [1.0], [1e-5]))
    with pytest.raises(InvalidInput, match="unknown interior orientation"):
        adjust(truth.marks, *start, free_intrinsics=("fx", "k9"))
    with pytest.raises(DegenerateGeometry, match="at least two"):
        adjust(truth.marks.select(truth.marks.image == 0), *start)
    with pytest.raises(DegenerateGeometry, match="triangle"):
        adjust(truth.marks, *start, datum=(0, 1))
    xy = truth.marks.xy.copy()
    xy[7, 1] = np.nan
    with pytest.raises(InvalidInput, match="row 7"):
        replace(truth.marks, xy=xy)
    with pytest.raises(InvalidInput, match="positive definite"):
        replace(truth.marks, covariance=0.0 * truth.marks.covariance)


def test_a_target_marked_twice_and_lonely_marks_are_left_out() -> None:
    rng = np.random.default_rng(15)
    truth = make_network(rng, images=8, targets=12)
    keep = ~((truth.marks.target == 11) & (truth.marks.image > 0))
    marks = truth.marks.select(keep)
    double = marks.select([3])
    marks = ImageMarks(
        np.append(marks.image, double.image),
        np.append(marks.target, double.target),
        np.vstack([marks.xy, double.xy + 5.0]),
        np.concatenate([marks.covariance, double.covariance]),
    )
    net = adjust(marks, *near(truth, rng))
    reasons = {(r.image, r.target): r.reason for r in net.rejected}
    assert "more than once" in reasons[(str(double.image[0]), int(double.target[0]))]
    assert reasons[("0", 11)] == "seen in one image only"
    assert 11 not in net.ids


def test_a_start_far_away_still_converges_with_damping() -> None:
    rng = np.random.default_rng(16)
    truth = make_network(rng, images=12, targets=20)
    c = truth.camera
    problem = Problem(
        MarkOrder(truth.marks, 12, 20),
        intrinsics_basis(INTRINSIC_NAMES),
        Datum("inner", np.arange(20), True, ""),
        Bars.none(),
        np.zeros(20),
        None,
        np.zeros(len(truth.marks), int),
        np.ones(1),
    )
    camera = Camera(c.width, c.height, 0.75 * c.fx, 0.75 * c.fx, (c.width - 1) / 2, (c.height - 1) / 2)
    poses = retract(truth.camera_T_body, rng.normal(0, 0.05, (12, 6)))
    state, summary = minimise(problem, State(camera, poses, truth.points + rng.normal(0, 0.03, (20, 3))))
    assert summary.converged
    assert abs(state.camera.fx / c.fx - 1.0) < 0.01
    assert summary.history[-1] < 1e-3 * summary.history[0]


def test_rank_tells_the_datum_defect() -> None:
    rng = np.random.default_rng(61)
    truth = make_network(rng, images=10, targets=20)
    bars = Lengths([[0, 19]], [length_of(truth, 0, 19)], [1e-5])
    free = adjusted(truth, rng)
    scaled = adjusted(truth, rng, lengths=bars)
    assert free.unknowns == scaled.unknowns == 9 + 6 * 10 + 3 * 20
    assert free.unknowns - free.rank == 7
    assert scaled.unknowns - scaled.rank == 6
    held = adjust(truth.marks, *near(truth, rng)[:2], truth.points, datum=(0, 7, 19))
    assert held.rank == held.unknowns == 9 + 6 * 10 + 3 * 17
