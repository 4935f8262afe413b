"""Monte Carlo: stated intervals hold what they promise (the long form is ``python -m benchmarks.identification``)."""

import numpy as np
import pytest

from robcal import transforms as tf
from robcal.calibration.identification import IdentifyOptions, identify
from robcal.calibration.observations import FrameObservations
from robcal.robot.model import GEOMETRIC_KINDS
from tests.calibration.scenarios import scenario


@pytest.mark.slow
def test_95_percent_intervals_cover_93_to_97_percent() -> None:
    s = scenario(1)
    start = identify(s.model, s.poses, [s.frames(s.poses)], IdentifyOptions(robust=False), s.kernel)
    options = IdentifyOptions(parameters=start.names, robust=False, covariance="stated")
    exact = start.kernel.frames(start.kernel.theta0, s.poses)
    inside: dict[str, list[bool]] = {}
    for run in range(2000):
        noise = np.random.default_rng(run).normal(size=(len(exact), 6)) * np.repeat([5e-5, 1e-4], 3)
        observed = FrameObservations.isotropic(tf.retract(exact, noise), 5e-5, 1e-4)
        robot = identify(s.model, s.poses, [observed], options, s.kernel)
        W = tf.difference(robot.kernel.world_T_base, start.kernel.world_T_base)
        F = tf.difference(robot.kernel.flange_T_tool, start.kernel.flange_T_tool)
        ends = {f"{end}.{k}": v[i] for end, v in (("base", W), ("tool", F)) for i, k in enumerate(GEOMETRIC_KINDS)}
        for k, name in enumerate(robot.names):
            miss = ends.get(name, start.kernel.theta0[s.kernel.index[name]] - robot.theta[k])
            kind = name.rsplit(".", 1)[-1]
            group = name.split(".")[0] if name in ends else "length" if kind in "xyz" else kind.split("_")[0]
            inside.setdefault(group, []).append(bool(abs(miss) < 1.959964 * robot.sigma[k]))
    for group, hits in inside.items():
        assert 0.93 < np.mean(hits) < 0.97, group


@pytest.mark.slow
def test_gauss_newton_needs_at_most_five_steps() -> None:
    for seed in range(300):
        s = scenario(seed, seed % 2 == 1, scale=3.0)
        robot = identify(s.model, s.poses, [s.frames(s.poses)], IdentifyOptions(robust=False), s.kernel)
        assert robot.first_summary.converged
        assert robot.first_summary.iterations <= 5
