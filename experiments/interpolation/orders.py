"""How fast splines of all families approach a smooth motion, and what they need for a given accuracy."""

import math
import time
from typing import Any

import torch
from hermite import Motion
from torch import Tensor

from interpolation.measure import DOUBLE, group_of
from torchspline import (
    R3,
    SE3,
    SO3,
    BSpline,
    Group,
    HermiteSpline,
    KeyframeSpline,
    NonuniformBSpline,
    SplitBSpline,
    State,
    Trajectory,
    product,
)
from torchspline.fit import approximate
from torchspline.splines.interpolation import SURVEY

DURATION = 3.0
#: Family, group and options of what is compared on a motion of a rigid body.
FAMILIES: dict[str, tuple[type[Trajectory], Group, dict[str, Any]]] = {
    "BSpline, order 4, SE3": (BSpline, SE3, {"order": 4}),
    "BSpline, order 6, SE3": (BSpline, SE3, {"order": 6}),
    "SplitBSpline, order 4": (SplitBSpline, product(R3, SO3), {"order": 4}),
    "SplitBSpline, order 6": (SplitBSpline, product(R3, SO3), {"order": 6}),
    "NonuniformBSpline, order 4, SE3": (NonuniformBSpline, SE3, {"order": 4}),
    'HermiteSpline "product", SE3': (HermiteSpline, SE3, {"coordinates": "product"}),
    'HermiteSpline "logarithm", SE3': (HermiteSpline, SE3, {"coordinates": "logarithm"}),
    'KeyframeSpline "SPLIT"': (KeyframeSpline, product(R3, SO3), {"method": "SPLIT"}),
    'KeyframeSpline "SPLIT SQUAD"': (KeyframeSpline, product(R3, SO3), {"method": "SPLIT SQUAD"}),
    'KeyframeSpline "SPLIT CuBsp"': (KeyframeSpline, product(R3, SO3), {"method": "SPLIT CuBsp"}),
    'KeyframeSpline "SpFus"': (KeyframeSpline, SE3, {"method": "SpFus"}),
}


class SmoothMotion(Trajectory):
    """A motion that is no spline: factors that do not commute, rates by automatic differentiation."""

    def __init__(self, group: Group, seed: int):
        super().__init__()
        self.group, self.motion = group, Motion(group, seed)

    @property
    def domain(self) -> tuple[float, float]:
        return 0.0, DURATION

    def evaluate(self, t: Tensor, derivatives: int = 2) -> State:
        """Value, and velocity and acceleration if asked for."""
        if derivatives == 0:
            return State(self.motion.value(t))
        return State(*self.motion.states(t)[: derivatives + 1])


def order(name: str, seed: int) -> float | None:
    """Of a scheme of the survey over keys of a smooth motion: how often the error halves when keys are twice as near.

    Measured in the middle half of the time: what ends do reaches only a few keys inside. None for one piece over all
    keys, which does not approach the motion.
    """
    group = group_of(name)
    if SURVEY[name].scheme == "bezier":
        return None
    motion = SmoothMotion(group, seed)
    inner = torch.linspace(0.25 * DURATION, 0.75 * DURATION, 501, dtype=DOUBLE)
    errors = []
    for segments in (64, 128):
        times = torch.linspace(0.0, DURATION, segments + 1, dtype=DOUBLE)
        spline = KeyframeSpline(name, motion(times), times, learnable=False)
        step = group.log(group.between(motion(inner), spline(inner)))
        errors.append(float(step.abs().max()))
    return math.log2(errors[0] / errors[1])


def family_order(name: str, seed: int, pieces: tuple[int, int] = (24, 48)) -> float:
    """The same for a family through `approximate`, from the largest distances in position and rotation."""
    family, group, options = FAMILIES[name]
    errors = []
    for count in pieces:
        motion = SmoothMotion(SE3, seed)
        error = approximate(motion, family=family, group=group, knots=count, **options).error
        assert error.position_max is not None
        assert error.rotation_max is not None
        errors.append(max(error.position_max, error.rotation_max))
    return math.log(errors[0] / errors[1]) / math.log(pieces[1] / pieces[0])


def needs(name: str, tolerance: float, batch: int, repetitions: int, seed: int) -> dict[str, float]:
    """Numbers it takes to follow the motion within `tolerance` (m and rad), knot times included where they are free,
    and nanoseconds for value, velocity and acceleration; the fastest of all repetitions."""
    family, group, options = FAMILIES[name]
    found = approximate(SmoothMotion(SE3, seed), family=family, group=group, tolerance=tolerance, **options)
    spline = found.trajectory.requires_grad_(False)
    numbers = sum(x.numel() for x in (*spline.parameters(), *spline.buffers()))
    generator = torch.Generator().manual_seed(seed)
    t = DURATION * torch.rand(batch, generator=generator, dtype=DOUBLE).sort().values
    spline.evaluate(t, 2)
    best = float("inf")
    for _ in range(repetitions):
        start = time.perf_counter()
        spline.evaluate(t, 2)
        best = min(best, time.perf_counter() - start)
    return {"numbers": numbers, "ns": best / batch * 1e9}
