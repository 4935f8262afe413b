"""The robot: frames, static moments, parameters, expression-graph kernel, inverse kinematics, compensation."""
