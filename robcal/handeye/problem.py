"""The least-squares problem of a hand-eye calibration: marks against camera, board, lens, board shape and robot.

Every image has a twist of its own of the flange, by which the robot misses where it was commanded to be: random, with
a standard deviation of place and of turn that is estimated (:mod:`robcal.handeye.variance`). All images together have
the unknowns in the order of :class:`Layout`.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from robcal.estimation.grouping import sum_by, whitener
from robcal.estimation.levenberg import Linearised, levenberg
from robcal.estimation.schur import Factor
from robcal.estimation.summary import SolveSummary, TerminationSettings
from robcal.handeye.data import BoolArray, HandEyeData
from robcal.handeye.shape import directions
from robcal.handeye.unknowns import (
    Layout,
    State,
    System,
    Variances,
    components,
    expected_lens,
    lens_priors,
    quadratic,
    reduced,
)
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project, project_with_jacobians
from robcal.photogrammetry.core.eccentricity import body_normals, centre_shift
from robcal.transforms import Array, invert, retract, skew, transform

TERMINATION = TerminationSettings(60, 12, 1e-10, 1e-6)


def _normals(body: Body) -> Array:
    """(t, 3) normals of the dots of a body; NaN where there are none."""
    if body.normals is not None:
        return body.normals
    normals = np.full((len(body), 3), np.nan)
    if np.any(body.diameters > 0):
        normals[body.known] = body_normals(body.points[body.known])
    return normals


@dataclass(frozen=True)
class Problem:
    """Data and free unknowns; ``used`` (m,) marks that take part."""

    data: HandEyeData
    layout: Layout
    used: BoolArray
    _shape: Array = field(init=False, repr=False)
    _white: Array = field(init=False, repr=False)
    _normals: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_shape", directions(self.data.body)[self.data.target])
        object.__setattr__(self, "_white", whitener(self.data.covariance))
        object.__setattr__(self, "_normals", _normals(self.data.body)[self.data.target])

    def flanges(self, state: State) -> tuple[Array, Array | None]:
        """``base_T_flange`` (n, 4, 4) without twists, and twists (n, 6, p) by the robot's deviations if free."""
        data = self.data
        if data.robot is None or not len(state.robot):
            return data.base_T_flange, None
        return data.robot.flanges(state.robot)

    def views(self, state: State, flanges: Array) -> Array:
        """``camera_T_board`` (n, 4, 4)."""
        A = self.data.carriers(retract(flanges, state.twist))
        return invert(state.X[self.layout.of_X]) @ invert(A) @ state.Z[self.layout.of_Z]

    def drawn(self, state: State) -> Array:
        """(m, 3) targets of the marks on the board as it is, deviations of its shape included."""
        return self.data.points + self._shape @ state.shape

    def eccentricity(self, camera: Camera, views: Array, p_camera: Array) -> Array:
        """(m, 2) px by which perspective and lens move the centres of dots; zero for marks that are none.

        Its dependence on the unknowns is left out of the Jacobians (a dot's image size squared).
        """
        n_camera = np.einsum("mij,mj->mi", views[self.data.image, :3, :3], self._normals)
        return centre_shift(camera, p_camera, n_camera, 0.5 * self.data.body.diameters[self.data.target])

    def residuals(self, state: State) -> Array:
        """Whitened residuals (m, 2), as stated; NaN behind the camera."""
        flanges, _ = self.flanges(state)
        data = self.data
        views = self.views(state, flanges)
        p_camera = transform(views[data.image], self.drawn(state))
        xy = project(state.camera, p_camera) + self.eccentricity(state.camera, views, p_camera)
        return np.einsum("mij,mj->mi", self._white, data.xy - xy)

    def rows(self, state: State) -> tuple[Array, Array, Array]:
        """Whitened residuals (m, 2), Jacobians (m, 2, a) of the shared unknowns and (m, 2, 6) of the twists."""
        data, layout, image = self.data, self.layout, self.data.image
        flanges, robot = self.flanges(state)
        views = self.views(state, flanges)
        T = views[image]
        p_board = self.drawn(state)
        p_camera = transform(T, p_board)
        xy, d_point, d_lens = project_with_jacobians(state.camera, p_camera)
        xy = xy + self.eccentricity(state.camera, views, p_camera)
        r = np.einsum("mij,mj->mi", self._white, data.xy - xy)
        W, R = self._white, T[:, :3, :3]
        m = len(image)
        eye = np.broadcast_to(np.eye(3), (m, 3, 3))
        by_X = d_point @ np.concatenate([-eye, skew(p_camera)], axis=2)
        by_Z = d_point @ np.concatenate([R, -R @ skew(p_board)], axis=2)
        # the flange moves the camera in the hand one way, the board in the hand the other way
        if data.mounted == "hand":
            C = np.swapaxes(state.X[layout.of_X][image][:, :3, :3], 1, 2)
            p_flange = transform(state.X[layout.of_X][image], p_camera)
            by_flange = d_point @ C @ np.concatenate([-eye, skew(p_flange)], axis=2)
        else:
            C = R @ np.swapaxes(state.Z[layout.of_Z][image][:, :3, :3], 1, 2)
            p_flange = transform(state.Z[layout.of_Z][image], p_board)
            by_flange = d_point @ C @ np.concatenate([eye, -skew(p_flange)], axis=2)
        parts = layout.parts(state)
        J = np.zeros((m, 2, parts[-1].stop))
        at = np.arange(m)[:, None]
        J[at, :, 6 * layout.of_X[image][:, None] + np.arange(6)] = np.swapaxes(by_X, 1, 2)
        J[at, :, parts[1].start + 6 * layout.of_Z[image][:, None] + np.arange(6)] = np.swapaxes(by_Z, 1, 2)
        J[:, :, parts[2]] = d_lens[:, :, layout.lens]
        J[:, :, parts[3]] = d_point @ R @ self._shape[:, :, layout.shape]
        if layout.robot and robot is not None:
            J[:, :, parts[4]] = by_flange @ robot[image]
        return r, W @ J, W @ by_flange

    def system(self, state: State) -> System:
        """Normal equations at a state, with zero for all twists and unknowns that have a prior."""
        r, J, K = self.rows(state)
        good = self.used & np.isfinite(r).all(axis=1)
        r, J, K, image = r[good], J[good], K[good], self.data.image[good]
        value, prior, place, turn = self._priors(state)
        r = r + np.einsum("mij,mj->mi", K, state.twist[image]) + J @ value
        n, a = self.data.n, J.shape[2]
        flat = J.reshape(-1, a)
        G = sum_by(image, np.swapaxes(J, 1, 2) @ K, n)
        V = sum_by(image, np.swapaxes(K, 1, 2) @ K, n)
        s = sum_by(image, np.einsum("mij,mi->mj", K, r), n)
        square = float(np.sum(r * r))
        return System(flat.T @ flat, flat.T @ r.ravel(), G, V, s, square, r.size, value, prior, place, turn)

    def _priors(self, state: State) -> tuple[Array, Array, BoolArray, BoolArray]:
        """Values and standard deviations of the unknowns about their expectation, and which are the robot's."""
        parts = self.layout.parts(state)
        a = parts[-1].stop
        value, prior = np.zeros(a), np.full(a, np.inf)
        place, turn = np.zeros(a, dtype=bool), np.zeros(a, dtype=bool)
        width = lens_priors(self.data.camera)[self.layout.lens]
        weak = np.isfinite(width)
        off = state.camera.vector[self.layout.lens] - expected_lens(self.data.camera)[self.layout.lens]
        value[parts[2]], prior[parts[2]] = np.where(weak, off, 0.0), width
        if self.data.scale_sigma is not None:
            scale = parts[3].start + np.flatnonzero(self.layout.shape == 0)
            value[scale], prior[scale] = state.shape[0], self.data.scale_sigma
        if self.layout.robot and self.data.robot is not None:
            value[parts[4]] = state.robot
            lengths = np.array([n.rsplit(".", 1)[1] in "xyz" for n in self.data.robot.names])
            place[parts[4]], turn[parts[4]] = lengths, ~lengths
        return value, prior, place, turn

    def estimated_shape(self, at: "Solved") -> tuple[Array, Array]:
        """Free deviations (s,) of the board and their covariance, by one step from a solution without them."""
        system = self.system(at.state)
        normals = reduced(system, at.variances)
        factor = Factor(normals)
        part = self.layout.parts(at.state)[3]
        step, _ = factor.solve(normals.b, normals.s)
        value = step[part] - system.value[part] + at.state.shape[self.layout.shape]
        return value, factor.cofactors()[part, part]

    def moved(self, state: State, step: Array, twist: Array) -> State:
        """State after a step (a,) of the shared unknowns, with new twists (n, 6)."""
        x, z, lens, shape, robot = (step[part] for part in self.layout.parts(state))
        vector = state.camera.vector
        vector[self.layout.lens] += lens
        new = state.shape.copy()
        new[self.layout.shape] += shape
        return State(
            state.camera.with_vector(vector),
            retract(state.X, _short(x.reshape(-1, 6))),
            retract(state.Z, _short(z.reshape(-1, 6))),
            new,
            state.robot + robot if self.layout.robot else state.robot,
            twist,
        )

    def solve(self, start: State, variances: Variances, settings: TerminationSettings = TERMINATION) -> "Solved":
        """The most likely state with these variance components."""
        scale, pixel = variances.twist, variances.pixel
        start = replace(start, twist=np.where(scale > 0, start.twist, 0.0))

        def cost(state: State) -> float:
            r = self.residuals(state)[self.used]
            if not np.isfinite(r).all():
                return float("nan")
            value, prior, place, turn = self._priors(state)
            prior = components(prior, place, turn, variances)
            moving = scale > 0
            twist = state.twist[:, moving] / scale[moving]
            square = float(np.sum(r * r)) / pixel**2 + float(np.sum((value / prior) ** 2)) + float(np.sum(twist**2))
            return 0.5 * square

        def linearise(state: State) -> Linearised[State]:
            system = self.system(state)
            weight = system.sigmas(variances) ** -2.0
            normals = reduced(system, variances)
            now = cost(state)

            def propose(damping: float) -> tuple[State, float]:
                if damping == 0.0:
                    step, units = Factor(normals).solve(normals.b, normals.s)
                    trial = self.moved(state, step - system.value, scale * units)
                else:  # damped about the state itself
                    units0 = np.divide(state.twist, scale, out=np.zeros_like(state.twist), where=scale > 0)
                    b = normals.b - normals.A @ system.value - np.einsum("nai,ni->a", normals.G, units0)
                    s = normals.s - np.einsum("nij,nj->ni", normals.V, units0)
                    s = s - np.einsum("nai,a->ni", normals.G, system.value)
                    step, units = Factor(normals, damping=damping).solve(b, s)
                    trial = self.moved(state, step, scale * (units0 + units))
                    step, units = step + system.value, units0 + units
                predicted = now - quadratic(system, variances, weight, step, units)
                return trial, predicted

            return Linearised(now, propose, cost)

        state, summary = levenberg(linearise, start, settings)
        return Solved(state, variances, self.system(state), summary)


@dataclass(frozen=True)
class Solved:
    """A solution, its normal equations, and how the iteration ended."""

    state: State
    variances: Variances
    system: System
    summary: SolveSummary

    def covariance(self) -> Array:
        """(a, a) covariance of the shared unknowns."""
        normals = reduced(self.system, self.variances)
        return Factor(normals).cofactors()


def _short(step: Array) -> Array:
    """Steps (k, 6) of frames shortened so that none turns by more than half a radian."""
    angle = np.linalg.norm(step[:, 3:], axis=1, keepdims=True)
    return step * np.minimum(1.0, 0.5 / np.maximum(angle, 1e-300))
