"""What perfect sensors on a moving body are exposed to: angular rate and specific force in the frame of an IMU.

The arithmetic is written once, on components. Where no gradient passes through it, a compiled loop runs it.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.arithmetic.motion import MOTIONS, Motion, attached
from torchspline.arithmetic.so3 import unrotate
from torchspline.arithmetic.vector import Vector, add, cross, negate, scale
from torchspline.groups.components import join, split
from torchspline.imu.parts import along_time
from torchspline.kernels.mode import flat, usable
from torchspline.kernels.rowwise import RowKernel
from torchspline.kernels.threads import SERIAL_BELOW, run, spans
from torchspline.splines.trajectory import MECHANICS, Trajectory


class Scene(NamedTuple):
    """Where the IMU sits and what it sits in, each (size,) or (*batch, size).

    `gravity` (3) m/s^2, world; `T_body_imu` (7) of unit length; `accelerometer_arms` (9), positions of the three axes
    in the IMU's frame, axis by axis, m; `earth_rate` (3) rad/s, rotation of the world, in the world. None: none.
    """

    gravity: Tensor
    T_body_imu: Tensor | None = None
    accelerometer_arms: Tensor | None = None
    earth_rate: Tensor | None = None


def exposed(
    motion: Motion,
    gravity: Vector,
    mount: Vector | None = None,
    arms: Vector | None = None,
    earth_rate: Vector | None = None,
) -> Vector:
    """Angular rate against inertial space and specific force at the accelerometer's axes, [S20] (69)-(70).

    With the rate W of the world (body frame) the gyroscope sees `w + W` and the specific force at a point r is
    `a + alpha x r + w x (w x r) + 2 W x (v + w x r) - g`; the centrifugal part belongs to g, as in any gravity that is
    measured by a plumb bob.
    """
    turning = None if earth_rate is None else unrotate(motion.q, earth_rate)
    fall = unrotate(motion.q, gravity)
    rate = motion.w if turning is None else add(motion.w, turning)
    q, origin = (None, None) if mount is None else (mount[3:], mount[:3])

    def force(at: Vector | None) -> Vector:
        there = motion if at is None else attached(motion, at)
        total = add(there.a, negate(fall))
        if turning is not None:
            total = add(total, scale(2.0, cross(turning, there.v)))
        return total if q is None else unrotate(q, total)

    if q is not None:
        rate = unrotate(q, rate)
    if arms is None:
        return (*rate, *force(origin))
    axes = []
    for axis in range(3):
        arm = arms[3 * axis : 3 * axis + 3]
        if q is not None and origin is not None:
            arm = add(origin, unrotate((q[0], *negate(q[1:])), arm))
        axes.append(force(arm)[axis])
    return (*rate, *axes)


def _of_kinematics(q: Vector, v: Vector, a: Vector, w: Vector, alpha: Vector) -> Motion:
    return Motion(q=q, v=unrotate(q, v), a=unrotate(q, a), w=w, alpha=alpha)


def _of_state(group: str, value: Vector, *rates: Vector) -> Motion:
    return MOTIONS[group].motion(value, rates)


def exposure(trajectory: Trajectory, t: Tensor, scene: Scene) -> Tensor:
    """`exposed` at the times `t`, (N,) or (*batch, N): angular rate and specific force, (*batch, N, 6)."""
    name = trajectory.group.name
    # A trajectory with mechanics of its own answers in them; its state may mean something else.
    stock = type(trajectory).kinematics is Trajectory.kinematics and name in MOTIONS
    if stock:
        state = trajectory.evaluate(t, derivatives=2)
        assert state.velocity is not None
        assert state.acceleration is not None
        moving, source = (state.value, state.velocity, state.acceleration), name
    else:
        motion = trajectory.kinematics(t)
        parts = (motion.rotation, motion.velocity, motion.acceleration,
                 motion.angular_velocity, motion.angular_acceleration)  # fmt: skip
        assert all(x is not None for x in parts), MECHANICS
        moving, source = parts, None  # type: ignore[assignment]
    like = moving[0]
    batches = {name: x.shape[:-1] for name, x in zip(Scene._fields, scene, strict=True) if x is not None}
    checks.broadcast(trajectory=like.shape[:-2], **batches)
    given = [None if x is None else along_time(x, like) for x in scene]
    present = [x for x in given if x is not None]
    tracked = torch.is_grad_enabled() and any(x.requires_grad for x in (*moving, *present))
    if not tracked and usable(*moving, *present):
        return _fused(moving, given, source)
    results = _function(source, tuple(x is not None for x in given))(
        *map(split, moving), *(split(x) for x in present)
    )
    return join(results, like)


def _function(source: str | None, given: tuple[bool, ...]) -> Callable[..., Vector]:
    """Components of the motion, then of what is given of a scene, to components of the result."""
    count = 3 if source else 5

    def function(*arguments: Vector) -> Vector:
        moving, rest = arguments[:count], iter(arguments[count:])
        motion = _of_kinematics(*moving) if source is None else _of_state(source, *moving)
        return exposed(motion, *(next(rest) if there else None for there in given))  # type: ignore[arg-type]

    return function


@cache
def _kernel(source: str | None, given: tuple[bool, ...], dtype: torch.dtype) -> RowKernel:
    moving = [4, 3, 3, 3, 3] if source is None else [7, 6, 6]
    shared = [size for size, there in zip((3, 7, 9, 3), given, strict=True) if there]
    name = f"imu_{source or 'motion'}_{''.join(str(int(x)) for x in given)}"
    return RowKernel(name, _function(source, given), moving, [6], dtype, shared=shared)


def _fused(moving: Sequence[Tensor], given: Sequence[Tensor | None], source: str | None) -> Tensor:
    """By the compiled loop; a trajectory of a batch may have a scene of its own."""
    shape = moving[0].shape[:-1]
    present = [x for x in given if x is not None]
    lead = torch.broadcast_shapes(shape[:-1], *(x.shape[:-2] for x in present))
    if lead != shape[:-1]:  # more scenes than trajectories
        moving = [x.expand(*lead, *x.shape[-2:]) for x in moving]
        shape = moving[0].shape[:-1]
    out = moving[0].new_empty(*shape, 6)
    arrays, result = [flat(x) for x in moving], flat(out)
    kernel = _kernel(source, tuple(x is not None for x in given), out.dtype)
    rows, items = shape.numel(), shape[:-1].numel()
    if all(x.shape[:-1].numel() == 1 for x in present):
        kernel([*arrays, *map(flat, present)], [result], rows)
        return out
    each = [x.expand(*lead, 1, x.shape[-1]).reshape(items, -1).detach().numpy() for x in present]
    loop, length = kernel._kernel, shape[-1]

    def part(begin: int, stop: int) -> None:
        for i in range(begin, stop):
            loop(*arrays, *(x[i] for x in each), result, i * length, (i + 1) * length)

    parts = 1 if rows < 2 * SERIAL_BELOW else torch.get_num_threads()
    run([partial(part, begin, stop) for begin, stop in spans(items, parts, 1)])
    return out
