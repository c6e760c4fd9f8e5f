"""Bad arguments of splines with knots or keys of their own, and of what prepares their points."""

from collections.abc import Callable, Iterator
from typing import Any

from error_arguments import (
    ACCEPTED,
    HERMITE,
    I64,
    INF,
    KEYED,
    KNOTS,
    KNOTTED,
    NS,
    POSE,
    STAMPS,
    TANGENT,
    Case,
    T,
    accept,
    changed,
    control_points,
    groups,
    numbers,
    refused,
    tensor,
    times,
    wholes,
)

import torchspline
from torchspline import (
    SE3,
    HermiteSpline,
    KeyframeSpline,
    NonuniformBSpline,
)

FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "geodesic_product": (
        torchspline.functional.geodesic_product,
        {"start": POSE, "steps": TANGENT[..., None, :], "weights": TANGENT[..., :2, None], "group": SE3},
    ),
    "hermite": (torchspline.functional.hermite, {**KNOTS, "t": T, "coordinates": "product", "frame": "body"}),
    "HermiteSpline": (HermiteSpline, {**KNOTS, "coordinates": "logarithm", "frame": "world"}),
    "HermiteSpline.evaluate": (HERMITE.evaluate, {"t": T, "derivatives": 2, "frame": "world"}),
    "HermiteSpline.differentials": (HERMITE.differentials, {"t": T, "side": "left"}),
    "nonuniform_bspline": (torchspline.functional.nonuniform_bspline, {**KNOTTED, "t": T}),
    "NonuniformBSpline": (NonuniformBSpline, KNOTTED),
    "NonuniformBSpline.evaluate": (NonuniformBSpline(**KNOTTED).evaluate, {"t": T, "derivatives": 2}),
    "NonuniformBSpline.insert_knot": (NonuniformBSpline(**KNOTTED).insert_knot, {"time": 0.25}),
    "interpolate": (
        torchspline.functional.interpolate,
        {"method": "geodesic", **KEYED, "t": T, "group": SE3, "derivatives": 2},
    ),
    "KeyframeSpline": (KeyframeSpline, {"method": "geodesic", **KEYED, "group": SE3}),
    "KeyframeSpline.evaluate": (KeyframeSpline("SE3Up", **KEYED).evaluate, {"t": T, "derivatives": 2}),
    "consistent_signs": (torchspline.consistent_signs, {"points": POSE, "group": SE3}),
    "phantom_points": (torchspline.phantom_points, {"keyframes": POSE, "group": SE3}),
}  # fmt: skip
accept(FUNCTIONS)

_AT_TIMES = (
    "HermiteSpline.evaluate HermiteSpline.differentials NonuniformBSpline.evaluate KeyframeSpline.evaluate"
)
_INSERT = "NonuniformBSpline.insert_knot"
_POINTS = "consistent_signs phantom_points"
#: What is made and handed out.
RESULTS = {"Differentials"}
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shape": {"no tensor": _INSERT},
    "dtype": {"no tensor": _INSERT},
    "device": {"no two tensors": f"{_INSERT} {_POINTS}"},
    "zero quaternion": {"points were checked when the trajectory was made": f"{_AT_TIMES} {_INSERT}"},
    "count": {"any number of times": f"{_AT_TIMES} {_INSERT}"},
    "time": {"no times": f"geodesic_product HermiteSpline NonuniformBSpline KeyframeSpline {_POINTS}"},
}


def cases() -> Iterator[Case]:
    yield from geodesics()
    yield from hermite()
    yield from nonuniform()
    yield from keyframes()
    yield from whole_nanoseconds()
    for function in ("consistent_signs", "phantom_points"):
        yield from groups(function)
    yield from control_points("consistent_signs", "points", POSE, 1)
    yield from control_points("phantom_points", "keyframes", POSE, 2)
    yield refused("phantom_points", "keyframes", "count", POSE[:, :2], "got 2", "at least 3 points", order=6)
    yield from wholes("phantom_points", "order", 2, [4])


def knot_times(function: str, argument: str, what: str) -> Iterator[Case]:
    """What the times of knots or keys are tried with; eight are expected."""
    good = ACCEPTED[function][1][argument]
    for case in tensor(function, argument, " (8,), one time for each", mixed=None, like=good):
        if (
            case.category != "shape" and "int64" not in case.came
        ):  # those are nanoseconds, see whole_nanoseconds
            yield case
    for bad in (good[:-1], good[None], good[0]):
        yield refused(function, argument, "shape", bad, f"got {tuple(bad.shape)}", "expected shape (8,)")
    yield refused(function, argument, "option", good.flip(0), "and then", "increasing times")
    yield refused(function, argument, "option", 0 * good, "got 0.0 and then 0.0", "drop duplicates")
    yield refused(function, argument, "device", good.to("meta"), "meta", "cpu")


def geodesics() -> Iterator[Case]:
    function = "geodesic_product"
    good = ACCEPTED[function][1]
    yield from tensor(function, "start", " (..., 7)", slice(3, 7), "steps")
    for name, size in (("steps", " (..., n, 6)"), ("weights", " (..., R + 1, 1)")):
        yield from tensor(function, name, size, None, "start")
        yield refused(function, name, "batch", good[name][:, :3], f"{name} (2, 3)", "start (2, 8)")
    none, five = good["steps"][..., :0, :], TANGENT[..., :5, None]
    yield refused(function, "steps", "count", none, "got (2, 8, 0, 6)", "n tangents")
    yield refused(function, "weights", "count", five, "got (2, 8, 5, 1)", "from 0 to 3 derivatives")
    yield from groups(function)


def hermite() -> Iterator[Case]:
    for function in ("hermite", "HermiteSpline"):
        yield from control_points(function, "values", POSE, 2)
        for name in ("velocities", "accelerations"):
            yield from tensor(function, name, " (2, 8, 6), tangents of", None, "values")
            yield refused(
                function, name, "shape", TANGENT[:, :7], "got (2, 7, 6)", "expected shape (2, 8, 6)"
            )
        yield from knot_times(function, "times", "knots")
        yield from groups(function)
        for name, options in (("coordinates", "'product', 'logarithm'"), ("frame", "'body', 'world'")):
            for bad in ("Body", "", None, True):
                yield refused(function, name, "option", bad, f"got {bad!r}", options)
        for bad in ("Clamp", "", None, True):
            yield refused(
                function, "extrapolate", "option", bad, f"got {bad!r}", "'error', 'clamp', 'linear'"
            )
    for function in ("hermite", "HermiteSpline.evaluate"):
        for bad in (4, -1, True, 1.0, None):
            yield refused(function, "derivatives", "option", bad, f"got {bad!r}", "from 0 to 3")
    for function in ("hermite", "HermiteSpline.evaluate", "HermiteSpline.differentials"):
        yield from times(function, "values", ns=False)
    for bad in ("Body", None):
        yield refused("HermiteSpline.evaluate", "frame", "option", bad, f"got {bad!r}", "'body', 'world'")
        yield refused("HermiteSpline.differentials", "side", "option", bad, f"got {bad!r}", "'left', 'right'")


def nonuniform() -> Iterator[Case]:
    for function in ("nonuniform_bspline", "NonuniformBSpline"):
        yield from control_points(function, "control_points", POSE, 4)
        yield from wholes(function, "order", 2, 3.5, INF)
        yield from groups(function)
        knots = ACCEPTED[function][1]["knots"]
        for case in tensor(function, "knots", "", mixed="control_points", like=knots):
            # float32 knots are numbers like any other, int64 ones nanoseconds, see whole_nanoseconds
            if case.category not in ("shape", "mixed dtype") and "int64" not in case.came:
                yield case
        for bad in (knots[:-1], knots[None], knots[0]):
            yield refused(function, "knots", "shape", bad, f"got {tuple(bad.shape)}", "expected shape (12,)")
        yield refused(function, "knots", "option", knots.flip(0), "and then", "do not decrease")
        yield refused(function, "knots", "option", 0 * knots, "got 0.0 to 0.0", "a domain of some duration")
        often = changed(knots, slice(3, 8), 0.3)
        yield refused(function, "knots", "option", often, "got 0.3", "at most 4 times")
        for bad in ("Clamp", "", None, True):
            yield refused(
                function, "extrapolate", "option", bad, f"got {bad!r}", "'error', 'clamp', 'linear'"
            )
    for function in ("nonuniform_bspline", "NonuniformBSpline.evaluate"):
        for bad in (4, -1, True, 1.0, None):
            yield refused(function, "derivatives", "option", bad, f"got {bad!r}", "from 0 to 3")
        yield from times(function, "control_points", ns=False)
    function = "NonuniformBSpline.insert_knot"
    yield from numbers(function, "time")
    yield refused(function, "time", "time", 0.6, "got 0.6", "inside the domain [0.0, 0.5] s")
    yield refused(function, "time", "option", 0.0, "got 0.0", "less than 3 times")


def keyframes() -> Iterator[Case]:
    for function in ("interpolate", "KeyframeSpline"):
        yield from control_points(function, "keyframes", POSE, 2)
        yield from knot_times(function, "times", "keyframes")
        for bad in ("spline", "", None, 5):
            yield refused(function, "method", "option", bad, f"got {bad!r}", "one of LERP, Bezier")
        for bad in ("SE3", SE3.arithmetic):
            yield refused(
                function, "group", "type", bad, f"got {type(bad).__name__}", "expected a torchspline.Group"
            )
        yield refused(function, "group", "option", None, "got None", "such as torchspline.SE3")
        yield refused(function, "group", "option", SE3, "got SE3", "none or R3xSO3", method="SPLIT")
        for bad in ("Short", "", None, True):
            yield refused(function, "way", "option", bad, f"got {bad!r}", "'short', 'signs'")
        for bad in ("Clamp", "", None, True):
            yield refused(
                function, "extrapolate", "option", bad, f"got {bad!r}", "'error', 'clamp', 'linear'"
            )
        yield refused(function, "ends", "option", "natural", "got ends", "it has none")
        for bad in ("Natural", None):
            wrong = {"method": "composite_bezier", "ends": bad}
            yield refused(function, "ends", "option", bad, f"got {bad!r}", "'natural', 'clamped'", **wrong)
        two = {"keyframes": POSE[:, :2], "times": STAMPS[:2]}
        yield refused(
            function, "keyframes", "count", two["keyframes"], "got 2", "at least 3 ",
            method="squad", times=two["times"],
        )  # fmt: skip
    for function in ("interpolate", "KeyframeSpline.evaluate"):
        for bad in (4, -1, True, 1.0, None):
            yield refused(function, "derivatives", "option", bad, f"got {bad!r}", "from 0 to 3")
        yield from times(function, "keyframes", ns=False)


def whole_nanoseconds() -> Iterator[Case]:
    for function, knots in (("hermite", "times"), ("nonuniform_bspline", "knots"), ("interpolate", "times")):
        whole = (ACCEPTED[function][1][knots] * 1e9).round().to(I64)
        for bad in (T, T.float(), NS.int()):
            yield refused(
                function, "t", "dtype", bad, f"got {bad.dtype}", "int64 nanoseconds", **{knots: whole}
            )
        for bad, came in ((NS - 1, "is -1;"), (NS + 499_999_999, "is 500000001;")):
            outside = "outside the domain [0, 500000000] ns"
            yield refused(function, "t", "time", bad, came, outside, **{knots: whole})
        for bad in (whole.flip(0), 0 * whole):
            yield refused(function, knots, "option", bad, "got ", "expected ", t=NS)
