"""How far two trajectories lie apart, in rotation and in position."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.arithmetic.product import Product
from torchspline.fit.approximation.pieces import pieces
from torchspline.groups.convert import pose_from_dual_quaternion
from torchspline.groups.group import SE3, SO2, SO3, Group
from torchspline.splines.trajectory import Trajectory

#: Groups of rigid motions that tell the same poses.
RIGID = ("SE3", "R3xSO3", "DualQuaternion")


class Difference(NamedTuple):
    """Largest and root mean square distances; None for what the group does not have.

    Rotation in rad, the angle of the turn between both; position in the unit of the positions, m for poses. Products
    of several rotations or spaces give the square root of the sum of squares.
    """

    rotation_max: float | None
    rotation_rms: float | None
    position_max: float | None
    position_rms: float | None


def compare(trajectory: Trajectory, reference: Trajectory, *, samples: int = 8) -> Difference:
    """How far `trajectory` lies from `reference` over the time that both have, on a dense grid.

    What the coupling of translation and rotation costs ([H18] Figures 5 and 6) is one call: the same keyframes, or
    control points, once with a joint scheme or group (SE3, DualQuaternion) and once split (R3xSO3).

    Args:
        trajectory, reference: of the same group, or both rigid motions (SE3, R3xSO3, DualQuaternion); times both in
            seconds or both in nanoseconds. Batches broadcast and all of them count.
        samples: equal steps into which every stretch between neighbouring knots of either is divided.
    Returns:
        Difference.
    Raises:
        TypeError, ValueError: a wrong type or value; groups, times or batches that do not go together.
    """
    for name, x in (("trajectory", trajectory), ("reference", reference)):
        checks.instance(name, x, Trajectory, "a Trajectory")
    checks.whole("samples", samples, least=1)
    check_groups(trajectory.group, reference.group, "reference")
    (start, end), (other_start, other_end) = trajectory.domain, reference.domain
    if isinstance(start, int) != isinstance(other_start, int):
        raise TypeError(
            f"reference: expected times in {'nano' * isinstance(start, int)}seconds as those of trajectory, got "
            f"{'nano' * isinstance(other_start, int)}seconds"
        )
    start, end = max(start, other_start), min(end, other_end)
    if not start < end:
        raise ValueError(
            f"reference: expected a domain that overlaps that of trajectory, {trajectory.domain}, got "
            f"{reference.domain}"
        )
    breaks = union(pieces(trajectory).breaks, pieces(reference).breaks, start, end)
    rotation, position = profile(trajectory, reference, grid(breaks, samples))
    return summary(rotation, position)


def check_groups(group: Group, other: Group, name: str) -> None:
    """Points of both can be compared."""
    if group.name != other.name and not (group.name in RIGID and other.name in RIGID):
        among = f" or one of {', '.join(RIGID)}" if group.name in RIGID else ""
        raise ValueError(f"{name}: expected {group}{among} to go with a trajectory in {group}, got {other}")


def union(a: Tensor, b: Tensor, start: float | int, end: float | int) -> Tensor:
    """Breaks of both from start to end, without those that differ by rounding only."""
    both = torch.cat([a, b, a.new_tensor([start, end])]).sort().values
    both = both[(both >= start) & (both <= end)]
    if both.dtype == torch.int64:
        return both.unique()
    least = 1e-12 * (end - start) + 8.0 * torch.finfo(torch.float64).eps * max(abs(start), abs(end))
    kept = both[torch.nn.functional.pad(both.diff() > least, (1, 0), value=True)]
    kept[-1] = end
    return kept


def grid(breaks: Tensor, samples: int) -> Tensor:
    """Times at which each stretch is cut into `samples` equal steps, ends included."""
    inside = torch.arange(samples, dtype=torch.float64) / samples
    return torch.cat([within(breaks, inside), breaks[-1:]])


def within(breaks: Tensor, u: Tensor) -> Tensor:
    """Times at the places `u` in [0, 1) of each stretch, in order; whole nanoseconds where breaks are."""
    steps = breaks.diff()[:, None] * u
    if breaks.dtype == torch.int64:
        steps = steps.round().to(torch.int64)
    return torch.minimum(breaks[:-1, None] + steps, breaks[1:, None]).flatten()


def profile(trajectory: Trajectory, reference: Trajectory, t: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Angles and distances `(*batch, N)` at the times `t` (N,), on the CPU in float64."""
    with torch.no_grad():
        a, b = (x(t.to(device_of(x))).cpu().to(torch.float64) for x in (trajectory, reference))
    checks.broadcast(trajectory=a.shape[:-2], reference=b.shape[:-2])
    return distances(trajectory.group, a, reference.group, b)


def device_of(trajectory: Trajectory) -> torch.device:
    tensors = [*trajectory.parameters(), *trajectory.buffers()]
    return tensors[0].device if tensors else torch.device("cpu")


def distances(group: Group, a: Tensor, other: Group, b: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Angles and distances between points of either group."""
    angles: list[Tensor] = []
    lengths: list[Tensor] = []
    for (kind, x), (_, y) in zip(_parts(group, a), _parts(other, b), strict=True):
        if kind is None:
            lengths.append((x - y).norm(dim=-1))
        else:
            angles.append(kind.log(kind.between(x, y, validate=False), validate=False).norm(dim=-1))
    rotation, position = (
        torch.stack(x).square().sum(0).sqrt() if len(x) > 1 else x[0] if x else None
        for x in (angles, lengths)
    )
    return rotation, position


def _parts(group: Group, points: Tensor) -> list[tuple[Group | None, Tensor]]:
    """Positions (None) and rotations (with their group) of points; the same order for all rigid motions."""
    algebra = group.arithmetic
    if isinstance(algebra, Product):
        shares = points.split([f.point_size for f in algebra.factors], dim=-1)
        pairs = zip(algebra.factors, shares, strict=True)
        return [part for factor, share in pairs for part in _parts(Group(factor.name), share)]
    if group.name == "DualQuaternion":
        return _parts(SE3, pose_from_dual_quaternion(points))
    rotations: list[tuple[Group | None, Tensor]] = []
    rest = torch.ones(points.shape[-1], dtype=torch.bool)
    for start, stop in algebra.unit_blocks:
        rest[start:stop] = False
        rotations.append((SO3 if stop - start == 4 else SO2, points[..., start:stop]))
    return [(None, points[..., rest]), *rotations] if bool(rest.any()) else rotations


def summary(rotation: Tensor | None, position: Tensor | None) -> Difference:
    numbers: list[float | None] = []
    for x in (rotation, position):
        numbers += [None, None] if x is None else [float(x.amax()), float(x.square().mean().sqrt())]
    return Difference(*numbers)
