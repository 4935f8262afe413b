"""What a diagnosis works on: poses and what was measured in them."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.calibration.wire import Wire
from robcal.diagnosis.core.decorrelation import CommonNoise, SharedNoise
from robcal.errors import InvalidInput
from robcal.physics.cause import Array, ObservationData
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.transforms import transform

SpatialObservations = FrameObservations | PointObservations | DistanceObservations | SensorPointObservations


@dataclass(frozen=True)
class Recording:
    """Recorded poses and what was measured in them.

    Attributes
    ----------
    q : (n, joints) in the sense of q, rad or m.
    payload : name of the payload of each pose, or None.
    covariates : per pose, (n,) each: index, approachK, time_s, temp_*_c ...
    names : of the poses.
    observations : one kind of measurement; `pose` in it counts rows of q.
    body : name of the measuring body; ids : its targets.
    shared : repeatability of the joints as estimated.
    common : (m_obs, 3 | 6, k) displacements of points or frames by one
        standard deviation of errors common to all poses (orientation of the station, coordinates of the body).
    own_station : measured by cameras whose own images are diagnosed: their moves are reported from those.
    hidden : names of causes that these measurements cannot tell, so that none of them is named.
    """

    q: Array
    payload: tuple[str | None, ...]
    covariates: Mapping[str, Array]
    names: tuple[str, ...]
    observations: SpatialObservations
    body: str = "body"
    ids: tuple[int, ...] = ()
    shared: SharedNoise | None = None
    common: Array | None = None
    own_station: bool = False
    hidden: tuple[str, ...] = ()

    def linearise(self, frames: Array, J: Array) -> tuple[Array, Array]:
        """Whitened residuals (m,) and Jacobian (m, p) at modelled frames (n, 4, 4) with right twists (n, 6, p)."""
        residual, jacobian = self.observations.linearise(frames, J)
        if self.shared is None and self.common is None:
            return residual, jacobian
        return self._decorrelate(residual), self._decorrelate(jacobian)

    def whiten(self, displacement: Array, frames: Array) -> Array:
        """Whitened rows (m, p) of displacements (m_obs, k, p) of the observations; frames (n, 4, 4) as modelled."""
        L = np.linalg.cholesky(self.observations.noise(frames))
        return self._decorrelate(np.linalg.solve(L, displacement).reshape(-1, displacement.shape[2]))

    def unwhiten(self, rows: Array, frames: Array) -> Array:
        """Displacements (m_obs, k, p) of whitened rows (m, p); inverse of :meth:`whiten`."""
        plain = rows if self._common is None else self._common.unwhiten(rows)
        plain = plain if self.shared is None else self.shared.unwhiten(plain)
        L = np.linalg.cholesky(self.observations.noise(frames))
        return np.asarray(L @ plain.reshape(len(L), -1, rows.shape[1]))

    def local(self, rows: Array, frames: Array) -> Array:
        """Displacements (m_obs, k, p) of whitened rows (m, p) without what the errors common to all poses explain."""
        plain = rows if self._common is None else self._common.whiten(rows)
        plain = plain if self.shared is None else self.shared.unwhiten(plain)
        L = np.linalg.cholesky(self.observations.noise(frames))
        return np.asarray(L @ plain.reshape(len(L), -1, rows.shape[1]))

    def given_common(self, rows: Array) -> Array:
        """Rows (m, ...) that are whitened pose by pose, beside the errors common to all poses."""
        return rows if self._common is None else self._common.whiten(rows)

    def common_errors(self, residual: Array) -> Array | None:
        """Most probable errors common to all poses (k,), in their standard deviations, from whitened residuals (m,)."""
        return None if self._common is None else self._common.estimate(residual)

    def _decorrelate(self, rows: Array) -> Array:
        rows = rows if self.shared is None else self.shared.whiten(rows)
        return rows if self._common is None else self._common.whiten(rows)

    @cached_property
    def _common(self) -> CommonNoise | None:
        if self.common is None:
            return None
        L = np.linalg.cholesky(self.observations.noise(np.tile(np.eye(4), (len(self.q), 1, 1))))
        columns = np.linalg.solve(L, self.common).reshape(-1, self.common.shape[2])
        return CommonNoise(columns if self.shared is None else self.shared.whiten(columns))

    @property
    def scatter(self) -> float:
        """Variance of the joints in units of the variance factor; zero where none was seen."""
        return 0.0 if self.shared is None else self.shared.ratio

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant that the scatter of the joints gives the covariance of the whitened rows."""
        return 0.0 if self.shared is None else self.shared.log_determinant

    def pose_name(self, index: float) -> str:
        """Name of the pose with a value of the covariate `index`."""
        nearest = int(np.argmin(np.abs(self.covariates["index"] - index)))
        return self.names[nearest]

    def inputs(self, kernel: Kernel) -> PoseInputs:
        """The poses as the kernel wants them."""
        return kernel.poses(self.q, payload=self.payload, covariates=self.covariates)

    @property
    def observations_are_spatial(self) -> bool:
        """Whether the observations tell directions (frames and points do, distances do not)."""
        return not isinstance(self.observations, DistanceObservations)

    def row_groups(self, rows: int) -> Array:
        """Label of the observation to which each row of the residuals belongs."""
        return np.repeat(np.arange(len(self.observations.pose)), rows // len(self.observations.pose))

    def without_observations(self, drop: Array) -> "Recording":
        """Without the observations of the given indices."""
        keep = np.setdiff1d(np.arange(len(self.observations.pose)), drop)
        shared = None if self.shared is None else self.shared.subset(keep)
        common = None if self.common is None else self.common[keep]
        return replace(self, observations=_rows(self.observations, keep), shared=shared, common=common)

    def subset(self, keep: Array) -> "Recording":
        """Only the poses where `keep` (n,) is true; observations of the others are left out."""
        rows = np.flatnonzero(keep)
        number = np.full(len(self.q), -1)
        number[rows] = np.arange(len(rows))
        chosen = np.flatnonzero(keep[self.observations.pose])
        observations = _rows(self.observations, chosen)
        observations = replace(observations, pose=number[observations.pose])
        return replace(
            self,
            q=self.q[rows],
            payload=tuple(self.payload[i] for i in rows),
            names=tuple(self.names[i] for i in rows),
            covariates={name: np.asarray(values)[rows] for name, values in self.covariates.items()},
            observations=observations,
            shared=None,
            common=None if self.common is None else self.common[chosen],
        )


def _rows(observations: SpatialObservations, keep: Array) -> SpatialObservations:
    """The observations of the given indices; poses keep their numbers."""
    count = len(observations.pose)
    arrays = {field.name: getattr(observations, field.name) for field in fields(observations)}
    return replace(observations, **{name: v[keep] for name, v in arrays.items() if np.shape(v)[:1] == (count,)})


def observation_data(recording: Recording, frames: Array, variables: Mapping[str, Array]) -> ObservationData:
    """What observation causes need, at the modelled frames (n, 4, 4)."""
    obs = recording.observations
    m = len(obs.pose)
    T = frames[obs.pose]
    if isinstance(obs, PointObservations):
        return ObservationData(
            "points", obs.pose, np.asarray(obs.target), T, obs.p_tool, transform(T, obs.p_tool), None, variables
        )
    if isinstance(obs, FrameObservations):
        none = np.full(m, -1)
        return ObservationData("frames", obs.pose, none, T, np.zeros((m, 3)), T[:, :3, 3], None, variables)
    if isinstance(obs, DistanceObservations):
        none = np.full(m, -1)
        zero, wire = np.zeros((m, 3)), obs.wire or Wire()
        return ObservationData("distances", obs.pose, none, T, zero, T[:, :3, 3], None, variables, wire)
    if isinstance(obs, SensorPointObservations):
        none = np.full(m, -1)
        return ObservationData(
            "sensor", obs.pose, none, T, obs.p_sensor, transform(T, obs.p_sensor), obs.p_sensor, variables
        )
    raise InvalidInput(f"observations of type {type(obs).__name__} cannot be diagnosed")
