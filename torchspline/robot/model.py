"""A robot as a product of exponentials: pose, twist and acceleration of any link from its joints, exact."""

from collections.abc import Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.fit.residual import Residual
from torchspline.groups.convert import from_transform_matrix
from torchspline.groups.group import SE3, Rn
from torchspline.groups.operations import geodesics
from torchspline.robot import readers
from torchspline.robot.readers import Frame, Joint
from torchspline.robot.residual import on_link
from torchspline.splines.trajectory import State, Trajectory


class Path(NamedTuple):
    """What carries a link: `pose Exp(s_1 (f_1 q_i1 + o_1)) ... Exp(s_n (f_n q_in + o_n))`, float64."""

    #: (7,), of the link where every exponent is zero.
    pose: Tensor
    #: (n, 6), [v, omega] in the link's frame.
    screws: Tensor
    #: (n,): which coordinate drives each, by how much, and from where.
    driver: Tensor
    factor: Tensor
    offset: Tensor


class OverLimit(NamedTuple):
    """The worst that a joint does beyond one of its limits."""

    joint: str
    #: "position" or "velocity".
    quantity: str
    #: Time of the trajectory, value and limit, in rad, m and s; where in a batch.
    time: float
    value: float
    limit: float
    batch: tuple[int, ...]


class Robot:
    """Links on joints. Make one with `from_urdf`, `from_mjcf` or `from_chain`.

    Coordinates are those of `joints`, depth first in the order of the description, as pytorch-kinematics counts them;
    joints that mimic others are no coordinates of their own. Poses are those of links in the root link.

    Attributes:
        joints: what moves by itself, with limits. links: names of all frames, the root first.
    """

    def __init__(self, joints: Sequence[Joint], frames: Sequence[Frame]):
        if not joints:
            raise ValueError("source: expected a robot with joints that move, got one without")
        for what, names in (("joints", [j.name for j in joints]), ("links", [f.name for f in frames])):
            if len(set(names)) < len(names):
                twice = next(name for name in names if names.count(name) > 1)
                raise ValueError(f"source: expected {what} of different names, got two called {twice!r}")
        self.joints, self.links = tuple(joints), tuple(frame.name for frame in frames)
        self._frames = {frame.name: frame for frame in frames}

    @classmethod
    def from_urdf(cls, source: str | PathLike[str]) -> "Robot":
        """From URDF: revolute, continuous, prismatic and fixed joints, mimicking ones included.

        Args:
            source: XML text, or the path of a file.
        Raises:
            FileNotFoundError, TypeError, ValueError: no such file, or no robot that is a tree of such joints.
        """
        with readers.naming(source):
            return cls(*readers.from_urdf(source))

    @classmethod
    def from_mjcf(cls, source: str | PathLike[str]) -> "Robot":
        """From MuJoCo's format: hinges and slides, any number on a body; sites count as links.

        Args:
            source: XML text, or the path of a file; what it includes has to be in the text.
        Raises:
            ImportError: MuJoCo is not installed. FileNotFoundError, TypeError, ValueError: as for `from_urdf`.
        """
        with readers.naming(source):
            return cls(*readers.from_mjcf(source))

    @classmethod
    def from_chain(cls, chain: Any) -> "Robot":
        """From a `pytorch_kinematics.Chain`, whose offsets are rounded to float32, about 1e-8 m.

        Raises:
            TypeError: no such chain.
        """
        return cls(*readers.from_chain(chain))

    def __repr__(self) -> str:
        return f"Robot({len(self.joints)} joints: {', '.join(self.joint_names)}; {len(self.links)} links)"

    @property
    def dof(self) -> int:
        """Number of coordinates."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Of the coordinates, in their order."""
        return tuple(joint.name for joint in self.joints)

    # ------------------------------------------------------------------ motion

    def motion(
        self,
        link: str | Sequence[str],
        q: Tensor,
        velocity: Tensor | None = None,
        acceleration: Tensor | None = None,
        jerk: Tensor | None = None,
        *,
        base: Tensor | None = None,
    ) -> State:
        """Pose of a link and, as far as those of the joints are given, its rates; O(joints on the way).

        A product of exponentials [Brockett 1984] with every screw in the link's frame, so that the recurrences of
        [S20] (34), (41) and (75) give twist, acceleration and jerk.

        Args:
            link: a name, or several, which then come as the first dimension of the results.
            q, velocity, acceleration, jerk: `(..., dof)` of the joints, rad, m and s; each only with those before it.
            base: SE3 pose (7,) of the root in the world; by default the root is the world.
        Returns:
            State: `value` (..., 7), an SE3 pose; rates `[v, omega]` (..., 6), body frame, per second.
        Differentiable in joints and base to any order, also under `torch.func`.
        Raises:
            TypeError, ValueError: a wrong type or shape, or no link of that name.
        """
        rates = [q, velocity, acceleration, jerk]
        given = next((i for i, x in enumerate(rates) if x is None), 4)
        names = ("q", "velocity", "acceleration", "jerk")
        joints: list[Tensor] = []
        for i, (name, given_x) in enumerate(zip(names, rates, strict=True)):
            if given_x is None and i > 0:
                continue
            if i > given:
                raise ValueError(f"{name}: expected {names[given]}, too, got none")
            x = checks.is_floating_tensor(name, given_x)
            checks.has_last(name, x, self.dof, f"one for each of {', '.join(self.joint_names)}")
            joints.append(x)
            checks.same_kind(**{"q": joints[0], name: x})
            checks.finite(name, x)
        checks.broadcast(**{name: x.shape for name, x in zip(names, joints, strict=False)})
        joints = list(torch.broadcast_tensors(*joints))
        paths = self._paths(link)
        if base is not None:
            _check_base(base)
            checks.same_kind(q=q, base=base)
        return _motion(paths, joints, base, not isinstance(link, str))

    def link(
        self, joints: Trajectory, link: str | Sequence[str], base: Tensor | None = None
    ) -> "LinkTrajectory":
        """The trajectory of a link whose joints follow `joints`, see `LinkTrajectory`."""
        return LinkTrajectory(self, joints, link, base)

    def residual(
        self,
        link: str,
        kind: type[Residual],
        t: Tensor,
        measured: Tensor,
        *,
        base: Tensor | None = None,
        **options: Any,
    ) -> Residual:
        """A sensor on a link, as a residual of a spline of the joints: `fit.Problem(spline).add(...)`.

        Args:
            link: its name.
            kind: what measures, such as `fit.Gyroscope`, `fit.Accelerometer`, `fit.Position`: any residual of a rigid
                body, in terms of the link's pose.
            t, measured, options: as `kind` takes them.
            base: SE3 pose (7,) of the root in the world; by default the root is the world.
        Returns:
            Residual: of trajectories in R^dof. Its loops are not compiled; those of the spline are, for half a minute
            the first time, unless `use_kernels("reference")` says otherwise, which is as quick here.
        Raises:
            TypeError, ValueError: no such link or one that no joint moves, no such kind, or what `kind` raises.
        """
        path = self._path(link)
        if not (isinstance(kind, type) and issubclass(kind, Residual)):
            raise TypeError(
                f"kind: expected a class of residuals such as torchspline.fit.Gyroscope, got {kind!r}"
            )
        kind.check_group(SE3)
        if not bool(path.factor.any()):
            raise ValueError(f"link: expected one that joints move, got {link!r}")
        pose = path.pose
        if base is not None:
            _check_base(base)
            pose = SE3.compose(base.detach().cpu().to(torch.float64), pose)
        numbers = [
            tuple(x.tolist()) for x in (pose, path.screws.flatten(), path.driver, path.factor, path.offset)
        ]
        bound = on_link(kind, link, self.dof, *numbers)
        return bound(t, measured, **{"name": f"{kind.__name__} on {link}", **options})

    def _paths(self, link: Any) -> list[Path]:
        if not isinstance(link, (str, Sequence)):
            raise TypeError(f"link: expected the name of a link, or several, got {type(link).__name__}")
        paths = [self._path(name) for name in ([link] if isinstance(link, str) else link)]
        if not paths:
            raise ValueError("link: expected the name of a link, or several, got none")
        return paths

    def _path(self, link: Any) -> Path:
        if not isinstance(link, str) or link not in self._frames:
            raise ValueError(f"link: expected one of {', '.join(self.links)}, got {link!r}")
        frames = [self._frames[link]]
        while (parent := frames[-1].parent) is not None:
            frames.append(self._frames[parent])
        pose, screws, moves = np.eye(4), [], []
        for frame in reversed(frames):
            pose = pose @ frame.pose
            for move in frame.moves:
                screws.append(_adjoint(pose) @ move.screw)
                moves.append(move)
        seen = np.array(screws).reshape(-1, 6) @ _adjoint(np.linalg.inv(pose)).T
        if not moves:  # a link that does not move is carried by a joint that does not count
            return Path(_pose(pose), torch.zeros(1, 6, dtype=torch.float64), *_numbers([(0, 0.0, 0.0)]))
        names = self.joint_names
        rows = [(names.index(move.joint), move.factor, move.offset) for move in moves]
        return Path(_pose(pose), torch.from_numpy(seen), *_numbers(rows))

    # ------------------------------------------------------------------ limits

    def over_limits(self, joints: Trajectory, t: Tensor) -> list[OverLimit]:
        """Joints that leave their limits of position or velocity at the times `t`, the worst of each; empty is good.

        Joints that mimic others come after those: their own limits hold for `factor q + offset` of the one they mimic.

        Raises:
            TypeError, ValueError: not a trajectory in R^dof, or times that it does not take.
        """
        self._check_joints(joints)
        with torch.no_grad():
            state = joints.evaluate(t, derivatives=1)
        assert state.velocity is not None
        found = []
        for joint, i, factor, offset in self._limited():
            q = factor * state.value[..., i] + offset
            rate = abs(factor) * state.velocity[..., i].abs()
            for quantity, value, limit, over in (
                ("position", q, joint.lower, joint.lower - q),
                ("position", q, joint.upper, q - joint.upper),
                ("velocity", rate, joint.velocity, rate - joint.velocity),
            ):
                if over.numel() == 0 or not bool((over > 0).any()):
                    continue
                where = np.unravel_index(int(over.argmax()), over.shape)
                *batch, n = (int(k) for k in where) if t.ndim else (*map(int, where), 0)
                time = t if t.ndim == 0 else t[n] if t.ndim == 1 else t.expand(over.shape)[(*batch, n)]
                found.append(
                    OverLimit(
                        joint.name, quantity, time.item(), float(value[tuple(where)]), limit, tuple(batch)
                    )
                )
        return found

    def _limited(self) -> list[tuple[Joint, int, float, float]]:
        """All joints, with the coordinate that moves each, factor and offset."""
        names = self.joint_names
        moves = [move for frame in self._frames.values() for move in frame.moves]
        mimics = [(x.mimic, names.index(x.joint), x.factor, x.offset) for x in moves if x.mimic is not None]
        return [*((joint, i, 1.0, 0.0) for i, joint in enumerate(self.joints)), *mimics]

    def _check_joints(self, joints: Any) -> None:
        checks.instance("joints", joints, Trajectory, "a Trajectory such as BSpline(..., group=Rn(dof))")
        if joints.group != Rn(self.dof):
            raise ValueError(
                f"joints: expected a trajectory in R{self.dof}, of {', '.join(self.joint_names)}, got {joints.group}"
            )


class LinkTrajectory(Trajectory):
    """Motion of a link, on SE3: `kinematics`, `mounted` and `imu.measure` as on any trajectory.

    Args:
        robot: it is a link of. joints: a trajectory in R^dof, any family, any batch; its parameters are this one's.
        link: its name, or several names, which come as the first dimension of the batch.
        base: SE3 pose (7,) of the robot's root in the world; one that requires grad, or a `Parameter`, is used as
            given. By default the root is the world.
    Raises:
        TypeError, ValueError: a wrong type or shape, or no link of that name.
    """

    group = SE3

    def __init__(
        self, robot: Robot, joints: Trajectory, link: str | Sequence[str], base: Tensor | None = None
    ):
        super().__init__()
        checks.instance("robot", robot, Robot, "a torchspline.robot.Robot")
        robot._check_joints(joints)
        self.robot, self.joints = robot, joints
        self._paths = robot._paths(link)
        self.names = link if isinstance(link, str) else tuple(link)
        self.base: Tensor | None = None
        if base is not None:
            _check_base(base)
            self._adopt("base", base, learnable=False)

    @property
    def domain(self) -> tuple[float, float] | tuple[int, int]:
        return self.joints.domain

    def evaluate(self, t: Tensor, derivatives: int = 2) -> State:
        """Pose and its rates at the times `t`; see `Trajectory.evaluate` and `Robot.motion`."""
        state = self.joints.evaluate(t, derivatives)
        if self.base is not None:
            checks.same_kind(joints=state.value, base=self.base)
        rows = [x for x in state if x is not None]
        return _motion(self._paths, rows, self.base, not isinstance(self.names, str))


def _check_base(base: Any) -> None:
    checks.is_floating_tensor("base", base)
    if base.shape != (7,):
        raise ValueError(f"base: expected shape (7,), an SE3 pose, got {tuple(base.shape)}")
    checks.point("base", base, SE3, "an SE3 pose")


def _motion(paths: Sequence[Path], joints: Sequence[Tensor], base: Tensor | None, several: bool) -> State:
    most = max(len(path.driver) for path in paths)
    like = joints[0]
    pose, screws, factor, offset = (
        torch.stack([_padded(path[i], most if i else None) for path in paths]).to(like) for i in (0, 1, 3, 4)
    )
    index = torch.stack([_padded(path.driver, most) for path in paths]).to(like.device)
    rows = []
    for r, x in enumerate(joints):
        # (..., L, n), then links in front
        angles = x[..., index] * factor
        rows.append((angles if r else angles + offset).movedim(-2, 0))
    weights = torch.stack(rows, dim=-2)
    if base is not None:
        pose = SE3.compose(base, pose, validate=False)
    inner = (1,) * (like.ndim - 1)
    pose, screws = pose.reshape(-1, *inner, 7), screws.reshape(-1, *inner, most, 6)
    fields = geodesics(SE3.name, pose, screws, weights)
    return State(*(fields if several else (field.squeeze(0) for field in fields)))


def _padded(x: Tensor, count: int | None) -> Tensor:
    """Rows of zeros at the end: joints that do not count."""
    if count is None or len(x) == count:
        return x
    return torch.cat([x, x.new_zeros(count - len(x), *x.shape[1:])])


def _adjoint(T: np.ndarray) -> np.ndarray:
    """Of [v, omega]: `[[R, p^ R], [0, R]]`."""
    R, (x, y, z) = T[:3, :3], T[:3, 3]
    hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.block([[R, hat @ R], [np.zeros((3, 3)), R]])


def _pose(T: np.ndarray) -> Tensor:
    return from_transform_matrix(torch.from_numpy(T))


def _numbers(rows: Sequence[tuple[int, float, float]]) -> tuple[Tensor, Tensor, Tensor]:
    driver, factor, offset = zip(*rows, strict=True)
    factors, offsets = (torch.tensor(x, dtype=torch.float64) for x in (factor, offset))
    return torch.tensor(driver), factors, offsets
