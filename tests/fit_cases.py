"""States, arguments and measurements for every kind of residual, for the tests of fitting."""

import torch
from batteries import generator, normal, tangents
from torch import Tensor

from torchspline import SE3, SO3, Group
from torchspline.fit.kernel import ResidualKernel
from torchspline.fit.residual import Residual
from torchspline.fit.residuals import RESIDUALS

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
