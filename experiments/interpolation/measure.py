"""Properties and runtimes of interpolation schemes, measured rather than declared."""

import time
from typing import Any

import torch
from torch import Tensor

from torchspline import SE3, Group, KeyframeSpline
from torchspline.groups import convert
from torchspline.splines.interpolation import SURVEY

DOUBLE = torch.float64
KEYS = 9


def group_of(name: str) -> Group:
    group = SURVEY[name].group
    return Group("R3" if group == "Rn" else group)


def random_keys(group: Group, count: int, seed: int) -> Tensor:
    """Neighbours a moderate step apart, the short way round."""
    generator = torch.Generator().manual_seed(seed)
    points = [group.random(generator=generator)]
    for _ in range(count - 1):
        step = torch.randn(group.tangent_size, generator=generator, dtype=DOUBLE)
        points.append(group.compose(points[-1], group.exp(1.2 * step / step.norm())))
    return torch.stack(points)


def properties(name: str, seed: int) -> dict[str, Any]:
    """Whether it meets the keys; how many derivatives are continuous there; which keys a segment depends on."""
    group, times = group_of(name), torch.arange(KEYS, dtype=DOUBLE)
    keys = random_keys(group, KEYS, seed)
    spline = KeyframeSpline(name, keys, times, learnable=False)
    miss = group.log(group.between(keys, spline(times))).norm(dim=-1).max().item()

    h, continuous = 1e-7, 0
    before, after = (spline.evaluate(times[1:-1] + s * h, 3) for s in (-1, 1))
    for earlier, later in zip(before[1:], after[1:], strict=True):
        if (earlier - later).abs().max() > 1e-3:
            break
        continuous += 1

    # The square of a velocity's length between keys, in units of the largest.
    within = torch.linspace(0.1, 0.9, 9, dtype=DOUBLE)
    rates = spline.evaluate((times[:-1, None] + within).flatten(), 1).velocity
    assert rates is not None
    speeds = rates.square().sum(-1).reshape(KEYS - 1, -1)
    uneven = (speeds.amax(-1) - speeds.amin(-1)).max() / speeds.max()

    middle = KEYS // 2
    moved = keys.clone()
    moved[middle] = group.compose(
        keys[middle], group.exp(torch.full((group.tangent_size,), 0.1, dtype=DOUBLE))
    )
    other = KeyframeSpline(name, moved, times, learnable=False)
    centres = times[:-1] + 0.5
    changed = (spline(centres) - other(centres)).abs().amax(-1) > 1e-9
    segments = int(changed.sum())
    return {
        "group": group.name if SURVEY[name].group != "Rn" else "R^n",
        "interpolates": miss < 1e-12,
        "miss_at_keys": miss,
        "continuous_derivatives": continuous,
        "constant_speed": bool(uneven < 1e-9),
        "segments_moved_by_a_key": segments,
        "segments": KEYS - 1,
        "local": segments < KEYS - 1,
        "numbers_per_key": group.point_size,
        "derivatives": 3,
    }


def runtime(name: str, batch: int, repetitions: int, derivatives: int, seed: int) -> float:
    """Nanoseconds an evaluation, values (and rates) at sorted times; the fastest of all repetitions, compiled
    before."""
    group, times = group_of(name), torch.arange(KEYS, dtype=DOUBLE)
    if group.name == "DualQuaternion":
        keys = convert.pose_to_dual_quaternion(random_keys(SE3, KEYS, seed))
    else:
        keys = random_keys(group, KEYS, seed)
    spline = KeyframeSpline(name, keys, times, learnable=False)
    t = (KEYS - 1) * torch.rand(
        batch, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE
    ).sort().values
    best = float("inf")
    spline.evaluate(t, derivatives)
    for _ in range(repetitions):
        start = time.perf_counter()
        spline.evaluate(t, derivatives)
        best = min(best, time.perf_counter() - start)
    return best / batch * 1e9
