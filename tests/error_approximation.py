"""Bad arguments of going from one family of splines to another."""

from collections.abc import Iterator

import torch
from error_arguments import (
    F64,
    I64,
    INF,
    NAN,
    POSE,
    SPLINE,
    Case,
    V,
    accept,
    numbers,
    refused,
    wholes,
)

from torchspline import R3, SE3, SO3, BSpline, HermiteSpline, KeyframeSpline, NonuniformBSpline, SplitBSpline
from torchspline.fit import approximate, compare

#: What is made and handed out.
RESULTS = {"Approximation", "Difference"}

accept(
    {
        "approximate": (approximate, {"trajectory": SPLINE, "family": NonuniformBSpline}),
        "compare": (compare, {"trajectory": SPLINE, "reference": SPLINE}),
    }
)
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE = {
    "device": {"points are compared on the CPU": "approximate compare"},
    "zero quaternion": {"control points were checked when trajectories were made": "approximate compare"},
    "nan": {"no numbers but those of trajectories": "compare"},
    "count": {"any number of control points": "compare"},
}


def nanoseconds(seconds: torch.Tensor) -> torch.Tensor:
    return (seconds * 1e9).round().to(I64)


def cases() -> Iterator[Case]:
    function = "approximate"
    for bad in (POSE, None, 5):
        yield refused(
            function, "trajectory", "type", bad, f"got {type(bad).__name__}", "expected a Trajectory"
        )
    for bad in ("BSpline", None, torch.nn.Linear, SPLINE):
        named = getattr(bad, "__name__", repr(bad))
        yield refused(function, "family", "option", bad, f"got {named}", "one of BSpline, SplitBSpline")
    yield from (c for c in numbers(function, "tolerance", 0.0, -1.0) if c.changes["tolerance"] is not None)
    yield refused(function, "tolerance", "nan", (0.1, NAN), "got nan", "above zero")
    for bad in ((), (0.1,), (0.1, 0.1, 0.1)):
        yield refused(function, "tolerance", "option", bad, f"got {bad}", "one number or two")
    tight = {"family": BSpline, "order": 3, "tolerance": 1e-9}
    yield refused(
        function, "tolerance", "option", 1e-9, "max_points=30, got 1e-09", "allow more points",
        **{**tight, "max_points": 30},
    )  # fmt: skip
    yield refused(
        function, "max_points", "count", 5, "max_points=5 control points, knots or keys, got ", "expected no more",
        named="knots", knots=100,
    )  # fmt: skip
    yield from wholes(function, "max_points", 2)
    for bad in (0, 1.5, "4", True):
        yield refused(function, "knots", "option", bad, f"got {bad!r}", "a whole number of at least 1")
    good = torch.linspace(0.0, 0.5, 6, dtype=F64)
    yield refused(function, "knots", "option", good, "got a tensor", "how many pieces", family=BSpline)
    for bad in (nanoseconds(good), good.half()):
        yield refused(function, "knots", "dtype", bad, f"got {bad.dtype}", "torch.float64")
    for bad in (good[None], good[0], good[:1]):
        yield refused(function, "knots", "shape", bad, f"got {tuple(bad.shape)}", "shape (S + 1,)")
    for bad in (NAN, INF):
        worse = good.clone()
        worse[2] = bad
        yield refused(function, "knots", "nan", worse, f"got {bad} at index (2,)", "finite")
    for bad in (good.flip(0), 0 * good, good + 0.1):
        yield refused(function, "knots", "time", bad, "got ", "increase from 0.0 to 0.5")
    for bad in ("SE3", 5):
        yield refused(function, "group", "type", bad, f"got {type(bad).__name__}", "torchspline.Group")
    yield refused(function, "group", "option", SO3, "got SO3", "SE3, R3xSO3, DualQuaternion")
    yield refused(
        function, "group", "option", SE3, "got SE3", "R3xSO3 with SplitBSpline", family=SplitBSpline
    )
    yield refused(function, "order", "option", 1, "got 1", "at least 2")
    yield refused(function, "coordinates", "option", "product", "got coordinates", "('order',)")
    yield refused(function, "coordinates", "option", "both", "got 'both'", "'product'", family=HermiteSpline)
    keys = {"family": KeyframeSpline}
    yield refused(function, "method", "option", None, "got None", "such as 'squad'", **keys)
    yield refused(function, "method", "option", "spline", "got 'spline'", "one of LERP", **keys)
    yield refused(function, "method", "option", "SLERP", "got SO3", "SE3, R3xSO3, DualQuaternion", **keys)
    yield refused(function, "method", "option", "bezier", "got 'bezier'", "pieces between", **keys)
    ends = {**keys, "method": "squad"}
    yield refused(function, "ends", "option", "natural", "got ends", "it has none", **ends)
    yield refused(function, "way", "option", "Short", "got 'Short'", "'short', 'signs'", **ends)

    function = "compare"
    for name in ("trajectory", "reference"):
        for bad in (POSE, None):
            yield refused(function, name, "type", bad, f"got {type(bad).__name__}", "expected a Trajectory")
    yield refused(function, "reference", "option", BSpline(V, group=R3, dt=0.1), "got R3", "to go with")
    late = SplitBSpline(POSE, dt=0.1, t0=5.0)
    yield refused(function, "reference", "time", late, "got (5.0, 5.5)", "overlaps")
    whole = SplitBSpline(POSE, dt_ns=10)
    yield refused(function, "reference", "dtype", whole, "got nanoseconds", "expected times in seconds")
    three = SplitBSpline(POSE[:1].expand(3, 8, 7), dt=0.1)
    yield refused(function, "reference", "batch", three, "reference (3,)", "trajectory (2,)")
    yield from wholes(function, "samples", 1)
