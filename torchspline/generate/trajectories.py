"""Batches of random trajectories."""

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from torchspline import checks
from torchspline.generate.distributions import Constant, Distribution, Parameter, distribution_of
from torchspline.generate.motions import MOTIONS
from torchspline.generate.motions.motion import ORDER
from torchspline.groups import SO3
from torchspline.splines import SplitBSpline

#: s, that a motion takes to get going after a rest.
STARTING = 1.0
Mounting = Literal["upright", "random"]
MOUNTINGS = ("upright", "random")
#: How long a body rests before it moves.
REST = Parameter("s", Constant(0.0), meaning="at the start")


def random_motion(
    kind: str,
    count: int,
    duration: float,
    *,
    generator: torch.Generator | None = None,
    knot_spacing: float = 0.02,
    rest: Any = 0.0,
    mounting: Mounting = "upright",
    **parameters: Any,
) -> SplitBSpline:
    """Random motions of one kind, as a batch of splines of order 6 on [0, duration].

    Args:
        kind: a name in `MOTIONS`: "smooth", "band_limited", "figure_eight", "walking", "drone".
        count: how many.
        duration: s.
        generator: of all random numbers.
        knot_spacing: s; frequencies up to 0.1 / knot_spacing are carried, and faster motions refused.
        rest: s at the start without motion; a number or a distribution.
        mounting: of the body (the sensor): "upright", as the kind of motion has it, or "random", turned by a
            rotation that is uniform among all and constant in time.
        parameters: of the kind of motion, in the units of `MOTIONS[kind].parameters`: numbers or distributions in the
            form of a configuration, such as `{"log_uniform": [0.3, 3.0]}`.
    Returns:
        SplitBSpline: control points (count, M, 7) float64, not learnable; its world's z axis points up.
    Raises:
        TypeError, ValueError: a wrong type or value; the message names the parameter.
    """
    checks.choice("kind", kind, tuple(MOTIONS))
    checks.whole("count", count, 1)
    checks.positive("duration", duration)
    checks.positive("knot_spacing", knot_spacing)
    checks.choice("mounting", mounting, MOUNTINGS)
    if generator is not None:
        checks.instance("generator", generator, torch.Generator, "a torch.Generator")
    chosen = motion_distributions("", kind, parameters, knot_spacing)
    resting = distribution_of("rest", rest, REST)
    generator = generator or torch.default_generator
    drawn = draw_motion(kind, chosen, count, generator)
    points = control_points(
        kind, drawn, REST.draw(resting, count, generator), duration, knot_spacing, mounting, generator
    )
    return SplitBSpline(points, order=ORDER, dt=knot_spacing, learnable=False)


def motion_distributions(
    path: str, kind: str, given: Mapping[str, Any], knot_spacing: float
) -> dict[str, Distribution]:
    """A distribution for every parameter of a kind of motion: what was given, or the default."""
    known = MOTIONS[kind].parameters
    prefix = f"{path}." if path else ""
    for name in given:
        if name not in known:
            raise ValueError(f"{prefix}{name}: expected a parameter out of {', '.join(known)}, got {name!r}")
    chosen = {
        name: distribution_of(f"{prefix}{name}", given[name], p) if name in given else p.default
        for name, p in known.items()
    }
    MOTIONS[kind].check(path or kind, chosen, knot_spacing)
    return chosen


def draw_motion(
    kind: str, chosen: Mapping[str, Distribution], count: int, generator: torch.Generator
) -> dict[str, Tensor]:
    """A value of each parameter for each of `count` items."""
    known = MOTIONS[kind].parameters
    return {name: known[name].draw(d, count, generator) for name, d in chosen.items()}


def control_points(
    kind: str,
    drawn: Mapping[str, Tensor],
    rest: Tensor,
    duration: float,
    spacing: float,
    mounting: str,
    generator: torch.Generator,
) -> Tensor:
    """(B, M, 7), of splines of `ORDER` that start at 0."""
    segments = math.ceil(duration / spacing - 1e-9)
    # A control point lies under the middle of the curve that it shapes.
    knots = (torch.arange(segments + ORDER - 1, dtype=torch.float64) - (ORDER / 2 - 1)) * spacing
    tau = _started(knots - rest[:, None], rest[:, None])
    poses = MOTIONS[kind]().poses(tau, spacing, drawn, generator)
    if mounting == "random":
        mount = SO3.random(len(rest), generator=generator)[:, None]
        rotation = SO3.compose(poses[..., 3:], mount, validate=False)
        poses = torch.cat([poses[..., :3], rotation], dim=-1)
    return poses


def _started(since: Tensor, rest: Tensor) -> Tensor:
    """Time as the motion counts it: 0 at rest, then faster and faster, with continuous third derivative.

    Who does not rest is under way from the start.
    """
    s = since.clamp(0.0, STARTING) / STARTING
    ramp = STARTING * (s**6 - 3 * s**5 + 2.5 * s**4)
    late = ramp + (since - STARTING).clamp_min(0.0)
    return torch.where(rest > 0, late, since - since[:, :1])
