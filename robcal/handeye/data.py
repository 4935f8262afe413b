"""What a hand-eye calibration works on: marks of a board in images, and where the flange was commanded to be.

With the camera in the hand the board stands in the cell:
``base_T_flange flange_T_camera camera_T_board = base_T_board``. With the camera in the cell the robot carries the
board: the same with base and flange exchanged. Both read
``camera_T_board = X^-1 A^-1 Z``, with ``X`` the camera in what carries it, ``Z`` the board in what carries that, and
``A`` the camera's carrier seen from the board's.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import Camera
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import GEOMETRIC_KINDS
from robcal.transforms import Array, invert

Mounted = Literal["hand", "world"]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class RobotParameters:
    """The robot behind the flange frames, where its geometry may be adjusted as well.

    Attributes
    ----------
    kernel : of the nominal robot, without references of base and tool; inputs : of the n images.
    names : parameters that may be adjusted (p,).
    """

    kernel: Kernel
    inputs: PoseInputs = field(repr=False)
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, kernel: Kernel, inputs: PoseInputs) -> "RobotParameters":
        """With all geometric parameters of the chain; base and tool are what a hand-eye calibration finds anyway."""
        names = [f"{f.name}.{k}" for f in kernel.model.frames for k in GEOMETRIC_KINDS]
        return cls(kernel.with_references(np.eye(4), np.eye(4)), inputs, tuple(names))

    def select(self, images: ArrayLike) -> "RobotParameters":
        """For some of the images."""
        return replace(self, inputs=self.inputs.subset(images))

    def flanges(self, values: Array) -> tuple[Array, Array]:
        """``base_T_flange`` (n, 4, 4) with these deviations (p,), and right twists (n, 6, p) by them."""
        theta = self.kernel.theta0.copy()
        at = np.array([self.kernel.index[name] for name in self.names], dtype=np.intp)
        theta[at] += values
        return self.kernel.frames_and_jacobian(theta, self.inputs, at)


@dataclass(frozen=True)
class HandEyeData:
    """Marks of a board in n images of one camera.

    Attributes
    ----------
    camera : start values of the interior orientation, or what it is; mounted : 'hand' or 'world'.
    base_T_flange : (n, 4, 4) as commanded, in the order in which the poses were driven.
    body : the board; image : (m,) which image a mark is in; target : (m,) its row in the body.
    xy, covariance : (m, 2) px and (m, 2, 2) px^2, right but for a common factor.
    robot : the robot, None to leave it as it is.
    scale_sigma : standard deviation of the board's scale about its drawing (1), None where the drawing is taken as
        exact unless the images contradict it.
    """

    camera: Camera
    mounted: Mounted
    base_T_flange: Array = field(repr=False)
    body: Body = field(repr=False)
    image: IntArray = field(repr=False)
    target: IntArray = field(repr=False)
    xy: Array = field(repr=False)
    covariance: Array = field(repr=False)
    robot: RobotParameters | None = field(default=None, repr=False)
    scale_sigma: float | None = None

    def __post_init__(self) -> None:
        m = len(self.image)
        if self.target.shape != (m,) or self.xy.shape != (m, 2) or self.covariance.shape != (m, 2, 2):
            raise InvalidInput("a hand-eye calibration needs image, target, pixels and covariance of every mark")
        if self.mounted not in ("hand", "world"):
            raise InvalidInput(f"a camera is mounted in the hand or in the world, not '{self.mounted}'")
        if not self.body.known[self.target].all():
            raise InvalidInput(f"body {self.body.name}: a mark belongs to a target without coordinates")

    @property
    def n(self) -> int:
        """Number of images."""
        return len(self.base_T_flange)

    @property
    def points(self) -> Array:
        """(m, 3) coordinates of each mark's target on the board, m."""
        return self.body.points[self.target]

    def carriers(self, base_T_flange: Array | None = None) -> Array:
        """``A`` (n, 4, 4): the camera's carrier seen from the board's."""
        F = self.base_T_flange if base_T_flange is None else base_T_flange
        return F if self.mounted == "hand" else invert(F)

    def select(self, images: ArrayLike) -> "HandEyeData":
        """The given images (indices or mask), renumbered in their order."""
        rows = np.arange(self.n)[np.asarray(images)]
        place = np.full(self.n, -1, dtype=np.int64)
        place[rows] = np.arange(len(rows))
        kept = place[self.image] >= 0
        return replace(
            self.marks(kept),
            base_T_flange=self.base_T_flange[rows],
            image=place[self.image[kept]],
            robot=None if self.robot is None else self.robot.select(rows),
        )

    def marks(self, kept: BoolArray) -> "HandEyeData":
        """All images with some of the marks."""
        columns = {name: getattr(self, name)[kept] for name in ("image", "target", "xy", "covariance")}
        return replace(self, **columns)
