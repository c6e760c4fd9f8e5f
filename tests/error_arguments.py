"""What the functions of the package accept, and what every argument of a kind is tried with."""

import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock

import torch
from scipy.spatial.transform import Rotation

import torchspline
import torchspline.io as records
from torchspline import (
    R3,
    SE3,
    SO3,
    Alignment,
    BSpline,
    HermiteSpline,
    KeyframeSpline,
    NonuniformBSpline,
    Rn,
    SplitBSpline,
    imu,
)
from torchspline.groups import convert
from torchspline.splines.trajectory import Mounted

F32, F64, I64 = torch.float32, torch.float64, torch.int64
NAN, INF = float("nan"), float("inf")
FOLDER = tempfile.TemporaryDirectory(prefix="torchspline-errors-")


def file(content: str, name: str) -> str:
    path = Path(FOLDER.name) / name
    path.write_text(content)
    return str(path)


# ---------------------------------------------------------------------- arguments that are accepted

POSE = SE3.random(2, 8, generator=torch.Generator().manual_seed(0))
TANGENT = torch.full((2, 8, 6), 0.1, dtype=F64)
Q, V = POSE[..., 3:], POSE[..., :3]
DUAL = convert.pose_to_dual_quaternion(POSE)
T = torch.tensor([0.0, 0.2, 0.5], dtype=F64)
STAMPS = torch.arange(8, dtype=F64)
NS = torch.arange(3)
SPLINE = SplitBSpline(POSE, dt=0.1)
KNOTS = {
    "values": POSE,
    "velocities": TANGENT,
    "accelerations": TANGENT,
    "group": SE3,
    "times": torch.linspace(0.0, 0.5, 8, dtype=F64),
}
HERMITE = HermiteSpline(**KNOTS)
KNOTTED = {
    "control_points": POSE,
    "group": SE3,
    "knots": torch.tensor([0.0] * 4 + [0.1, 0.2, 0.3, 0.4] + [0.5] * 4, dtype=F64),
}
KEYED = {"keyframes": POSE, "times": KNOTS["times"]}
SE3_MATRIX, SO3_MATRIX = SE3.to_matrix(POSE), SO3.to_matrix(Q)
TUM_FILE = file("1.5 1 2 3 0 0 0 1\n2.5 1 2 3 0 0 0 1\n", "good.txt")
IMU_FILE = file("1520530308189679351,1,2,3,4,5,6\n", "good.csv")
POSE_COLUMNS = {"time_ns": torch.arange(8), "position": V[0], "rotation": Q[0]}
IMU_COLUMNS = {"time_ns": torch.arange(8), "gyroscope": V[0], "accelerometer": V[0]}
POSES, SAMPLES = records.PoseRecord(**POSE_COLUMNS), records.ImuRecord(**IMU_COLUMNS)

#: As much of PyPose as the conversions look at, so that their errors are tried without it.
PYPOSE = SimpleNamespace(
    LieTensor=type("LieTensor", (), {"ltype": "SE3", "tensor": lambda self: POSE}),
    SO3_type="SO3",
    SE3_type="SE3",
    SO3=torch.clone,
    SE3=torch.clone,
)


def with_pypose(function: Callable[..., Any]) -> Callable[..., Any]:
    return mock.patch.dict(sys.modules, {"pypose": PYPOSE})(function)


def enter_use_kernels(mode: str) -> None:
    with torchspline.use_kernels(mode):
        pass


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


#: Every public function, called by keyword with arguments it accepts.
ACCEPTED: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "Group": (torchspline.Group, {"name": "SO3"}),
    "Rn": (Rn, {"size": 2}),
    "use_kernels": (enter_use_kernels, {"mode": "auto"}),
    "product": (lambda groups: torchspline.product(*groups), {"groups": (R3, SO3)}),
    "Group.identity": (lambda batch, **k: SE3.identity(*batch, **k), {"batch": (2,), "dtype": F64}),
    "Group.random": (
        lambda batch, **k: SE3.random(*batch, **k),
        {"batch": (2,), "generator": None, "dtype": F64},
    ),
    "Group.from_matrix": (SE3.from_matrix, {"matrix": SE3_MATRIX}),
    **{
        f"Group.{name}": (getattr(SE3, name), {"tangent": TANGENT})
        for name in ("exp", "left_jacobian", "left_jacobian_inverse", "right_jacobian", "right_jacobian_inverse")
    },
    **{
        f"Group.{name}": (getattr(SE3, name), {"point": POSE})
        for name in ("adjoint", "inverse", "log", "normalize", "to_matrix")
    },
    "Group.compose": (SE3.compose, {"left": POSE, "right": POSE}),
    "Group.between": (SE3.between, {"start": POSE, "end": POSE}),
    "Group.act": (SE3.act, {"point": POSE, "vector": V}),
    "Group.adjoint_act": (SE3.adjoint_act, {"point": POSE, "tangent": TANGENT}),
    "Group.bracket": (SE3.bracket, {"a": TANGENT, "b": TANGENT}),
    "Group.retract": (SE3.retract, {"point": POSE, "tangent": TANGENT, "side": "left"}),
    "Group.power": (SE3.power, {"point": POSE, "exponent": TANGENT[..., 0]}),
    "pose_to_dual_quaternion": (convert.pose_to_dual_quaternion, {"pose": POSE}),
    "pose_from_dual_quaternion": (convert.pose_from_dual_quaternion, {"Q": DUAL}),
    "to_screw": (convert.to_screw, {"Q": DUAL}),
    "from_screw": (convert.from_screw, convert.to_screw(DUAL)._asdict()),
    "Group.interpolate": (SE3.interpolate, {"start": POSE, "end": POSE, "s": TANGENT[..., 0]}),
    "to_xyzw": (convert.to_xyzw, {"q": Q}),
    "from_xyzw": (convert.from_xyzw, {"q": Q}),
    "pose_to_xyzw": (convert.pose_to_xyzw, {"pose": POSE}),
    "pose_from_xyzw": (convert.pose_from_xyzw, {"pose": POSE}),
    "to_rotation_matrix": (convert.to_rotation_matrix, {"q": Q}),
    "from_rotation_matrix": (convert.from_rotation_matrix, {"matrix": SO3_MATRIX}),
    "to_rotation_vector": (convert.to_rotation_vector, {"q": Q}),
    "from_rotation_vector": (convert.from_rotation_vector, {"vector": V}),
    "to_transform_matrix": (convert.to_transform_matrix, {"pose": POSE}),
    "from_transform_matrix": (convert.from_transform_matrix, {"matrix": SE3_MATRIX}),
    "from_euler": (convert.from_euler, {"angles": V, "sequence": "XYZ"}),
    "to_euler": (convert.to_euler, {"q": Q, "sequence": "xyz"}),
    "to_scipy": (convert.to_scipy, {"q": Q[0]}),
    "from_scipy": (convert.from_scipy, {"rotation": Rotation.identity(2), "dtype": F64}),
    "to_pypose": (with_pypose(convert.to_pypose), {"x": POSE, "kind": "SE3"}),
    "from_pypose": (with_pypose(convert.from_pypose), {"lietensor": PYPOSE.LieTensor()}),
    "to_transform3d": (convert.to_transform3d, {"pose": POSE[0]}),
    "from_transform3d": (convert.from_transform3d, {"transform": convert.to_transform3d(POSE[0])}),
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
    "measure": (imu.measure, {"trajectory": SPLINE, "t": T}),
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
    "initial_control_points": (
        torchspline.initial_control_points,
        {"t": STAMPS, "poses": POSE[0], "group": SE3, "order": 4, "dt": 1.0, "t0": 0.0, "count": 5},
    ),
    "fit_poses": (torchspline.fit_poses, {"t": STAMPS, "poses": POSE[0], "dt": 2.0, "max_iterations": 1}),
    "align_imu": (align_quickly, {"trajectory": TURNING, "t": READ_AT, "gyro": GYRO, "accel": None}),
    "Alignment.pose_time": (ALIGNED.pose_time, {"t": READ_AT}),
    "read_poses": (records.read_poses, {"path": TUM_FILE}),
    "read_imu": (records.read_imu, {"path": IMU_FILE}),
    "write_poses": (records.write_poses, {"path": f"{FOLDER.name}/poses.txt", "record": POSES}),
    "write_imu": (records.write_imu, {"path": f"{FOLDER.name}/imu.csv", "record": SAMPLES}),
    "PoseRecord": (records.PoseRecord, POSE_COLUMNS),
    "ImuRecord": (records.ImuRecord, IMU_COLUMNS),
    "_Record.seconds": (POSES.seconds, {}),
    "_Record.window": (POSES.window, {"start_ns": 0, "end_ns": 3}),
}  # fmt: skip

# ---------------------------------------------------------------------- arguments that are refused


class Case(NamedTuple):
    """What is called, the argument that is wrong and how, and what the message has to contain."""

    function: str
    argument: str
    category: str
    changes: dict[str, Any]
    came: str
    expected: str
    #: How the message calls the argument: at its start, or anywhere if two arguments do not go together.
    named: str


TOGETHER = ("device", "batch", "mixed dtype")


def refused(
    function: str,
    argument: str,
    category: str,
    bad: Any,
    came: str,
    expected: str,
    named: str = "",
    **also: Any,
) -> Case:
    return Case(function, argument, category, {argument: bad, **also}, came, expected, named or argument)


def changed(x: torch.Tensor, index: Any, value: float) -> torch.Tensor:
    x = x.clone()
    x[index] = value
    return x


def tensor(
    function: str,
    argument: str,
    size: str,
    quaternion: slice | None = None,
    mixed: str | None = None,
    like: torch.Tensor | None = None,
    named: str = "",
) -> Iterator[Case]:
    """What every tensor argument is tried with.

    Args:
        size: the shape that is expected. quaternion: which components are one. like: an argument that is accepted.
        mixed: another tensor it has to go with. named: who a wrong shape is blamed on.
    """
    good = ACCEPTED[function][1][argument] if like is None else like

    def case(category: str, bad: Any, came: str, expected: str) -> Case:
        return refused(function, argument, category, bad, came, expected)

    yield case("type", good.tolist(), "got list", "expected a torch.Tensor")
    yield case("type", good.numpy(), "got ndarray", "expected a torch.Tensor")
    yield case("type", None, "got NoneType", "expected a torch.Tensor")
    for dtype in (I64, torch.float16, torch.bfloat16, torch.complex64, torch.bool):
        yield case("dtype", good.to(dtype), f"{dtype}", "torch.float32 or torch.float64")
    for bad in (torch.zeros((), dtype=F64), good[..., :-1], torch.cat([good, good], -1)):
        got = f"{tuple(bad.shape)}" if named else f"got {tuple(bad.shape)}"
        yield case("shape", bad, got, f"expected shape{size}")._replace(named=named or argument)
    first = (0,) * good.ndim
    for value in (NAN, INF):
        yield case(
            "nan", changed(good, first, value), f"got {value} at index {first}", "expected finite numbers"
        )
    if quaternion:
        zero = changed(good, (*first[:-1], quaternion), 0.0)
        yield case("zero quaternion", zero, f"got length 0 at index {first[:-1]}", "expected quaternions")
    if mixed:
        yield case("device", good.to("meta"), "meta", "cpu")
        yield case("mixed dtype", good.float(), "torch.float32", "torch.float64")


def times(function: str, points: str = "control_points", ns: bool = True) -> Iterator[Case]:
    """What the times of a trajectory with the domain [0, 0.5] are tried with.

    Args:
        points: what it is made of. ns: whether there are trajectories of its kind in nanoseconds.
    """

    def case(category: str, bad: Any, came: str, expected: str) -> Case:
        return refused(function, "t", category, bad, came, expected)

    yield case("type", 0.1, "got float", "expected a torch.Tensor")
    yield case("type", T.numpy(), "got ndarray", "expected a torch.Tensor")
    for dtype in (torch.float16, torch.bfloat16, torch.complex128, torch.int32, torch.bool):
        yield case("dtype", T.to(dtype), f"got {dtype}", "torch.float32 or torch.float64")
    yield case("dtype", NS, *(("int64 times", "dt_ns") if ns else ("got torch.int64", "torch.float64")))
    yield case("device", T.to("meta"), "meta", "cpu")
    yield case("batch", T.expand(3, 3), "t (3,)", f"{points} (2,)")
    for value in (NAN, INF, -INF):
        yield case("nan", changed(T, 1, value), f"got {value} at index (1,)", "expected finite numbers")
    yield case("time", T + 0.1, "the first is 0.6", "outside the domain [0.0, 0.5] s")
    yield case("time", T[:1] - 1e-9, "the first is -1e-09", "outside the domain [0.0, 0.5] s")
    yield case("time", T.float() + 1e6, "near 1e+06 s", "dt = 0.1 s" if ns else "shortest segment")


def spacings(function: str, ns: dict[str, Any]) -> Iterator[Case]:
    """What knot spacing and start are tried with; `ns`: what makes a call with nanoseconds right."""
    for name in ("dt", "t0"):
        for bad in (True, "a", [0.1], 1j):
            yield refused(
                function, name, "type", bad, f"got {type(bad).__name__}", "expected seconds as a number"
            )
        for bad in (NAN, INF, -INF):
            yield refused(function, name, "nan", bad, f"got {bad}", "expected a finite number")
            yield refused(function, name, "nan", torch.tensor(bad), f"got {bad}", "expected a finite number")
        yield refused(function, name, "dtype", torch.tensor(1), "got torch.int64", "torch.float64")
        yield refused(function, name, "shape", T, "got shape (3,)", "expected one number")
        yield refused(function, name, "device", torch.zeros((), device="meta"), "meta", "cpu")
        for bad in (True, 0.5, T):
            both = {**ns, f"{name}_ns": bad}
            yield refused(function, f"{name}_ns", "type", bad, f"got {bad!r}", "a whole number", **both)
    for bad in (0.0, -0.1):
        yield refused(function, "dt", "option", bad, f"got {bad}", "above zero")
        yield refused(function, "dt", "option", torch.tensor(bad), f"got {torch.tensor(bad)}", "above zero")
    yield refused(function, "t0", "type", None, "got NoneType", "expected seconds as a number")
    yield refused(function, "dt", "option", None, "got neither", "expected the knot spacing")
    for bad in (0, -5):
        yield refused(function, "dt_ns", "option", bad, f"got {bad}", "above zero", **{**ns, "dt_ns": bad})
    yield refused(function, "dt_ns", "option", 5, "got dt_ns=5 and dt=0.1", "expected dt_ns and no dt")
    yield refused(function, "t0_ns", "option", 5, "got dt_ns=None and dt=None", "expected dt_ns", dt=None)
    yield refused(function, "t0", "option", 0.5, "got t0=0.5", "expected as t0_ns", **ns)


def wholes(function: str, argument: str, least: int, *more: Any) -> Iterator[Case]:
    for bad in (least - 1, float(least), True, None, "4", *more):
        yield refused(
            function, argument, "option", bad, f"got {bad!r}", f"a whole number of at least {least}"
        )


def groups(function: str) -> Iterator[Case]:
    for bad in ("SE3", None, SE3.arithmetic):
        yield refused(
            function, "group", "type", bad, f"got {type(bad).__name__}", "expected a torchspline.Group"
        )


def numbers(function: str, argument: str, *outside: float) -> Iterator[Case]:
    for bad in (None, "a", True, 1j, T):
        yield refused(function, argument, "type", bad, f"got {type(bad).__name__}", "expected a number")
    for bad in (NAN, INF, *outside):
        yield refused(function, argument, "nan", bad, f"got {bad}", "expected a ")


def control_points(function: str, argument: str, good: torch.Tensor, least: int) -> Iterator[Case]:
    yield from tensor(function, argument, " (..., M, 7), M points of", slice(3, 7), like=good)
    bad = good[..., : least - 1, :]
    yield refused(function, argument, "count", bad, f"got {least - 1}", f"at least {least} ")
