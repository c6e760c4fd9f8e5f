"""Bad arguments of the sensor model and of its files."""

from collections.abc import Iterator
from typing import Any

import torch
from error_arguments import (
    F64,
    FOLDER,
    I64,
    INF,
    NAN,
    POSE,
    SPLINE,
    Case,
    Q,
    T,
    V,
    accept,
    changed,
    file,
    numbers,
    refused,
    tensor,
    times,
    wholes,
)

import torchspline.io as records
from torchspline import SO3, BSpline, Rn, imu

THREE = torch.ones(3, dtype=F64)
NOISE = imu.ImuNoise(0.1, 0.1)
IMU = imu.Imu(noise=NOISE, rate=100.0)
MAGNETOMETER = imu.Magnetometer((20.0, 0.0, -40.0), noise_density=1.0, rate=100.0)
BAROMETER = imu.Barometer(noise_density=1.0, rate=100.0)
FILTER = imu.LowPass(10.0)
STEPS = torch.arange(8, dtype=F64)
SPLINE_ON_META = BSpline(POSE, group=SPLINE.group, dt=0.1).to("meta")
READINGS = imu.ImuReading(V, V)
YAML = file(
    "gyroscope_noise_density: 0.1\ngyroscope_random_walk: 0.1\naccelerometer_noise_density: 0.1\n"
    "accelerometer_random_walk: 0.1\nupdate_rate: 100\n",
    "good.yaml",
)
PARAMETERS = records.ImuParameters(NOISE, 100.0)

accept(
    {
        "measure": (imu.measure, {"trajectory": SPLINE, "t": T}),
        "Imu": (imu.Imu, {}),
        "Imu.forward": (IMU.forward, {"trajectory": SPLINE, "t": T}),
        "Imu.correct": (IMU.correct, {"readings": READINGS}),
        "Imu.increments": (IMU.increments, {"readings": READINGS, "t": STEPS}),
        "Magnetometer": (imu.Magnetometer, {"field": (20.0, 0.0, -40.0)}),
        "Magnetometer.forward": (MAGNETOMETER.forward, {"trajectory": SPLINE, "t": T}),
        "Barometer": (imu.Barometer, {}),
        "Barometer.forward": (BAROMETER.forward, {"trajectory": SPLINE, "t": T}),
        "ImuNoise": (imu.ImuNoise, {}),
        "ImuNoise.inflated": (NOISE.inflated, {"factor": 10.0}),
        "LowPass": (imu.LowPass, {"bandwidth": 10.0}),
        "LowPass.forward": (FILTER.forward, {"x": V, "t": STEPS}),
        "ImuParameters": (records.ImuParameters, {"noise": NOISE, "rate": 100.0}),
        "read_imu_parameters": (records.read_imu_parameters, {"path": YAML}),
        "write_imu_parameters": (
            records.write_imu_parameters,
            {"path": f"{FOLDER.name}/imu.yaml", "parameters": PARAMETERS},
        ),
    }
)

_NUMBERS = "ImuNoise.inflated"
_USES = "Imu.forward Imu.increments Imu.correct Magnetometer.forward Barometer.forward LowPass.forward"
_FILES = "read_imu_parameters write_imu_parameters"
_PARTS = "Imu Magnetometer Barometer ImuNoise LowPass"
#: What is made and handed out.
RESULTS = {"ImuReading", "Readings", "AmbientReadings"}
UNTRIED = {"LowPass.extra_repr": "no arguments; PyTorch calls it"}
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE = {
    "shape": {"plain numbers or files": f"{_NUMBERS} {_FILES}"},
    "dtype": {"plain numbers or files": f"{_NUMBERS} {_FILES}"},
    "device": {
        "parts wait for the first call": f"{_PARTS} ImuParameters LowPass.forward",
        "plain numbers or files": f"{_NUMBERS} {_FILES}",
    },
    "nan": {"lost samples stay as they are": "Imu.correct"},
    "zero quaternion": {
        "no rotations that were not checked": f"{_NUMBERS} {_FILES} {_USES} ImuNoise LowPass Barometer"
    },
    "count": {
        "any number of samples of a sensor": f"measure {_PARTS} {_NUMBERS} {_FILES} {_USES} ImuParameters"
    },
    "time": {"no times in parts of a sensor": f"{_PARTS} {_NUMBERS} {_FILES} Imu.correct ImuParameters"},
}


def parameter(
    function: str, name: str, *shape: int, above: bool = False, least: bool = False, **also: Any
) -> Iterator[Case]:
    """A tensor (*batch, *shape), or numbers."""

    def case(category: str, bad: Any, came: str, expected: str) -> Case:
        return refused(function, name, category, bad, came, expected, **also)

    good = torch.ones(shape, dtype=F64)
    for bad in ("a", True, {}):
        yield case("type", bad, f"got {bad!r}", "expected a tensor or numbers")
    yield case("dtype", good.to(I64), "torch.int64", "torch.float32 or torch.float64")
    if shape:
        long = (*shape[:-1], shape[-1] + 1)
        yield case("shape", torch.ones(long, dtype=F64), f"got {long}", "expected shape")
        yield case("shape", [1.0] * (shape[-1] + 1), f"got ({shape[-1] + 1},)", "expected shape")
    first = (0,) * len(shape)
    for bad in (NAN, INF):
        yield case("nan", changed(good, first, bad), f"got {bad} at index {first}", "expected finite numbers")
    outside = (-1.0, 0.0) if above else (-1.0,) if least else ()
    for bad in outside:
        yield case(
            "option", changed(good, first, bad), f"got {bad:g}", "above zero" if above else "of at least zero"
        )


def cases() -> Iterator[Case]:
    yield from ideal()
    yield from sensor()
    yield from ambient()
    yield from readings()
    yield from noise()
    yield from filters()
    yield from files()


def ideal() -> Iterator[Case]:
    function = "measure"
    yield from times(function)
    mount = POSE[0, 0]
    for case in tensor(function, "T_body_imu", " (..., 7)", slice(3, 7), like=mount):
        if case.changes["T_body_imu"] is not None:  # None: the body frame is the IMU's
            yield case
    yield refused(function, "T_body_imu", "device", mount.to("meta"), "meta", "cpu")
    yield refused(function, "T_body_imu", "mixed dtype", mount.float(), "torch.float32", "torch.float64")
    yield refused(function, "T_body_imu", "batch", mount.expand(3, 7), "(3,", "(2,")
    yield refused(function, "trajectory", "type", POSE, "got Tensor", "expected a Trajectory")
    plane, turning = BSpline(Rn(2).random(5), group=Rn(2), dt=0.1), BSpline(Q, group=SO3, dt=0.1)
    for bad in (plane, turning):
        yield refused(function, "trajectory", "option", bad, f"got {bad.group}", "SE3 or R3xSO3")
    for name in ("gravity", "gyroscope_bias", "accelerometer_bias"):
        for bad in ("down", [[1.0, 2, 3], [1]], [None] * 3, *((None,) if name == "gravity" else ())):
            yield refused(function, name, "type", bad, f"got {bad!r}", "a tensor or three numbers")
        yield from (
            case
            for case in tensor(function, name, " (..., 3)", None, "trajectory", like=V[0, 0])
            if case.category != "type"
        )
        yield refused(function, name, "shape", (0.0, 9.8), "got (2,)", "expected shape (..., 3)")
        yield refused(function, name, "batch", V[0, :4], f"{name} (4, 3)", "readings (2, 3, 3)")


def sensor() -> Iterator[Case]:
    function = "Imu"
    for name in (
        "gyroscope_bias",
        "accelerometer_bias",
        "gyroscope_misalignment",
        "accelerometer_misalignment",
    ):
        yield from parameter(function, name, 3)
    for name in ("scale", "range", "resolution"):
        for triad in ("gyroscope", "accelerometer"):
            yield from parameter(function, f"{triad}_{name}", 3, above=True)
    for name in ("gravity", "earth_rate"):
        yield from parameter(function, name, 3)
    yield refused(function, "gravity", "type", None, "got None", "(0, 0, 0) means none")
    for name in ("g_sensitivity", "accelerometer_arms"):
        yield from parameter(function, name, 3, 3)
    for name, size in (("gyroscope_rotation", 4), ("T_body_imu", 7)):
        yield from parameter(function, name, size)
        yield refused(
            function,
            name,
            "zero quaternion",
            torch.zeros(size, dtype=F64),
            "got length 0",
            "expected quaternions",
        )
    for name in ("time_offset", "time_skew"):
        yield from parameter(function, name)
    for name in ("jitter", "drop_probability"):
        yield from parameter(function, name, least=True)
    for name in ("time_offset", "time_skew", "jitter", "drop_probability"):
        yield refused(function, name, "type", None, "got None", "0 means none")
    for name in ("time_skew", "drop_probability"):
        yield refused(function, name, "option", 1.0, "got 1", "below 1")
    for name in ("gyroscope_filter", "accelerometer_filter"):
        yield refused(function, name, "type", 5.0, "got float", "expected a torchspline.imu.LowPass")
    yield refused(function, "noise", "type", 0.1, "got float", "expected a torchspline.imu.ImuNoise")
    yield from (c for c in numbers(function, "rate", 0.0, -1.0) if c.changes["rate"] is not None)
    yield from wholes(function, "averaging", 0)
    for bad in (torch.float16, torch.int64, "float32"):
        yield refused(function, "dtype", "dtype", bad, f"got {bad}", "torch.float32 or torch.float64")
    for name in ("gyroscope_bias", "accelerometer_bias"):
        yield refused(function, name, "option", SPLINE, "got one in R3xSO3", "expected a trajectory in R3")
    yield refused(
        function, "gravity", "batch", THREE.expand(2, 3), "(2,)", "(4,)", earth_rate=THREE.expand(4, 3)
    )

    for function in ("Imu.forward", "Magnetometer.forward", "Barometer.forward"):
        yield from times(function)
        yield refused(function, "trajectory", "type", POSE, "got Tensor", "expected a Trajectory")
        yield refused(function, "trajectory", "device", SPLINE_ON_META, "meta", "cpu", t=T.to("meta"))
        for bad in (5, "a"):
            yield refused(function, "generator", "type", bad, f"got {type(bad).__name__}", "torch.Generator")
        three = [torch.Generator() for _ in range(3)]
        yield refused(function, "generator", "option", three, "got 3", "one for each row")
    function = "Imu.forward"
    turning = BSpline(POSE[..., 3:], group=SO3, dt=0.1)
    yield refused(
        function, "trajectory", "option", turning, "got SO3", "expected one with rotation and position"
    )


def ambient() -> Iterator[Case]:
    function = "Magnetometer"
    yield from parameter(function, "field", 3)
    yield refused(function, "field", "type", None, "got None", "expected a tensor or three numbers")
    yield from parameter(function, "bias", 3)
    yield from parameter(function, "soft_iron", 3, 3)
    yield from parameter(function, "rotation", 4)
    none = torch.zeros(4, dtype=F64)
    yield refused(function, "rotation", "zero quaternion", none, "got length 0", "expected quaternions")
    for name in ("noise_density", "random_walk"):
        yield from parameter(function, name, 3, least=True)
        yield from parameter("Barometer", name, least=True)
    for name in ("range", "resolution"):
        yield from parameter(function, name, 3, above=True)
        yield from parameter("Barometer", name, above=True)
    function = "Barometer"
    for name in ("bias", "ground_height"):
        yield from parameter(function, name)
    for name in ("up", "lever_arm"):
        yield from parameter(function, name, 3)
    for name in ("up", "ground_height"):
        yield refused(function, name, "type", None, "got None", "expected a tensor or numbers")
    yield refused(function, "up", "option", THREE, "got length 1.7", "length one")
    for function in ("Magnetometer", "Barometer"):
        for name in ("time_offset", "time_skew"):
            yield from parameter(function, name)
        for name in ("jitter", "drop_probability"):
            yield from parameter(function, name, least=True)
        yield refused(function, "low_pass", "type", 5.0, "got float", "expected a torchspline.imu.LowPass")
        yield from (c for c in numbers(function, "rate", 0.0, -1.0) if c.changes["rate"] is not None)
        for bad in (torch.float16, torch.int64, "float32"):
            yield refused(function, "dtype", "dtype", bad, f"got {bad}", "torch.float32 or torch.float64")


def readings() -> Iterator[Case]:
    for function in ("Imu.correct", "Imu.increments"):
        for bad in (None, V, (V, V)):
            came = f"got {type(bad).__name__}"
            yield refused(function, "readings", "type", bad, came, "expected gyroscope and accelerometer")
        for name in ("gyroscope", "accelerometer"):
            for category, bad, came, expected in (
                ("dtype", V.to(I64), "torch.int64", "torch.float32 or torch.float64"),
                ("shape", V[..., :2], "got (2, 8, 2)", "expected shape (..., 3)"),
            ):
                changes = READINGS._replace(**{name: bad})
                yield refused(function, "readings", category, changes, came, expected, name)
        apart = READINGS._replace(accelerometer=V.to("meta"))
        yield refused(function, "readings", "device", apart, "meta", "cpu", "accelerometer")
    function = "Imu.correct"
    for name in ("gyroscope_bias", "accelerometer_bias"):
        yield refused(function, name, "type", 0.1, "got float", "expected a torch.Tensor")
        yield refused(function, name, "dtype", THREE.to(I64), "torch.int64", "torch.float64")
        yield refused(function, name, "shape", THREE[:2], "got (2,)", "expected shape (..., 3)")
        yield refused(function, name, "batch", THREE.expand(5, 3), "(5, 3)", "(2, 8, 3)")
    function = "Imu.increments"
    broken = READINGS._replace(gyroscope=changed(V, (0, 0, 0), NAN))
    yield refused(function, "readings", "nan", broken, "got nan at index (0, 0, 0)", "finite", "gyroscope")
    yield refused(function, "t", "type", 0.1, "got float", "expected a torch.Tensor")
    yield refused(function, "t", "shape", STEPS[:3], "got (3,)", "a time for each sample")
    yield refused(function, "t", "time", STEPS.flip(0), "got 7.0 and then 6.0", "expected increasing times")


def noise() -> Iterator[Case]:
    function = "ImuNoise"
    for triad in ("gyroscope", "accelerometer"):
        for name in ("noise_density", "random_walk", "bias_sigma", "bias_instability"):
            yield from parameter(function, f"{triad}_{name}", 3, least=True)
            yield refused(function, f"{triad}_{name}", "type", None, "got None", "0 means none")
        yield from parameter(function, f"{triad}_bias_time", 3, above=True)
    yield from numbers("ImuNoise.inflated", "factor", 0.0, -1.0)


def filters() -> Iterator[Case]:
    function = "LowPass"
    for bad in (None, "a", True, 1j):
        yield refused(function, "bandwidth", "type", bad, f"got {type(bad).__name__}", "expected a number")
    for bad in (NAN, INF, 0.0, -1.0):
        for x in (bad, torch.tensor(bad, dtype=F64)):
            yield refused(
                function, "bandwidth", "nan", x, f"got {bad}", "expected a finite number above zero"
            )
    yield refused(function, "bandwidth", "dtype", torch.tensor(1), "torch.int64", "torch.float64")
    yield refused(function, "bandwidth", "shape", THREE, "got shape (3,)", "expected one number")
    for bad in (0, 3, 1.0, True, None):
        yield refused(function, "order", "option", bad, f"got {bad!r}", "expected 1 or 2")
    function = "LowPass.forward"
    yield from (c for c in tensor(function, "x", " (*batch, N, C)") if c.category in ("type", "dtype"))
    yield refused(function, "x", "shape", STEPS, "got (8,)", "expected shape (*batch, N, C)")
    yield refused(function, "t", "type", 0.1, "got float", "expected a torch.Tensor")
    yield refused(function, "t", "dtype", STEPS.to(torch.int32), "torch.int32", "or torch.int64")
    yield refused(function, "t", "shape", STEPS[:3], "got (3,)", "a time for each sample")
    yield refused(function, "t", "batch", STEPS.expand(3, 8), "(3,)", "(2,)")
    yield refused(function, "t", "nan", changed(STEPS, 1, NAN), "got nan at index (1,)", "expected finite")
    yield refused(function, "t", "time", STEPS.flip(0), "got 7.0 and then 6.0", "expected increasing times")


def files() -> Iterator[Case]:
    function = "ImuParameters"
    yield refused(function, "noise", "type", 0.1, "got float", "expected a torchspline.imu.ImuNoise")
    yield from numbers(function, "rate", 0.0, -1.0)
    good = POSE[0, 0]
    given = tensor(function, "T_body_imu", " (..., 7)", slice(3, 7), like=good)
    yield from (c for c in given if c.changes["T_body_imu"] is not None)
    yield refused(function, "T_body_imu", "shape", POSE[0], "got (8, 7)", "expected shape (7,)")
    yield refused(function, "topic", "type", 5, "got int", "expected text")
    yield refused(function, "calibration", "type", 5, "got int", "expected a mapping")
    for function in _FILES.split():
        yield refused(function, "path", "type", 5, "got int", "expected a path")
        yield from numbers(function, "inflation", 0.0, -1.0)
    missing = f"{FOLDER.name}/missing.yaml"
    yield refused(
        "read_imu_parameters", "path", "option", missing, "is none", "expected a file", "missing.yaml"
    )
    broken = file("update_rate: 5\n", "broken.yaml")
    yield refused(
        "read_imu_parameters", "path", "option", broken, "is missing", "expected a number", "broken.yaml"
    )
    function = "write_imu_parameters"
    yield refused(
        function, "parameters", "type", NOISE, "got ImuNoise", "expected a torchspline.io.ImuParameters"
    )
    yield refused(function, "format", "option", "tum", "got 'tum'", "'kalibr', 'euroc'")
    triple = imu.ImuNoise(torch.tensor([0.1, 0.2, 0.3]))
    wandering = imu.ImuNoise(gyroscope_bias_sigma=0.1)
    for bad, came, expected in (
        (records.ImuParameters(triple, 100.0), "got [0.1", "for all axes"),
        (records.ImuParameters(wandering, 100.0), "gyroscope_bias_sigma has no place", "densities and walks"),
        (records.ImuParameters(NOISE, 100.0, T_body_imu=good), "got one", "expected no T_body_imu"),
        (records.ImuParameters(NOISE, 100.0, calibration={"a": THREE}), "got a", "expected no calibration"),
    ):
        yield refused(function, "parameters", "option", bad, came, expected)
