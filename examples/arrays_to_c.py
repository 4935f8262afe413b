"""From arrays of your own to C for a controller: a robot as a Denavit-Hartenberg table, joint angles, tool frames."""

import numpy as np

import robcal

ROWS = [
    robcal.DHRow(d=0.1273, alpha=np.pi / 2),
    robcal.DHRow(a=-0.612),
    robcal.DHRow(a=-0.5723),
    robcal.DHRow(d=0.1639, alpha=np.pi / 2),
    robcal.DHRow(d=0.1157, alpha=-np.pi / 2),
    robcal.DHRow(d=0.0922),
]


def main() -> robcal.CSource:
    """Identify from arrays; returns the C header and source of the calibrated robot."""
    rng = np.random.default_rng(1)
    model = robcal.RobotModel("UR10", robcal.frames_from_dh(ROWS))
    q = rng.uniform(-2.0, 2.0, (50, 6))

    # what a measuring system would say of a robot whose elbow is 2 mrad off its zero
    real = robcal.Kernel(robcal.RobotModel("UR10", model.frames, parameters={"axis3.yaw": 0.002}))
    measured = real.frames(real.theta0, real.poses(q))
    measured[:, :3, 3] += rng.normal(0.0, 2e-5, (50, 3))
    frames = robcal.FrameObservations.isotropic(measured, sigma=2e-5, sigma_angle=2e-5)

    options = robcal.IdentifyOptions(parameters="geometry")
    robot = robcal.identify(model, robcal.Kernel(model).poses(q), [frames], options)
    wanted, _ = robot.predict(robot.kernel.poses(q[:1] + 0.1))
    command = robcal.compensate(robot.model, wanted, near=q[0])
    print(f"to get there, command {np.round(np.degrees(command.q[0]), 3)} deg")
    return robcal.export_c(robot.model)


if __name__ == "__main__":
    main()
