"""Bad arguments of uniform B-splines, and of trajectories that carry a sensor."""

from collections.abc import Callable, Iterator
from typing import Any

from error_arguments import (
    INF,
    NS,
    POSE,
    SPLINE,
    Case,
    T,
    accept,
    control_points,
    groups,
    refused,
    spacings,
    tensor,
    times,
    wholes,
)

import torchspline
from torchspline import (
    SE3,
    BSpline,
    Rn,
    SplitBSpline,
)
from torchspline.splines.trajectory import Mounted

FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "bspline": (torchspline.functional.bspline, {"control_points": POSE, "t": T, "group": SE3, "dt": 0.1}),
    "BSpline": (BSpline, {"control_points": POSE, "group": SE3, "dt": 0.1}),
    "SplitBSpline": (SplitBSpline, {"control_points": POSE, "dt": 0.1}),
    "BSpline.evaluate": (SPLINE.evaluate, {"t": T, "derivatives": 2}),
    "BSpline.jacobians": (SPLINE.jacobians, {"t": T, "derivatives": 2, "side": "left"}),
    "Trajectory.forward": (SPLINE.forward, {"t": T}),
    "Trajectory.kinematics": (SPLINE.kinematics, {"t": T}),
    "Trajectory.mounted": (SPLINE.mounted, {"T_body_sensor": POSE[0, 0]}),
    "Mounted": (Mounted, {"trajectory": SPLINE, "T_body_sensor": POSE[0, 0]}),
    "Mounted.evaluate": (
        lambda T_body_sensor, **k: Mounted(SPLINE, T_body_sensor).evaluate(**k),
        {"T_body_sensor": POSE[0, 0], "t": T, "derivatives": 2},
    ),
}  # fmt: skip
accept(FUNCTIONS)

_AT_TIMES = "BSpline.evaluate BSpline.jacobians Trajectory.forward Trajectory.kinematics Mounted.evaluate"
_MOUNT = "Trajectory.mounted Mounted"
#: Where test_errors.py looks for public functions; what it finds that nobody is meant to call.
ROOTS = (Mounted,)
RESULTS = {"State", "Kinematics"}
UNTRIED = {
    "BSpline.extra_repr": "no arguments; PyTorch calls it",
    "BSpline.get_extra_state": "no arguments; PyTorch calls it",
    "BSpline.set_extra_state": "PyTorch calls it with what the method above made",
}
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "device": {"the mount waits for the first call, and is refused there": _MOUNT},
    "zero quaternion": {"control points and mount were checked when the trajectory was made": _AT_TIMES},
    "count": {"one of it": _MOUNT, "any number of times": _AT_TIMES},
    "time": {"no times": f"BSpline SplitBSpline {_MOUNT}"},
}


def cases() -> Iterator[Case]:
    ns = {"dt": None, "dt_ns": 10**8}
    for function in ("bspline", "BSpline", "SplitBSpline"):
        yield from control_points(function, "control_points", POSE, 4)
        yield from wholes(function, "order", 2, 3.5, INF)
        yield from spacings(function, {**ns, "t": NS} if function == "bspline" else ns)
        for bad in ("Clamp", "", None, True):
            yield refused(
                function, "extrapolate", "option", bad, f"got {bad!r}", "'error', 'clamp', 'linear'"
            )
        five = POSE[..., :4, :]
        yield refused(function, "control_points", "count", five, "got 4", "order 5 needs at least 5", order=5)
    for function in ("bspline", "BSpline"):
        yield from groups(function)
    yield refused("bspline", "control_points", "device", POSE.to("meta"), "meta", "cpu")
    for bad in ("Left", None, 1):
        yield refused("BSpline.jacobians", "side", "option", bad, f"got {bad!r}", "'left', 'right'")
    for function in ("bspline", "BSpline.evaluate", "BSpline.jacobians", "Mounted.evaluate"):
        for bad in (4, -1, True, 1.0, None):
            yield refused(function, "derivatives", "option", bad, f"got {bad!r}", "from 0 to 3")
    for function in ("bspline", *_AT_TIMES.split()):
        yield from times(function)
    for bad in (T, NS.int()):
        yield refused("bspline", "t", "dtype", bad, f"got {bad.dtype}", "int64", **ns)
    outside = "outside the domain [0, 500000000] ns"
    yield refused("bspline", "t", "time", NS + 5 * 10**8 - 1, "the first is 500000001", outside, **ns)
    yield from mounts()


def mounts() -> Iterator[Case]:
    for function in ("Trajectory.mounted", "Mounted"):
        yield from tensor(function, "T_body_sensor", " (..., 7)", slice(3, 7))
    function, mount = "Mounted.evaluate", POSE[0, 0]
    yield refused(function, "T_body_sensor", "device", mount.to("meta"), "meta", "cpu")
    yield refused(function, "T_body_sensor", "mixed dtype", mount.float(), "torch.float32", "torch.float64")
    yield refused(function, "T_body_sensor", "batch", mount.expand(3, 7), "(3,", "(2,")
    yield refused("Mounted", "trajectory", "type", POSE, "got Tensor", "expected a Trajectory")
    plane = BSpline(Rn(2).random(5), group=Rn(2), dt=0.1)
    yield refused("Mounted", "trajectory", "option", plane, "got R2", "one in SO3, R3xSO3, SE3")
