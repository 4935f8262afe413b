"""Fixed frames for ROS: the publisher's command, and launch files of ROS 1 and ROS 2."""

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robcal.transforms import Array


@dataclass(frozen=True)
class Transform:
    """``parent_T_child`` (4, 4), m: frames by their names in ROS, ``name`` for messages and nodes."""

    name: str
    parent: str
    child: str
    T: Array


def quaternion(R: Array) -> Array:
    """(x, y, z, w) of a rotation matrix, w not negative (Shepperd 1978)."""
    trace = float(np.trace(R))
    squares = np.array([R[0, 0], R[1, 1], R[2, 2], trace])
    i = int(np.argmax(squares))
    q = np.empty(4)
    if i == 3:
        q[:] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 - trace + 2.0 * R[i, i]
        q[j], q[k], q[3] = R[j, i] + R[i, j], R[k, i] + R[i, k], R[k, j] - R[j, k]
    q /= np.linalg.norm(q)
    return -q if q[3] < 0 else q


def transform_files(transforms: Sequence[Transform]) -> dict[str, str]:
    """Texts by file name: a shell script, and launch files."""
    return {
        "static_transform.sh": "".join(f"# {t.name}\n{static_transform(t)}\n" for t in transforms),
        "static_transform.launch": _launch_1(transforms),
        "static_transform.launch.py": _launch_2(transforms),
    }


def static_transform(found: Transform) -> str:
    """The command that publishes a frame in ROS 2."""
    numbers = " ".join(f"--{name} {value}" for name, value in _numbers(found))
    ends = f"--frame-id {found.parent} --child-frame-id {found.child}"
    return f"ros2 run tf2_ros static_transform_publisher {numbers} {ends}"


def _numbers(found: Transform) -> list[tuple[str, str]]:
    values = [f"{v:.9f}" for v in (*found.T[:3, 3], *quaternion(found.T[:3, :3]))]
    return list(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values, strict=True))


def _launch_1(transforms: Sequence[Transform]) -> str:
    rows = []
    for f in transforms:
        args = " ".join((*(value for _, value in _numbers(f)), f.parent, f.child))
        rows.append(f'  <node pkg="tf2_ros" type="static_transform_publisher" name="{f.name}" args="{args}"/>\n')
    return f"<launch>\n{''.join(rows)}</launch>\n"


def _launch_2(transforms: Sequence[Transform]) -> str:
    nodes = []
    for f in transforms:
        words = [word for name, value in _numbers(f) for word in (f"--{name}", value)]
        words += ["--frame-id", f.parent, "--child-frame-id", f.child]
        nodes.append(
            f'        Node(package="tf2_ros", executable="static_transform_publisher", name="{f.name}",\n'
            f"             arguments={json.dumps(words)}),\n"
        )
    head = "from launch import LaunchDescription\nfrom launch_ros.actions import Node\n\n\n"
    return f"{head}def generate_launch_description():\n    return LaunchDescription([\n{''.join(nodes)}    ])\n"
