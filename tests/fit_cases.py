"""States, arguments and measurements for every kind of residual, for the tests of fitting."""

import numpy as np
import pytest
import torch
from batteries import generator, normal, tangents
from spline_cases import control_points
from torch import Tensor

from torchspline import R3, SE3, SO3, BSpline, Group, product
from torchspline.fit import Problem, Variable
from torchspline.fit.residual import Residual
from torchspline.fit.residuals import RESIDUALS
from torchspline.fit.solving.kernel import ResidualKernel

#: The groups residuals are tried on, where they accept them; a product without a mechanical meaning among them.
CANDIDATES = tuple(map(Group, ("SE3", "R3xSO3", "SO3", "R3", "R2", "SO3xSE3")))


def accepts(kind: type[Residual], group: Group) -> bool:
    try:
        kind.check_group(group)
    except ValueError:
        return False
    return True


#: Every kind of residual on every group it makes sense on.
PAIRS = [(kind, group) for kind in RESIDUALS.values() for group in CANDIDATES if accepts(kind, group)]


each_pair = pytest.mark.parametrize(("kind", "group"), PAIRS, ids=lambda x: getattr(x, "__name__", str(x)))


def of_slot(kind: type[Residual], slot: str, count: int, seed: int = 0) -> Tensor:
    """`(count, size)` values, where the name is not known random ones; quaternions of any length."""
    size, group, default = kind.slots[slot]
    if group is not None:
        return Group(group).random(count, generator=generator(seed)) * 1.3
    x = normal(count, size, seed=seed)
    if slot == "scaling":
        return torch.eye(3, dtype=x.dtype).reshape(9) + 0.1 * x
    if slot == "intrinsics":
        small = torch.tensor([0.05, 0.02, 0.01, 0.01], dtype=x.dtype)
        return torch.cat([400.0 + 20.0 * x[:, :2], 300.0 + 20.0 * x[:, 2:4], small * x[:, 4:]], dim=-1)
    return x if default is None else torch.tensor(default, dtype=x.dtype) + x


def poses(group: Group, value: Tensor) -> Tensor:
    """SE3 poses of points of a group that moves a body."""
    return {
        "SE3": lambda x: x,
        "R3xSO3": lambda x: x,
        "SO3": lambda x: torch.cat([torch.zeros_like(x[..., :3]), x], dim=-1),
        "R3": lambda x: torch.cat([x, SO3.identity(*x.shape[:-1])], dim=-1),
    }[group.name](value)


def before_the_camera(pose: Tensor, T: Tensor, seed: int = 0) -> Tensor:
    """`(count, 3)` points of the world that a camera with pose T in the body sees, up to 70 degrees off its axis."""
    ray = normal(len(pose), 3, seed=seed)
    ray[:, 2] = ray[:, :2].norm(dim=-1) / torch.linspace(0.05, 2.7, len(pose), dtype=ray.dtype)
    return SE3.act(SE3.compose(pose, T), 2.0 * ray)


def sample(kind: type[Residual], group: Group, count: int = 6, seed: int = 0) -> dict[str, Tensor]:
    """States `value0, rates0 (count, derivatives, D), value1, ...`, `measured`, and every slot."""
    made: dict[str, Tensor] = {}
    for m in range(kind.moments):
        made[f"value{m}"] = group.random(count, generator=generator(seed + 10 * m))
        made[f"rates{m}"] = normal(count, kind.derivatives, group.tangent_size, seed=seed + 10 * m + 1)
    rows, measured_size = kind.sizes(group.arithmetic)
    made["measured"] = normal(count, measured_size, seed=seed + 2)
    if measured_size == group.point_size and rows == group.tangent_size:
        made["measured"] = group.random(count, generator=generator(seed + 2))
    for start, stop in kind.measured_signs:
        made["measured"][:, start:stop] *= torch.linspace(0.5, 3.0, count, dtype=torch.float64)[:, None]
    for i, slot in enumerate(kind.slots):
        made[slot] = of_slot(kind, slot, count, seed + 100 + i)
    if "intrinsics" in kind.slots:
        pose = poses(group, made["value0"])
        made["landmark"] = before_the_camera(pose, made["T_body_camera"], seed)
        made["measured"] = 300.0 + 100.0 * made["measured"]
    return made


def in_order(kernel: ResidualKernel, given: dict[str, Tensor]) -> list[Tensor]:
    """Arguments as a kernel takes them."""
    arrays = []
    for m in range(kernel.kind.moments):
        arrays += [given[f"value{m}"], *given[f"rates{m}"].unbind(1)]
    return [*arrays, given["measured"], *(given[slot] for slot in kernel.order)]


def moved(kind: type[Residual], group: Group, given: dict[str, Tensor], steps: dict[str, Tensor]) -> dict:
    """`given` moved by steps in tangent coordinates: points by X Exp(x), other numbers by a sum."""
    made = dict(given)
    for name, step in steps.items():
        of = group if name.startswith("value") else None
        if name in kind.slots and (slot_group := kind.slots[name].group) is not None:
            of = Group(slot_group)
        if of is None:
            made[name] = given[name] + step
        else:
            point = of.normalize(given[name], validate=False)
            made[name] = of.retract(point, step, side="right", validate=False)
    return made


def near(group: Group, angle: float, count: int, seed: int) -> Tensor:
    """Tangents that turn by an angle."""
    return tangents(group, [angle], each=count, seed=seed)


def kernel_for(kind, group, slots, own=True):
    """The kernel that is given these slots, of each measurement its own or of all the same."""
    return ResidualKernel(kind, group.name, tuple((slot, own) for slot in slots))


def equidistant(x, y, z, k1, k2, k3, k4):
    """OpenCV, fisheye, with the angle by atan2."""
    r = np.hypot(x, y)
    angle = np.arctan2(r, z)
    distorted = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    return distorted * x / r, distorted * y / r


SPLIT = product(R3, SO3)


def trajectory(group=SE3, count=12, order=4, dt=0.3, gap=0.4, seed=3, **options):
    if "dt_ns" not in options:
        options["dt"] = dt
    return BSpline(control_points(group, count, gap=gap, seed=seed), group=group, order=order, **options)


def spread(spline, count, seed=0, margin=0.03):
    """Times in the domain in no order, the first two of them equal."""
    low, high = spline.domain
    u = margin + (1 - 2 * margin) * torch.rand(count, generator=generator(seed), dtype=torch.float64)
    u[1] = u[0]
    if spline.dt_ns is not None:
        return low + (u * (high - low)).to(torch.int64)
    return low + u * (high - low)


def measurements(kind, spline, count, seed=0):
    """Times, and measurements that are wrong by about as much as they are large."""
    made = sample(kind, spline.group, count, seed)
    t = spread(spline, count * kind.moments, seed)
    return t if kind.moments == 1 else t.reshape(kind.moments, count), made["measured"]


def unknown(kind, slot, spline, t, seed=0):
    """A variable for a slot, at a place where the residual makes sense."""
    value = of_slot(kind, slot, 1, seed)[0]
    group = kind.slots[slot].group
    if slot == "landmark" and "intrinsics" in kind.slots:
        with torch.no_grad():
            pose = poses(spline.group, spline(t))
        value = before_the_camera(pose, SE3.identity(len(t)), seed)
    return Variable(slot, value, group=None if group is None else Group(group))


def build(kind, group, count=7, **options):
    spline = trajectory(group)
    t, measured = measurements(kind, spline, count)
    arguments = {slot: unknown(kind, slot, spline, t) for slot in kind.slots}
    index = {}
    if "landmark" in arguments and arguments["landmark"].value.ndim == 2:
        index["landmark"] = torch.arange(count)
        arguments["T_body_camera"].value = SE3.exp(0.01 * normal(6, seed=1))
    problem = Problem(spline)
    problem.add(kind(t, measured, **arguments, **options), **index)
    return problem, {kind.__name__: index}


def bias_spline(spline, order=4, count=8, seed=5):
    low, high = spline.domain
    points = 0.1 * normal(count, 3, seed=seed)
    if spline.dt_ns is not None:
        dt = -(-(high - low) // (count - order + 1))
        return BSpline(points, group=R3, order=order, dt_ns=dt, t0_ns=low)
    return BSpline(points, group=R3, order=order, dt=(high - low) / (count - order + 1), t0=low)
