"""What every trajectory answers, whatever it is made of."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchspline import checks
from torchspline.groups.convert import pose_from_dual_quaternion, pose_to_dual_quaternion
from torchspline.groups.group import SE3, SO3, DualQuaternion, Group


class State(NamedTuple):
    """Value `(*batch, N, P)` and time derivatives `(*batch, N, D)`; those not asked for are None.

    `velocity` is the body-frame tangent `X^-1 dX/dt` per second (for the R^n part of a product that is the plain
    world-frame rate), `acceleration` and `jerk` its derivatives by time.
    """

    value: Tensor
    velocity: Tensor | None = None
    acceleration: Tensor | None = None
    jerk: Tensor | None = None


def to_world_frame(state: State, group: Group) -> State:
    """The same derivatives in the world frame, `dX/dt X^-1` and its derivatives by time, as [E17] has them.

    Ad_X carries velocity and acceleration across, and jerk once `[velocity, acceleration]` is added.
    """
    X, v, a, j = state
    if j is not None and v is not None and a is not None:
        j = j + group.bracket(v, a, validate=False)
    return State(X, *(None if r is None else group.adjoint_act(X, r, validate=False) for r in (v, a, j)))


def to_body_frame(state: State, group: Group) -> State:
    """Inverse of `to_world_frame`."""
    X, *rates = state
    back = group.inverse(X, validate=False)
    v, a, j = (None if r is None else group.adjoint_act(back, r, validate=False) for r in rates)
    if j is not None and v is not None and a is not None:
        j = j - group.bracket(v, a, validate=False)
    return State(X, v, a, j)


class Kinematics(NamedTuple):
    """Motion in the terms of mechanics; what the group does not have (a rotation of R3) is None.

    `rotation` (..., 4) quaternion [w, x, y, z], body to world; `position` (..., 3), `velocity`, `acceleration` of the
    body origin in the world frame, m, m/s, m/s^2; `angular_velocity`, `angular_acceleration` in the body frame,
    rad/s, rad/s^2.
    """

    rotation: Tensor | None
    position: Tensor | None
    velocity: Tensor | None
    acceleration: Tensor | None
    angular_velocity: Tensor | None
    angular_acceleration: Tensor | None


def _of_so3(s: State) -> Kinematics:
    return Kinematics(s.value, None, None, None, s.velocity, s.acceleration)


def _of_r3(s: State) -> Kinematics:
    return Kinematics(None, s.value, s.velocity, s.acceleration, None, None)


def _of_split(s: State) -> Kinematics:
    assert s.velocity is not None
    assert s.acceleration is not None
    return Kinematics(
        s.value[..., 3:], s.value[..., :3], s.velocity[..., :3], s.acceleration[..., :3],
        s.velocity[..., 3:], s.acceleration[..., 3:],
    )  # fmt: skip


def _of_se3(s: State) -> Kinematics:
    """[S20] (33) and (40): the translation column of X (w^ w^ + a^)."""
    assert s.velocity is not None
    assert s.acceleration is not None
    q, (v, w), a = s.value[..., 3:], s.velocity.split(3, -1), s.acceleration
    velocity = SO3.act(q, v, validate=False)
    acceleration = SO3.act(q, torch.linalg.cross(w, v) + a[..., :3], validate=False)
    return Kinematics(q, s.value[..., :3], velocity, acceleration, w, a[..., 3:])


def _of_dual_quaternion(s: State) -> Kinematics:
    return _of_se3(s._replace(value=pose_from_dual_quaternion(s.value)))


#: How the states of a group read as motion; a group that moves a rigid body adds its line here and in `_ATTACH`.
MECHANICS: dict[str, Callable[[State], Kinematics]] = {
    "SO3": _of_so3,
    "R3": _of_r3,
    "R3xSO3": _of_split,
    "SE3": _of_se3,
    "DualQuaternion": _of_dual_quaternion,
}


class Trajectory(nn.Module, ABC):
    """A curve in a Lie group over an interval of time."""

    #: The group its values live in.
    group: Group
    #: Names of what it keeps in seconds: tensors, Parameters or None, float64 whatever the module is converted to; or
    #: in whole nanoseconds, int64.
    _times: tuple[str, ...] = ()

    @property
    @abstractmethod
    def domain(self) -> tuple[float, float] | tuple[int, int]:
        """First and last time that belong to it, in seconds, or in nanoseconds where times are int64."""

    @abstractmethod
    def evaluate(self, t: Tensor, derivatives: int = 2) -> State:
        """Value and time derivatives (0 to 3 of them) at the times `t`."""

    def _keep(self, name: str, x: Tensor) -> None:
        """Keep `x` under `name`: a `Parameter` as one, anything else as a buffer, which may carry a graph."""
        self.__dict__.pop(name, None)
        if isinstance(x, nn.Parameter):
            self.register_parameter(name, x)
        else:
            self.register_buffer(name, x)

    def _adopt(self, name: str, x: Tensor, learnable: bool) -> None:
        """Keep `x` as given if it carries a graph or is a `Parameter`, else a copy: a `Parameter` if `learnable`."""
        if not x.requires_grad and not isinstance(x, nn.Parameter):
            x = x.clone(memory_format=torch.contiguous_format)
            if learnable:
                x = nn.Parameter(x)
        self._keep(name, x)

    def _adopt_seconds(self, name: str, x: Tensor) -> None:
        """Keep times as given if they carry a graph or are a `Parameter`, else a copy in float64 that is not learnt;
        int64 nanoseconds stay what they are."""
        if x.dtype != torch.int64 and not isinstance(x, nn.Parameter) and not x.requires_grad:
            x = x.to(torch.float64)
        self._adopt(name, x, learnable=False)

    def _apply(self, fn: Any, recurse: bool = True) -> "Trajectory":
        """Move and convert, but times stay in the precision they have: float32 cannot tell epochs apart."""
        times: dict[str, Tensor] = {n: x for n in self._times if (x := getattr(self, n)) is not None}
        # A Parameter is converted in place: only other tensors on the same memory still have its numbers then.
        numbers = {name: x.detach() for name, x in times.items()}
        learnt = {name: x for name, x in times.items() if isinstance(x, nn.Parameter)}
        grads = {name: x.grad.detach() for name, x in learnt.items() if x.grad is not None}
        super()._apply(fn, recurse)
        for name, before in times.items():
            new = getattr(self, name)
            if new.dtype == numbers[name].dtype:
                continue
            if isinstance(new, nn.Parameter):
                new.data = numbers[name].to(new.device)
                new.grad = grads[name].to(new.device) if name in grads else None
            else:
                setattr(self, name, before.to(new.device))
        return self

    def _load_from_state_dict(self, state: Any, prefix: str, *rest: Any) -> None:
        """Seconds stay seconds and nanoseconds nanoseconds: the numbers of a state say which, not the module's."""
        for name in self._times:
            own, new = getattr(self, name), state.get(prefix + name)
            if (
                own is not None
                and isinstance(new, Tensor)
                and (own.dtype == torch.int64) != (new.dtype == torch.int64)
            ):
                self._keep(name, torch.empty_like(own.detach(), dtype=new.dtype))
        super()._load_from_state_dict(state, prefix, *rest)

    def forward(self, t: Tensor) -> Tensor:
        """Values at the times `t`, `(*batch, N, P)`."""
        return self.evaluate(t, derivatives=0).value

    def kinematics(self, t: Tensor) -> Kinematics:
        """Rotation, position and their rates at the times `t`.

        Raises:
            ValueError: the group is not one of SO3, R3, R3xSO3, SE3, DualQuaternion.
        """
        if self.group.name not in MECHANICS:
            raise ValueError(
                f"kinematics: {self.group} does not describe the motion of a body; expected one of "
                f"{', '.join(MECHANICS)}"
            )
        return MECHANICS[self.group.name](self.evaluate(t, derivatives=2))

    def mounted(self, T_body_sensor: Tensor) -> "Trajectory":
        """The same motion as seen from a frame that is rigidly attached to the body, lever arm included.

        Args:
            T_body_sensor: SE3 pose (7,) [x, y, z, qw, qx, qy, qz] of the frame in the body, or `(*batch, 7)` for
                trajectories of that batch. One that requires grad is used as given.
        Returns:
            A trajectory of the same group and domain.
        """
        return Mounted(self, T_body_sensor)


class Mounted(Trajectory):
    """A trajectory shifted to a frame on the same rigid body: values `X(t) T`.

    Args:
        T_body_sensor: see `Trajectory.mounted`; `name` is what errors call it.
    """

    def __init__(self, trajectory: Trajectory, T_body_sensor: Tensor, name: str = "T_body_sensor"):
        super().__init__()
        if not isinstance(trajectory, Trajectory):
            raise TypeError(f"trajectory: expected a Trajectory, got {type(trajectory).__name__}")
        if trajectory.group.name not in _ATTACH:
            raise ValueError(
                f"trajectory: expected one in {', '.join(_ATTACH)}, to whose body a frame can be attached, "
                f"got {trajectory.group}"
            )
        checks.point(name, T_body_sensor, SE3, "an SE3 pose")
        self.trajectory, self.name = trajectory, name
        self.group = trajectory.group
        self.T_body_sensor: Tensor
        if not T_body_sensor.requires_grad and not isinstance(T_body_sensor, nn.Parameter):
            T_body_sensor = T_body_sensor.clone()
        self._keep("T_body_sensor", T_body_sensor)

    @property
    def domain(self) -> tuple[float, float] | tuple[int, int]:
        return self.trajectory.domain

    def evaluate(self, t: Tensor, derivatives: int = 2) -> State:
        """Value and time derivatives of the attached frame, see `Trajectory.evaluate`."""
        state = self.trajectory.evaluate(t, derivatives)
        T = self.T_body_sensor
        checks.same_kind(trajectory=state.value, **{self.name: T})
        batch = state.value.shape[: -2 if t.ndim > 0 else -1]
        checks.broadcast(trajectory=batch, **{self.name: T.shape[:-1]})
        if T.ndim > 1 and t.ndim > 0:  # the times come between the batch and the components
            T = T.unsqueeze(-2)
        return _ATTACH[self.group.name](state, T)


def _attach_se3(s: State, T: Tensor, group: Group = SE3) -> State:
    """T is constant, so every rate is just seen from the other frame: Ad_{T^-1}."""
    back = group.inverse(T, validate=False)
    rates = (None if r is None else group.adjoint_act(back, r, validate=False) for r in s[1:])
    return State(group.compose(s.value, T, validate=False), *rates)


def _attach_dual_quaternion(s: State, T: Tensor) -> State:
    return _attach_se3(s, pose_to_dual_quaternion(T), DualQuaternion)


def _attach_so3(s: State, T: Tensor) -> State:
    q = T[..., 3:]
    back = SO3.inverse(q, validate=False)
    rates = (None if r is None else SO3.act(back, r, validate=False) for r in s[1:])
    return State(SO3.compose(s.value, q, validate=False), *rates)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


def _attach_split(s: State, T: Tensor) -> State:
    """Rigid-body transport of position rates over the lever arm; rotations as in SO3."""
    rotation = _attach_so3(State(*(None if x is None else x[..., 3:] for x in s)), T)  # type: ignore[arg-type]
    q, arm = s.value[..., 3:], T[..., :3].expand(*rotation.value.shape[:-1], 3)
    offsets = [arm]
    if s.velocity is not None:
        w = s.velocity[..., 3:]
        offsets.append(_cross(w, arm))
    if s.acceleration is not None:
        a = s.acceleration[..., 3:]
        offsets.append(_cross(a, arm) + _cross(w, offsets[1]))
    if s.jerk is not None:
        body_rate = _cross(s.jerk[..., 3:], arm) + _cross(a, offsets[1]) + _cross(w, _cross(a, arm))
        offsets.append(_cross(w, offsets[2]) + body_rate)
    joined = [
        torch.cat([x[..., :3] + SO3.act(q, offset, validate=False), r], dim=-1)
        for x, offset, r in zip(s, offsets, rotation, strict=False)
        if x is not None and r is not None
    ]
    return State(*joined)


_ATTACH: dict[str, Callable[[State, Tensor], State]] = {
    "SO3": _attach_so3,
    "R3xSO3": _attach_split,
    "SE3": _attach_se3,
    "DualQuaternion": _attach_dual_quaternion,
}
