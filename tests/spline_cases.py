"""Control points for the tests of splines: ordinary ones, and those that splines of other libraries stumble over."""

import torch
from batteries import LENGTHS, PI, generator, half_turns, normal, rescaled, scale_blocks, tangents
from torch import Tensor

from torchspline.functional import bspline
from torchspline.groups import Group

ORDERS = (2, 3, 4, 5, 6, 7)

#: Rotation between neighbours, in radians; other components move about as far.
GAPS = {
    "identical": 0.0,
    "1e-12 apart": 1e-12,
    "1e-8 apart": 1e-8,
    "1e-4 apart": 1e-4,
    "general": 0.8,
    "unnormalised": 0.8,
    "almost pi apart": PI - 1e-6,
}


def chain(group: Group, steps: Tensor, seed: int = 0) -> Tensor:
    """Points `(*batch, M, P)` that are `steps` (*batch, M - 1, D) apart; the first one is random."""
    start = group.random(generator=generator(seed))
    points = [start.expand(*steps.shape[:-2], -1)]
    for d in steps.unbind(-2):
        points.append(group.compose(points[-1], group.exp(d)))
    return torch.stack(points, dim=-2)


def control_points(group: Group, count: int, gap: float = 0.8, seed: int = 0) -> Tensor:
    """`(count, P)`, neighbours rotated by `gap` against each other and shifted about as far."""
    steps = tangents(group, [1.0], each=count - 1, seed=seed) * gap
    if gap == 0.0:
        return chain(group, steps[:0], seed).expand(count, -1).clone()
    return chain(group, steps, seed)


def scaled(group: Group, points: Tensor, seed: int = 0) -> Tensor:
    """The same elements: quaternions in lengths from 1e-15 to 1e15 and random signs."""
    order = torch.randperm(len(LENGTHS), generator=generator(seed)).tolist()
    signs = normal(len(points), seed=seed).sign().tolist()
    factors = [LENGTHS[order[i % len(order)]] * sign for i, sign in enumerate(signs)]
    return rescaled(group, points, factors)


def configurations(group: Group, count: int, seed: int = 0) -> Tensor:
    """`(len(GAPS), count, P)`, in the order of `GAPS`."""
    made = [control_points(group, count, gap, seed=seed + i) for i, gap in enumerate(GAPS.values())]
    which = list(GAPS).index("unnormalised")
    made[which] = scaled(group, made[which], seed)
    return torch.stack(made)


def exactly_pi_apart(group: Group, count: int) -> Tensor:
    """`(K, count, P)`: from point to point and back by an exact half-turn, scalar parts exactly zero."""
    turn = half_turns(group)
    return torch.stack([turn if i % 2 else group.identity(len(turn)) for i in range(count)], dim=1)


def sizes(group: Group, points: Tensor) -> Tensor:
    """The lengths of quaternions at their components, ones elsewhere: the scale on which points may move."""
    scale = torch.ones_like(points)
    for start, stop, _ in scale_blocks(group):
        scale[..., start:stop] = points[..., start:stop].norm(dim=-1, keepdim=True)
    return scale


DT, T0 = 0.7, -0.3
PLACES = (0.13, 0.5, 1.71)


def close(actual, expected, tolerance):
    """Relative to the largest number expected, at least to one; NaN is never close."""
    assert actual.shape == expected.shape
    return bool((actual - expected).abs().max() <= tolerance * expected.abs().max().clamp_min(1.0))


def times(batch=(), dtype=torch.float64):
    """Queries in the first two segments, of each batch element its own."""
    t = T0 + DT * torch.tensor(PLACES, dtype=torch.float64)
    return (t + 0.01 * torch.arange(batch[0], dtype=torch.float64)[:, None] if batch else t).to(dtype)


def number(x):
    return torch.tensor(x, dtype=torch.float64)


def fields(group, order, derivatives=3, **options):
    """The spline as a function of everything it is differentiable in, all results side by side."""

    def function(points, t, dt=DT, t0=T0):
        state = bspline(points, t, group=group, order=order, dt=dt, t0=t0, derivatives=derivatives, **options)
        return torch.cat(state[: derivatives + 1], dim=-1)

    return function
