"""Fast evaluation of a robot for many poses: tool frames, exact Jacobians, moments.

The graph comes from :mod:`robcal.robot.kernel_graph`; here it is compiled to CasADi functions, mapped over poses, and
fed with numpy arrays without copying.
"""

import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.robot.hexapod_graph import hexapod_graph
from robcal.robot.kernel_graph import PoseGraph, chain_graph
from robcal.robot.model import GEOMETRIC_KINDS, RobotModel, parameter_names
from robcal.robot.statics import moment_names
from robcal.robot.terms import identifier

Array = NDArray[np.float64]
# functions mapped over so many different numbers of poses are kept (folds, subsets and single poses of one campaign)
MOST_MAPS = 32


@dataclass(frozen=True)
class PoseInputs:
    """What was commanded and recorded at n poses.

    Attributes
    ----------
    q : joint angles (n, N) in the sense of q, rad or m.
    load : one-hot (n, number of payloads); a row of zeros is no payload.
    covariates : further columns (n,) by name (``time_s``, ``temp_base_c``, ``approach1``, ...).
    """

    q: Array
    load: Array
    covariates: Mapping[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.q)

    def subset(self, rows: ArrayLike) -> "PoseInputs":
        """The poses of the given rows (indices or mask)."""
        chosen = np.asarray(rows)
        chosen = chosen if chosen.dtype == bool else chosen.astype(np.intp)
        return PoseInputs(self.q[chosen], self.load[chosen], {k: v[chosen] for k, v in self.covariates.items()})

    def with_q(self, q: ArrayLike) -> "PoseInputs":
        """The same poses with other joint angles (n, N)."""
        return PoseInputs(np.ascontiguousarray(q, dtype=float), self.load, self.covariates)


@dataclass(frozen=True)
class ScanBasis:
    """How each coordinate of each frame moves the tool.

    Attributes
    ----------
    names : ``<frame>.<kind>``; kinds x, y, z, roll, pitch, yaw and, for joints, q (in the sense of q).
    J : (n, 6, k) right twist (rho, omega) of the tool per unit of the coordinate, the moments' change included.
    """

    names: tuple[str, ...]
    J: Array


def pose_graph(model: RobotModel, statics: str = "one_step", derivatives: bool = True) -> PoseGraph:
    """The graph of a model: of a chain, or of a Stewart platform.

    Raises
    ------
    InvalidInput : as :func:`chain_graph` and :func:`hexapod_graph` do.
    """
    return hexapod_graph(model, derivatives) if model.is_hexapod else chain_graph(model, statics, derivatives)


class Kernel:
    """A model ready to be evaluated.

    Parameters
    ----------
    model : the robot; its parameters become ``theta0``.
    statics : 'one_step' (moments of the chain before it deflects) or 'converged'.

    Attributes
    ----------
    names : all parameter names, in the order of theta (p,).
    theta0 : values of the model's own parameters.
    world_T_base, flange_T_tool : references (identity where the model has none).

    Raises
    ------
    InvalidInput : unknown statics, or a term outside the expression language.
    """

    def __init__(self, model: RobotModel, statics: str = "one_step") -> None:
        self.model = model
        self.statics = statics
        self.names = parameter_names(model)
        self.index = {name: k for k, name in enumerate(self.names)}
        self.theta0 = self._start(model)
        self.world_T_base = np.eye(4) if model.world_T_base is None else np.array(model.world_T_base)
        self.flange_T_tool = np.eye(4) if model.flange_T_tool is None else np.array(model.flange_T_tool)
        self._graph: PoseGraph | None = None
        self._functions: dict[str, ca.Function] = {}
        self._maps: OrderedDict[tuple[str, int], tuple[Any, Any, Any]] = OrderedDict()
        self.covariates = self.graph().covariates

    def with_references(
        self, world_T_base: ArrayLike | None = None, flange_T_tool: ArrayLike | None = None
    ) -> "Kernel":
        """The same kernel with other references; shares the compiled graph."""
        other = object.__new__(Kernel)
        other.__dict__.update(self.__dict__)
        if world_T_base is not None:
            other.world_T_base = np.array(world_T_base, dtype=float)
        if flange_T_tool is not None:
            other.flange_T_tool = np.array(flange_T_tool, dtype=float)
        return other

    def with_model(self, model: RobotModel) -> "Kernel":
        """The same kernel for a model that differs in the values of parameters and in references only.

        Raises
        ------
        InvalidInput : the model has other parameters.
        """
        if parameter_names(model) != self.names:
            raise InvalidInput(f"robot '{model.name}' has other parameters than the kernel of '{self.model.name}'")
        other = self.with_references(
            np.eye(4) if model.world_T_base is None else model.world_T_base,
            np.eye(4) if model.flange_T_tool is None else model.flange_T_tool,
        )
        other.model = model
        other.theta0 = other._start(model)
        return other

    def graph(self) -> PoseGraph:
        """The symbolic graph of one pose."""
        if self._graph is None:
            self._graph = pose_graph(self.model, self.statics)
        return self._graph

    def poses(
        self,
        q: ArrayLike,
        payload: Sequence[str | None] | str | None = None,
        covariates: Mapping[str, ArrayLike] | None = None,
    ) -> PoseInputs:
        """Check and arrange pose data.

        Parameters
        ----------
        q : (n, N) joint angles, rad or m.
        payload : name per pose, one name for all, or None; '' and None are no payload.
        covariates : columns (n,) by name; names that are not identifiers get underscores.

        Raises
        ------
        InvalidInput : wrong number of joints, non-finite values, an unknown payload, or columns of another length.
        """
        angles = np.atleast_2d(np.ascontiguousarray(q, dtype=float))
        if angles.ndim != 2 or angles.shape[1] != self.model.n_joints:
            raise InvalidInput(
                f"robot '{self.model.name}' has {self.model.n_joints} joints, the poses give {angles.shape[-1]} angles"
            )
        bad = np.flatnonzero(~np.all(np.isfinite(angles), axis=1))
        if bad.size:
            raise InvalidInput(f"pose {bad[0]} (counted from 0) has a joint angle that is not finite: remove the row")
        n = len(angles)
        names = [payload] * n if payload is None or isinstance(payload, str) else list(payload)
        if len(names) != n:
            raise InvalidInput(f"{len(names)} payload names for {n} poses")
        load = np.zeros((n, len(self.model.payloads)))
        columns = {name: k for k, name in enumerate(self.model.payloads)}
        for row, name in enumerate(names):
            if name is None or name == "" or name != name:
                continue
            if name not in columns:
                known = ", ".join(columns) or "none"
                raise InvalidInput(f"pose {row} (counted from 0) carries unknown payload '{name}'; known: {known}")
            load[row, columns[name]] = 1.0
        table: dict[str, Array] = {}
        for name, values in (covariates or {}).items():
            column = np.asarray(values, dtype=float)
            if column.shape != (n,):
                raise InvalidInput(f"covariate '{name}' has {column.shape} values for {n} poses")
            table[identifier(name)] = column
        table.setdefault("index", np.arange(n, dtype=float))
        return PoseInputs(angles, load, table)

    def frames(self, theta: ArrayLike, poses: PoseInputs) -> Array:
        """Tool frames ``world_T_tool`` (n, 4, 4)."""
        (flat,) = self._evaluate("frames", theta, poses)
        return _matrices(flat)

    def frames_and_jacobian(
        self, theta: ArrayLike, poses: PoseInputs, columns: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Tool frames (n, 4, 4) and right twists (n, 6, p) per parameter; ``columns`` picks parameters by index."""
        T, J, _ = self.evaluate(theta, poses)
        return T, J if columns is None else J[:, :, np.asarray(columns)]

    def evaluate(self, theta: ArrayLike, poses: PoseInputs) -> tuple[Array, Array, Array]:
        """Tool frames (n, 4, 4), right twists (n, 6, p) of all parameters, and moments (n, m), in one call."""
        flat, jacobian, moments = self._evaluate("jacobian", theta, poses)
        J = jacobian.reshape(len(poses), len(self.names), 6)
        return _matrices(flat), J.transpose(0, 2, 1), moments

    def joint_jacobian(self, theta: ArrayLike, poses: PoseInputs) -> Array:
        """Right twist (n, 6, N) of the tool per unit of each joint."""
        (flat,) = self._evaluate("joint_jacobian", theta, poses)
        return flat.reshape(len(poses), self.model.n_joints, 6).transpose(0, 2, 1)

    def scan_basis(self, theta: ArrayLike, poses: PoseInputs) -> ScanBasis:
        """Tool twists of every coordinate of base, chain and tool, and of every joint.

        Raises
        ------
        InvalidInput : the robot is a Stewart platform.
        """
        if self.model.is_hexapod:
            raise InvalidInput(f"robot '{self.model.name}' is a Stewart platform: it has no frames to scan")
        (flat,) = self._evaluate("basis", theta, poses)
        frames = ["base", *(f.name for f in self.model.frames), "tool"]
        names = [f"{frame}.{kind}" for frame in frames for kind in GEOMETRIC_KINDS]
        names += [f"{f.name}.crank_angle" for f in self.model.frames if f.fourbar is not None]
        J = flat.reshape(len(poses), len(names), 6).transpose(0, 2, 1)
        joints = [(names.index(f.zero_name), f.zero_sign, f"{f.name}.q") for f in self.model.joints]
        of_joints = J[:, :, [k for k, _, _ in joints]] * np.array([s for _, s, _ in joints], dtype=float)
        return ScanBasis((*names, *(n for _, _, n in joints)), np.concatenate([J, of_joints], axis=2))

    def variables(self, theta: ArrayLike, poses: PoseInputs) -> dict[str, Array]:
        """All variables of the expression language, (n,) each: q, moments, torques, payload mass, covariates."""
        flat, torques = self._evaluate("moments", theta, poses)
        names = moment_names(self.model)
        out: dict[str, Array] = {name: flat[:, k] for k, name in enumerate(names)}
        for k in range(self.model.n_joints):
            out[f"q{k + 1}"] = poses.q[:, k]
            out[f"torque{k + 1}"] = torques[:, k]
            out[f"approach{k + 1}"] = out[f"move{k + 1}"] = np.zeros(len(poses))
        masses = [p.mass + np.asarray(theta)[self.index[f"payload.{n}.mass"]] for n, p in self.model.payloads.items()]
        out["payload_mass"] = poses.load @ np.array(masses) if masses else np.zeros(len(poses))
        return {**out, **poses.covariates}

    def theta(self, values: Mapping[str, float]) -> Array:
        """``theta0`` with the named values replaced.

        Raises
        ------
        InvalidInput : unknown name.
        """
        theta = self.theta0.copy()
        for name, value in values.items():
            if name not in self.index:
                raise InvalidInput(f"robot '{self.model.name}' has no parameter '{name}'")
            theta[self.index[name]] = value
        return theta

    def function(self, kind: str = "frames") -> ca.Function:
        """CasADi function of one pose: 'frames', 'jacobian' (frames, Jacobian, moments), 'joint_jacobian', 'basis' or
        'moments' (moments, torques of the joints).

        Inputs: theta, q, load, covariates, world_T_base (3, 4), flange_T_tool (3, 4).
        """
        if kind not in self._functions:
            g = self.graph()
            outputs = {
                "frames": [g.world_T_tool],
                "jacobian": [g.world_T_tool, g.jacobian, g.moments],
                "joint_jacobian": [g.joint_jacobian],
                "basis": [g.basis],
                "moments": [g.moments, g.torques],
            }[kind]
            self._functions[kind] = ca.Function(f"robot_{kind}", g.inputs, [ca.densify(o) for o in outputs])
        return self._functions[kind]

    def _start(self, model: RobotModel) -> Array:
        values = dict(model.parameters)
        for term in model.terms:
            for short, value in term.parameters.items():
                full = f"{term.name}.{short}"
                if values.setdefault(full, value) != value:
                    raise InvalidInput(f"terms named '{term.name}' share '{short}' but give it different values")
        return np.array([values.get(name, 0.0) for name in self.names])

    def _covariate_table(self, poses: PoseInputs) -> Array:
        table = np.zeros((len(poses), len(self.covariates)))
        for k, name in enumerate(self.covariates):
            if name in poses.covariates:
                table[:, k] = poses.covariates[name]
            elif not re.fullmatch(r"(approach|move)\d+", name):
                raise InvalidInput(f"a term of robot '{self.model.name}' needs column '{name}', the poses have none")
        return table

    def _evaluate(self, kind: str, theta: ArrayLike, poses: PoseInputs) -> list[Array]:
        """Run a function over all poses; each output as (n, entries) in CasADi's column-major order."""
        n = len(poses)
        function = self.function(kind)
        if n == 0:
            return [np.zeros((0, function.numel_out(k))) for k in range(function.n_out())]
        buffer, run = self._mapped(kind, n)
        arguments = [
            np.ascontiguousarray(theta, dtype=float),
            np.ascontiguousarray(poses.q),
            np.ascontiguousarray(poses.load),
            self._covariate_table(poses),
            np.asfortranarray(self.world_T_base[:3]).ravel(order="F"),
            np.asfortranarray(self.flange_T_tool[:3]).ravel(order="F"),
        ]
        if arguments[0].shape != (len(self.names),):
            raise InvalidInput(f"theta has {arguments[0].size} values, the model has {len(self.names)} parameters")
        results = [np.empty((n, function.numel_out(k))) for k in range(function.n_out())]
        for k, array in enumerate(arguments):
            if array.size:
                buffer.set_arg(k, memoryview(array))  # type: ignore[arg-type]
        for k, array in enumerate(results):
            buffer.set_res(k, memoryview(array))  # type: ignore[arg-type]
        run()
        return results

    def _mapped(self, kind: str, n: int) -> tuple[Any, Any]:
        """Buffer and call of a function over n poses; the ones not used lately are dropped."""
        key = (kind, n)
        if key in self._maps:
            self._maps.move_to_end(key)
        else:
            mapped = self.function(kind).map(f"robot_{kind}_{n}", "serial", n, [0, 4, 5], [])
            self._maps[key] = (mapped, *mapped.buffer())
            while len(self._maps) > MOST_MAPS:
                self._maps.popitem(last=False)
        return self._maps[key][1:]

    def __getstate__(self) -> dict[str, Any]:
        return {"model": self.model, "statics": self.statics, "references": (self.world_T_base, self.flange_T_tool)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["model"], state["statics"])  # type: ignore[misc]
        self.world_T_base, self.flange_T_tool = state["references"]


def _matrices(flat: Array) -> Array:
    """(n, 12) column-major (3, 4) blocks to (n, 4, 4)."""
    T = np.zeros((len(flat), 4, 4))
    T[:, :3] = flat.reshape(-1, 4, 3).transpose(0, 2, 1)
    T[:, 3, 3] = 1.0
    return T
