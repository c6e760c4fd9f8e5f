"""Bad arguments of the alignment of an IMU with a trajectory."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from error_arguments import F32, F64, I64, INF, NAN, POSE, Case, Q, V, accept, changed, numbers, refused

import torchspline
from torchspline import (
    SO3,
    Alignment,
    BSpline,
    Rn,
    SplitBSpline,
)
from torchspline.fit.losses import Huber

#: A motion, what a gyroscope reads on it, and how the two are aligned.
TURNING = BSpline(
    SO3.exp(torch.randn(12, 3, generator=torch.Generator().manual_seed(0), dtype=F64)),
    group=SO3, dt=1.0, learnable=False,
)  # fmt: skip
READ_AT = torch.linspace(0.0, 9.0, 90, dtype=F64)
with torch.no_grad():
    GYRO = TURNING.kinematics(READ_AT).angular_velocity
ALIGNED = Alignment(0.0, 0.0, 4.5, Q[0, 0], None, V[0, 0], None, None, 0.0, None, {}, (90, 0))


def align_quickly(**arguments: Any) -> Alignment:
    """With compiled loops, so that calls that are accepted take no time to speak of."""
    with torchspline.use_kernels("auto"):
        return torchspline.align_imu(**arguments)


FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "align_imu": (align_quickly, {"trajectory": TURNING, "t": READ_AT, "gyro": GYRO, "accel": None}),
    "Alignment.pose_time": (ALIGNED.pose_time, {"t": READ_AT}),
}  # fmt: skip
accept(FUNCTIONS)

#: What is made and handed out.
RESULTS = {"Alignment"}
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shape": {"any shape": "Alignment.pose_time"},
    "device": {"no two tensors": "Alignment.pose_time"},
    "nan": {"NaN stays NaN": "Alignment.pose_time"},
    "zero quaternion": {
        "no quaternion goes in": "Alignment.pose_time",
        "control points were checked when the trajectory was made": "align_imu",
    },
    "count": {"any number of times": "Alignment.pose_time"},
    "time": {"any time": "Alignment.pose_time"},
}


def cases() -> Iterator[Case]:
    function = "align_imu"
    points = torch.cat([V[0, :1].expand(12, 3), TURNING.control_points], -1)
    align = {"trajectory": SplitBSpline(points, dt=1.0)}
    for bad in (POSE, TURNING.control_points, None):
        yield refused(function, "trajectory", "type", bad, f"got {type(bad).__name__}", "expected a BSpline")
    plane = BSpline(Rn(2).random(5), group=Rn(2), dt=0.1)
    yield refused(
        function, "trajectory", "option", plane, "got R2", "expected a trajectory in SO3, R3xSO3, SE3"
    )
    yield refused(function, "trajectory", "option", TURNING, "got SO3", "in R3xSO3, SE3", accel=GYRO)
    batch = SplitBSpline(POSE, dt=0.1)
    yield refused(
        function, "trajectory", "batch", batch, "got control points of shape (2, 8, 7)", "without a batch"
    )
    elsewhere = SplitBSpline(POSE[0], dt=0.1).to("meta")
    yield refused(function, "trajectory", "device", elsewhere, "got meta", "on the CPU")
    still = SplitBSpline(POSE[0, :1].expand(20, 7), dt=1.0)
    yield refused(function, "trajectory", "option", still, "varies by 0 rad/s", "can be found")
    for bad in (READ_AT.tolist(), READ_AT.numpy(), None):
        yield refused(function, "t", "type", bad, f"got {type(bad).__name__}", "a torch.Tensor")
    for dtype in (F32, torch.float16, torch.int32):
        yield refused(function, "t", "dtype", READ_AT.to(dtype), f"got {dtype}", "float64 seconds or int64")
    yield refused(function, "t", "shape", READ_AT[None], "got (1, 90)", "expected shape (N,)")
    yield refused(function, "t", "nan", changed(READ_AT, 3, INF), "got inf at index (3,)", "finite numbers")
    yield refused(function, "t", "nan", READ_AT * NAN, "got 0", "at least 30")
    yield refused(function, "t", "device", READ_AT.to("meta"), "meta", "cpu")
    yield refused(function, "t", "time", READ_AT + 50.0, "begin 50 s after", "stamps that overlap")
    yield refused(function, "t", "time", READ_AT - 50.0, "max_offset = 5 s", "stamps that overlap")
    for name in ("gyro", "accel"):
        also = {} if name == "gyro" else align
        for bad in (GYRO.tolist(), GYRO.numpy(), *((None,) if name == "gyro" else ())):
            yield refused(function, name, "type", bad, f"got {type(bad).__name__}", "a torch.Tensor", **also)
        for dtype in (I64, torch.float16, torch.bool):
            yield refused(function, name, "dtype", GYRO.to(dtype), f"got {dtype}", "torch.float64", **also)
        for bad in (GYRO[:-1], GYRO[:, :2], GYRO[0]):
            yield refused(
                function, name, "shape", bad, f"got {tuple(bad.shape)}", "expected shape (90, 3)", **also
            )
        infinite = changed(GYRO, (2, 1), INF)
        yield refused(function, name, "nan", infinite, "got inf at index (2, 1)", "finite numbers", **also)
        yield refused(function, name, "nan", GYRO * NAN, "got 0", "at least 30 readings", **also)
        yield refused(function, name, "device", GYRO.to("meta"), "meta", "cpu", **also)
    few = {"t": READ_AT[:29]}
    yield refused(function, "gyro", "count", GYRO[:29], "got 29", "at least 30 readings", **few)
    yield refused(function, "gyro", "option", GYRO.flip(0, 1), "of their variance", "the trajectory's motion")
    for name in ("max_offset", "gravity_magnitude"):
        for case in numbers(function, name, 0.0, -1.0):
            if case.changes[name] is not None:  # None: any, and estimated
                yield case
    for bad in (None, 1, "yes"):
        for name in ("estimate_skew", "estimate_delay"):
            yield refused(function, name, "type", bad, f"got {type(bad).__name__}", "True or False")
    for bad in ("Huber", 1.0, Huber):
        yield refused(function, "loss", "type", bad, f"got {type(bad).__name__}", "a robust loss")
    function = "Alignment.pose_time"
    for bad in (None, "accelerometer", 1):
        yield refused(function, "sensor", "option", bad, f"got {bad!r}", "'gyro', 'accel'")
    for bad in (READ_AT.tolist(), READ_AT.numpy(), None, 1.0):
        yield refused(function, "t", "type", bad, f"got {type(bad).__name__}", "a torch.Tensor")
    for dtype in (I64, F32):
        yield refused(function, "t", "dtype", READ_AT.to(dtype), f"got {dtype}", "expected torch.float64")
