"""What every public function is tried with, and what its error has to say."""

from collections.abc import Iterator
from types import SimpleNamespace

import error_fit
import torch
from error_arguments import (
    ACCEPTED,
    F32,
    F64,
    FOLDER,
    GYRO,
    I64,
    IMU_COLUMNS,
    INF,
    NAN,
    NS,
    POSE,
    POSE_COLUMNS,
    POSES,
    PYPOSE,
    READ_AT,
    SAMPLES,
    STAMPS,
    TANGENT,
    TUM_FILE,
    TURNING,
    Case,
    Q,
    T,
    V,
    changed,
    control_points,
    file,
    groups,
    numbers,
    refused,
    spacings,
    tensor,
    times,
    wholes,
)

import torchspline.io as records
from torchspline import SE3, SO3, BSpline, Rn, SplitBSpline
from torchspline.fit.losses import Huber
from torchspline.groups import convert


def cases() -> Iterator[Case]:
    """All of them."""
    for bad in (5, None, b"SO3"):
        yield refused("Group", "name", "type", bad, f"got {type(bad).__name__}", "'SO3'", named="group")
    for bad in ("so3", "", "R0", "R-1", "SO3xSO4", "SE3 "):
        yield refused(
            "Group", "name", "option", bad, "called '", "expected one of 'SO3', 'SE3'", named="group"
        )
    for bad in ("Fused", "", None, True):
        yield refused("use_kernels", "mode", "option", bad, f"got {bad!r}", "'auto', 'fused', 'reference'")
    yield from wholes("Rn", "size", 1)
    yield refused("product", "groups", "count", (SO3,), "got 1", "at least two")
    yield refused("product", "groups", "type", (SO3, "R3"), "got str", "torchspline.Group")
    for function in ("Group.identity", "Group.random"):
        for bad in (-1, 1.5, [2], True):
            yield refused(
                function, "batch", "shape", (2, bad), f"got {bad!r}", "a whole number of at least 0"
            )
        for bad in (I64, torch.float16, None, "float64"):
            yield refused(function, "dtype", "dtype", bad, f"got {bad}", "torch.float32 or torch.float64")
    yield refused("Group.random", "generator", "type", 5, "got int", "expected a torch.Generator")

    quaternions = {"x": 3, "point": 3, "left": 3, "right": 3, "start": 3, "end": 3, "pose": 3, "q": 0, "Q": 0}
    for function, (_, good) in ACCEPTED.items():
        if function in error_fit.FITTING:
            continue
        if not function.startswith("Group.") and good.keys() & {
            "t",
            "times",
            "control_points",
            "keyframes",
            "points",
            "time_ns",
        }:
            continue  # sequences and records come below
        together = [name for name, x in good.items() if isinstance(x, torch.Tensor)]
        for name in together:
            if name in ("s", "exponent", "matrix", "T_body_sensor") or function in (
                "from_screw",
                "geodesic_product",
            ):
                continue
            start = quaternions.get(name)
            width = good[name].shape[-1]
            part = None if start is None else slice(start, width)
            if function == "pose_from_xyzw":
                part = slice(3, 7)
            if name == "Q":
                part = slice(0, 4)
            others = [other for other in together if other != name]
            yield from tensor(function, name, f" (..., {width})", part, others[0] if others else None)
            if others:
                other, batch = others[0], good[name][:1].expand(3, *good[name].shape[1:])
                yield refused(function, name, "batch", batch, f"{name} (3, 8)", f"{other} (2, 8)")
    for function in ("Group.from_matrix", "from_transform_matrix", "from_rotation_matrix"):
        good, size = ACCEPTED[function][1]["matrix"], 3 if function == "from_rotation_matrix" else 4
        yield from tensor(function, "matrix", f" (..., {size}, {size})")
        for bad in (-good, good.mT * 1.01):
            yield refused(function, "matrix", "option", bad, "is off by", "expected matrices of the group")
    for bad in ("Left", None, 1):
        yield refused("Group.retract", "side", "option", bad, f"got {bad!r}", "'left', 'right'")
    for function, name, start in (
        ("Group.interpolate", "s", "start"),
        ("Group.power", "exponent", "point"),
    ):
        s = TANGENT[..., 0]
        for bad in (None, "a", [0.5], 1j, True):
            yield refused(function, name, "type", bad, f"got {type(bad).__name__}", "expected a number")
        for bad in (s.to(I64), s.half()):
            yield refused(function, name, "dtype", bad, f"got {bad.dtype}", "torch.float64")
        for bad in (NAN, s * INF):
            came = f"got {'inf' if bad is not NAN else 'nan'}"
            yield refused(function, name, "nan", bad, came, "finite")
        yield refused(function, name, "batch", s[..., :3], f"{name} (2, 3)", f"{start} (2, 8)")
        yield refused(function, name, "device", s.to("meta"), "meta", "cpu")
        yield refused(function, name, "mixed dtype", s.float(), "torch.float32", "torch.float64")
    yield from screws()
    for function in ("to_euler", "from_euler"):
        for bad in ("xxz", "XYz", "xy", "", None, 5):
            yield refused(function, "sequence", "option", bad, f"got {bad!r}", "one of 'XYX'")
    yield refused("from_scipy", "rotation", "type", Q, "got Tensor", "scipy.spatial.transform.Rotation")
    for bad in (I64, torch.float16, None):
        yield refused("from_scipy", "dtype", "dtype", bad, f"got {bad}", "torch.float32 or torch.float64")
    yield refused("to_transform3d", "pose", "shape", POSE, "got (2, 8, 7)", "(7,) or (N, 7)")
    yield refused(
        "from_transform3d", "transform", "type", POSE, "got Tensor", "pytorch_kinematics.Transform3d"
    )
    for bad in ("so3", None):
        yield refused("to_pypose", "kind", "option", bad, f"got {bad!r}", "'SO3', 'SE3'")
    yield refused("from_pypose", "lietensor", "type", POSE, "got Tensor", "pypose.LieTensor")
    for numbers_of, category, came in ((0 * POSE, "zero quaternion", "length 0"), (NAN * POSE, "nan", "nan")):
        bad = type("Other", (PYPOSE.LieTensor,), {"tensor": lambda self, x=numbers_of: x})()
        yield refused("from_pypose", "lietensor", category, bad, f"got {came}", "expected")
    tangents = type("Tangent", (PYPOSE.LieTensor,), {"ltype": 5})()
    yield refused("from_pypose", "lietensor", "option", tangents, "got int", "SO3Type or SE3Type")
    scaled = convert.to_transform3d(POSE[0]).scale(2.0)
    yield refused("from_transform3d", "transform", "option", scaled, "off by", "orthonormal")
    broken = convert.to_transform3d(POSE[0]).translate(NAN, 0.0, 0.0)
    yield refused("from_transform3d", "transform", "nan", broken, "got nan", "expected finite")

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
    for function in ("bspline", "BSpline", "consistent_signs", "phantom_points", "initial_control_points"):
        yield from groups(function)
    yield refused("bspline", "control_points", "device", POSE.to("meta"), "meta", "cpu")
    for bad in ("Left", None, 1):
        yield refused("BSpline.jacobians", "side", "option", bad, f"got {bad!r}", "'left', 'right'")
    for function in ("bspline", "BSpline.evaluate", "BSpline.jacobians", "Mounted.evaluate"):
        for bad in (4, -1, True, 1.0, None):
            yield refused(function, "derivatives", "option", bad, f"got {bad!r}", "from 0 to 3")
    for function in ("bspline", "BSpline.evaluate", "BSpline.jacobians", "Trajectory.forward",
                     "Trajectory.kinematics", "Mounted.evaluate", "measure"):  # fmt: skip
        yield from times(function)
    for bad in (T, NS.int()):
        yield refused("bspline", "t", "dtype", bad, f"got {bad.dtype}", "int64", **ns)
    outside = "outside the domain [0, 500000000] ns"
    yield refused("bspline", "t", "time", NS + 5 * 10**8 - 1, "the first is 500000001", outside, **ns)

    for function, name in (
        ("Trajectory.mounted", "T_body_sensor"), ("Mounted", "T_body_sensor"), ("measure", "T_body_imu"),
    ):  # fmt: skip
        for case in tensor(function, name, " (..., 7)", slice(3, 7), like=POSE[0, 0]):
            if function != "measure" or case.changes[name] is not None:  # None: the body frame is the IMU's
                yield case
    for function, name in (("Mounted.evaluate", "T_body_sensor"), ("measure", "T_body_imu")):
        mount = POSE[0, 0]
        yield refused(function, name, "device", mount.to("meta"), "meta", "cpu")
        yield refused(function, name, "mixed dtype", mount.float(), "torch.float32", "torch.float64")
        yield refused(function, name, "batch", mount.expand(3, 7), "(3,", "(2,")
    for function in ("Mounted", "measure"):
        yield refused(function, "trajectory", "type", POSE, "got Tensor", "expected a Trajectory")
    plane, turning = BSpline(Rn(2).random(5), group=Rn(2), dt=0.1), BSpline(Q, group=SO3, dt=0.1)
    yield refused("Mounted", "trajectory", "option", plane, "got R2", "one in SO3, R3xSO3, SE3")
    for bad in (plane, turning):
        yield refused("measure", "trajectory", "option", bad, f"got {bad.group}", "SE3 or R3xSO3")
    for name in ("gravity", "gyroscope_bias", "accelerometer_bias"):
        for bad in ("down", [[1.0, 2, 3], [1]], [None] * 3, *((None,) if name == "gravity" else ())):
            yield refused("measure", name, "type", bad, f"got {bad!r}", "a tensor or three numbers")
        yield from (
            case
            for case in tensor("measure", name, " (..., 3)", None, "trajectory", like=V[0, 0])
            if case.category != "type"
        )
        yield refused("measure", name, "shape", (0.0, 9.8), "got (2,)", "expected shape (..., 3)")
        yield refused("measure", name, "batch", V[0, :4], f"{name} (4, 3)", "readings (2, 3, 3)")

    yield from geodesics()
    yield from hermite()
    yield from nonuniform()
    yield from keyframes()
    yield from control_points("consistent_signs", "points", POSE, 1)
    yield from control_points("phantom_points", "keyframes", POSE, 2)
    yield refused("phantom_points", "keyframes", "count", POSE[:, :2], "got 2", "at least 3 points", order=6)
    yield from wholes("phantom_points", "order", 2, [4])
    function = "initial_control_points"
    yield from control_points(function, "poses", POSE[0], 1)
    yield from tensor(function, "t", "s (N,) and (N, P)", named="t, poses")
    yield refused(
        function, "poses", "shape", POSE, "(2, 8, 7)", "expected shapes (N,) and (N, P)", named="t, poses"
    )
    yield refused(function, "t", "device", STAMPS.to("meta"), "meta", "cpu")
    yield refused(function, "t", "option", STAMPS.flip(0), "got 7.0 and then 6.0", "increasing times")
    yield refused(function, "t", "option", 0 * STAMPS, "got 0.0 and then 0.0", "increasing times")
    yield from wholes(function, "order", 2)
    yield from wholes(function, "count", 1)
    yield from numbers(function, "dt", 0.0, -1.0)
    yield from numbers(function, "t0")
    yield from fits()
    yield from alignments()
    yield from files()
    yield from error_fit.cases()


def knot_times(function: str, argument: str, what: str) -> Iterator[Case]:
    """What the times of knots or keys are tried with; eight are expected."""
    good = ACCEPTED[function][1][argument]
    for case in tensor(function, argument, " (8,), one time for each", mixed=None, like=good):
        if (
            case.category != "shape" and "int64" not in case.came
        ):  # those are nanoseconds, see error_splines.py
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
            # float32 knots are numbers like any other, int64 ones nanoseconds, see error_splines.py
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


def screws() -> Iterator[Case]:
    function = "from_screw"
    good = ACCEPTED[function][1]
    for name, x in good.items():
        if name in ("axis", "moment"):
            yield from tensor(function, name, " (..., 3)", None, "angle" if name == "axis" else "axis")
        else:
            for case in tensor(function, name, "", None, "axis"):
                if case.category != "shape":
                    yield case
        yield refused(function, name, "batch", x[:1, :3], f"{name} (1, 3)", "(2, 8)")
    yield refused(function, "axis", "option", 2 * good["axis"], "got length 2", "length one")


def fits() -> Iterator[Case]:
    function, poses = "fit_poses", POSE[0]
    for case in tensor(function, "poses", "s (N,) and (N, 7)", slice(3, 7), named="t, poses"):
        if "nan at" in case.came:  # rows with NaN are left out: only when too few remain
            case = refused(function, "poses", "nan", poses * NAN, "got 0", "usable poses", named="t")
        yield case
    yield refused(function, "poses", "device", poses.to("meta"), "meta", "cpu")
    for bad in (STAMPS.tolist(), STAMPS.numpy(), None):
        yield refused(function, "t", "type", bad, f"got {type(bad).__name__}", "a torch.Tensor")
    for dtype in (F32, torch.float16, torch.int32):
        yield refused(function, "t", "dtype", STAMPS.to(dtype), f"got {dtype}", "float64 seconds or int64")
    for bad in (STAMPS[:-1], STAMPS[0], STAMPS[None]):
        yield refused(
            function, "t", "shape", bad, f"got {tuple(bad.shape)}", "(N,) and (N, 7)", named="t, poses"
        )
    yield refused(function, "t", "nan", changed(STAMPS, 3, INF), "got inf at index (3,)", "finite")
    later = changed(changed(poses, 0, NAN), (4, 2), INF)
    yield refused(function, "poses", "nan", later, "got inf at index (4, 2)", "finite")
    for bad in (STAMPS * 0, STAMPS * NAN, changed(STAMPS * NAN, 2, 1.0)):
        came = f"got {int(not bad.isnan().all())}"
        yield refused(function, "t", "count", bad, came, "at least two distinct times")
    for name in ("dt", "position_sigma", "rotation_sigma", "smoothness"):
        yield from (case for case in numbers(function, name, 0.0, -1.0) if case.changes != {"dt": "a"})
    yield refused(function, "dt", "option", "Auto", "got 'Auto'", "'auto'")
    for bad in (0.1, [0.1, 0.1], (0.1,), "tight"):
        yield refused(function, "accuracy", "option", bad, f"got {bad!r}", "expected two numbers", dt="auto")
    for number in (NAN, INF, 0.0, -1.0):
        yield refused(function, "accuracy", "nan", (0.1, number), f"got {number}", "above zero", dt="auto")
    yield refused(function, "accuracy", "type", ("a", 0.1), "got str", "a number", dt="auto")
    yield refused(function, "accuracy", "option", (0.1, 0.1), "got dt=2.0", 'goes with dt="auto"')
    yield refused(function, "dt", "option", 1e-10, "got 1e-10 s", "at least a nanosecond", t=STAMPS.to(I64))
    yield from numbers(function, "tolerance", -1.0)
    yield from wholes(function, "order", 2, INF)
    yield from (c for c in wholes(function, "max_iterations", 0) if c.changes["max_iterations"] != 0)
    for bad in ("Split", "SE3", None):
        yield refused(function, "representation", "option", bad, f"got {bad!r}", "'split', 'joint'")


def alignments() -> Iterator[Case]:
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
        yield refused(function, "estimate_skew", "type", bad, f"got {type(bad).__name__}", "True or False")
    for bad in ("Huber", 1.0, Huber):
        yield refused(function, "loss", "type", bad, f"got {type(bad).__name__}", "a robust loss")
    function = "Alignment.pose_time"
    for bad in (READ_AT.tolist(), READ_AT.numpy(), None, 1.0):
        yield refused(function, "t", "type", bad, f"got {type(bad).__name__}", "a torch.Tensor")
    for dtype in (I64, F32):
        yield refused(function, "t", "dtype", READ_AT.to(dtype), f"got {dtype}", "expected torch.float64")


READ_WRITE = ("read_poses", "read_imu", "write_poses", "write_imu")
COLUMNS = [
    (kind, column)
    for kind, columns in (("PoseRecord", POSE_COLUMNS), ("ImuRecord", IMU_COLUMNS))
    for column in columns
    if column != "time_ns"
]


def files() -> Iterator[Case]:
    """Here what is wrong with arguments; what may be wrong with the content of files has tests of its own."""
    zero = file("1.5 1 2 3 0 0 0 0\n", "zero.txt")
    for function in READ_WRITE:
        for bad in (5, None):
            yield refused(function, "path", "type", bad, f"got {type(bad).__name__}", "path")
        for bad in ("bvh", 5):
            yield refused(
                function, "format", "option", bad, f"got {bad!r}", "expected a format", named=function
            )
    for function in ("read_poses", "read_imu"):
        short = file("1.5,2\n", "short.csv")
        empty = file("", "empty.txt")
        yield refused(function, "path", "shape", short, "got 2 columns", "rows that look like", named=short)
        yield refused(function, "path", "count", empty, "without any", "expected rows", named=empty)
        nowhere = f"{FOLDER.name}/nowhere.txt"
        yield refused(function, "path", "option", nowhere, "no such file", nowhere, named=nowhere)
    yield refused("read_poses", "path", "zero quaternion", zero, "got '1.5", "not zero", named=zero)
    yield refused("read_poses", "times", "option", "x", "times='x'", "hold their own stamps", named=TUM_FILE)
    for function, wrong in (("write_poses", SAMPLES), ("write_imu", POSES)):
        kind = "PoseRecord" if function == "write_poses" else "ImuRecord"
        for bad in (wrong, None, SimpleNamespace()):
            yield refused(function, "record", "type", bad, f"got {type(bad).__name__}", kind)
        empty = (POSES if function == "write_poses" else SAMPLES).window(1, 0)
        path = ACCEPTED[function][1]["path"]
        yield refused(function, "record", "count", empty, "got an empty", "expected rows", named=path)
    still = records.PoseRecord(**{**POSE_COLUMNS, "rotation": 0 * Q[0]})
    yield refused("write_poses", "record", "zero quaternion", still, "got", "quaternion")
    for kind, columns in (("PoseRecord", POSE_COLUMNS), ("ImuRecord", IMU_COLUMNS)):
        for name, x in columns.items():
            named, dtype = f"{kind}.{name}", I64 if name == "time_ns" else F64
            yield refused(kind, name, "type", x.tolist(), "got list", "expected a tensor", named)
            yield refused(kind, name, "dtype", x.float(), "got torch.float32", f"expected {dtype}", named)
            yield refused(kind, name, "shape", x[None], f"got {(1, *x.shape)}", "expected shape (N,", named)
            if name != "time_ns":
                yield refused(kind, name, "count", x[:-1], "got 7", "expected 8 rows", named)
                yield refused(kind, name, "device", x.to("meta"), "meta", "cpu", named)
    yield refused("_Record.seconds", "origin_ns", "type", 1.5, "'float'", "integer", named="origin_ns")
    for name in ("start_ns", "end_ns"):
        yield refused("_Record.window", name, "type", 1.5, "'float'", "integer")


CASES = list(cases())
