"""The trajectory that is approximated, seen in the group of the result."""

import torch
from torch import Tensor

from torchspline.fit.approximation.compare import RIGID, device_of
from torchspline.fit.approximation.pieces import Pieces, pieces
from torchspline.groups.convert import pose_from_dual_quaternion, pose_to_dual_quaternion
from torchspline.groups.group import SE3, SO3, DualQuaternion, Group
from torchspline.splines.bspline import BSpline
from torchspline.splines.hermite import HermiteSpline
from torchspline.splines.interpolation import KeyframeSpline
from torchspline.splines.nonuniform import NonuniformBSpline
from torchspline.splines.trajectory import Kinematics, Mounted, State, Trajectory

#: Names of the survey for the same scheme on the two groups of joint poses; plain names are the same on both.
_ON_DUAL_QUATERNIONS = {"se3up": "ScLERP", "spfus": "ScFus"}
_ON_POSES = {"sclerp": "SE3Up", "scfus": "SpFus"}
_ALIKE = ("geodesic", "squad", "cumulative_bspline")


class Source:
    """Values and rates of a trajectory as those of `group`, float64 on the CPU, without a graph."""

    def __init__(self, trajectory: Trajectory, group: Group):
        self.trajectory, self.group = trajectory, group
        self.pieces: Pieces = pieces(trajectory)
        self.start: float | int
        self.end: float | int
        self.start, self.end = trajectory.domain
        self.device = device_of(trajectory)

    @property
    def linear(self) -> bool:
        """Whether it is a curve of plain numbers."""
        return not self.trajectory.group.arithmetic.unit_blocks

    def values(self, t: Tensor) -> Tensor:
        """`(*batch, N, P)` at times (N,)."""
        with torch.no_grad():
            values = self.trajectory(t.to(self.device)).cpu().to(torch.float64)
        return in_group(values, self.trajectory.group, self.group)

    def states(self, t: Tensor) -> State:
        """Value, velocity and acceleration at times (N,); where they jump, those from the right."""
        with torch.no_grad():
            if self.trajectory.group == self.group:
                state = self.trajectory.evaluate(t.to(self.device), 2)
                return State(*(None if x is None else x.cpu().to(torch.float64) for x in state))  # type: ignore[arg-type]
            motion = self.trajectory.kinematics(t.to(self.device))
            assert all(x is not None for x in motion)
            motion = Kinematics(*(x.cpu().to(torch.float64) for x in motion))  # type: ignore[union-attr]
        return _of_motion(motion, self.group)


def in_group(points: Tensor, group: Group, other: Group) -> Tensor:
    """Points of a rigid motion as those of another group of rigid motions."""
    if group == other or {group.name, other.name} <= {"SE3", "R3xSO3"}:
        return points
    assert group.name in RIGID
    return pose_to_dual_quaternion(points) if other == DualQuaternion else pose_from_dual_quaternion(points)


def _of_motion(motion: Kinematics, group: Group) -> State:
    """Inverse of `Trajectory.kinematics` for rigid motions."""
    q, p, v, a, w, alpha = motion
    assert q is not None
    assert p is not None
    assert v is not None
    assert a is not None
    assert w is not None
    assert alpha is not None
    pose = torch.cat([p, q], dim=-1)
    if group.name == "R3xSO3":
        return State(pose, torch.cat([v, w], dim=-1), torch.cat([a, alpha], dim=-1))
    back = SO3.inverse(q, validate=False)
    body_v, body_a = SO3.act(back, v, validate=False), SO3.act(back, a, validate=False)
    rates = torch.cat([body_v, w], -1), torch.cat([body_a - torch.linalg.cross(w, body_v), alpha], -1)
    return State(in_group(pose, SE3, group), *rates)


def plain(trajectory: Trajectory, group: Group) -> Trajectory:
    """The same curve, not one frame mounted on another and not a dual quaternion where a pose is wanted, wherever
    that changes nothing but how it is stored."""
    if isinstance(trajectory, Mounted):
        trajectory = _unmounted(trajectory)
    if {trajectory.group.name, group.name} != {"SE3", "DualQuaternion"}:
        return trajectory

    def move(points: Tensor) -> Tensor:
        return in_group(points.detach(), trajectory.group, group)

    if isinstance(trajectory, BSpline | NonuniformBSpline):
        return remade(trajectory, control_points=move(trajectory.control_points), group=group)
    if isinstance(trajectory, HermiteSpline):
        return remade(trajectory, values=move(trajectory.values), group=group)
    if isinstance(trajectory, KeyframeSpline):
        names = _ON_DUAL_QUATERNIONS if group == DualQuaternion else _ON_POSES
        method = names.get(trajectory.method.lower(), trajectory.method)
        if method != trajectory.method or method in _ALIKE:
            return remade(trajectory, keyframes=move(trajectory.keyframes), group=group, method=method)
    return trajectory


def _unmounted(trajectory: Mounted) -> Trajectory:
    """B-splines of moved control points: `X Exp(d) T = (X T) Exp(Ad_T^-1 d)`, where T is of the group itself."""
    inner, group = trajectory.trajectory, trajectory.group
    inner = _unmounted(inner) if isinstance(inner, Mounted) else inner
    if group.name == "R3xSO3" or not isinstance(inner, BSpline | NonuniformBSpline):
        return trajectory
    T = trajectory.T_body_sensor.detach()
    T = T[..., 3:] if group == SO3 else in_group(T, SE3, group)
    points = group.compose(inner.control_points.detach(), T.unsqueeze(-2) if T.ndim > 1 else T)
    return remade(inner, control_points=points)


def remade(trajectory: Trajectory, **changes: object) -> Trajectory:
    """A copy of a spline with some of its arguments changed; numbers are copied, Parameters anew."""
    made: dict[str, object] = {"extrapolate": trajectory.extrapolate, "validate": trajectory.validate}
    if isinstance(trajectory, BSpline):
        made |= {"control_points": trajectory.control_points.detach(), "order": trajectory.order}
        if trajectory.dt_ns is not None:
            made |= {"dt_ns": trajectory.dt_ns, "t0_ns": trajectory.t0_ns}
        else:
            assert trajectory.dt is not None
            assert trajectory.t0 is not None
            made |= {"dt": trajectory.dt.detach(), "t0": trajectory.t0.detach()}
        return BSpline(**{**made, "group": trajectory.group, **changes})  # type: ignore[arg-type]
    if isinstance(trajectory, NonuniformBSpline):
        made |= {"control_points": trajectory.control_points.detach(), "order": trajectory.order}
        made |= {"knots": trajectory.knots.detach(), "group": trajectory.group}
        return NonuniformBSpline(**{**made, **changes})  # type: ignore[arg-type]
    if isinstance(trajectory, HermiteSpline):
        names = ("values", "velocities", "accelerations", "times")
        made |= {name: getattr(trajectory, name).detach() for name in names}
        made |= {"group": trajectory.group, "coordinates": trajectory.coordinates, "frame": trajectory.frame}
        return HermiteSpline(**{**made, **changes})  # type: ignore[arg-type]
    assert isinstance(trajectory, KeyframeSpline)
    made |= {
        "keyframes": trajectory.keyframes.detach(),
        "times": trajectory.times.detach(),
        "way": trajectory.way,
    }
    made |= {"group": trajectory.group, "method": trajectory.method, **trajectory.options}
    return KeyframeSpline(**{**made, **changes})  # type: ignore[arg-type]
