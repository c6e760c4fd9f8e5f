"""Bad arguments of conversions to and from other representations and libraries."""

import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import torch
from error_arguments import (
    ACCEPTED,
    DUAL,
    F64,
    I64,
    NAN,
    POSE,
    SE3_MATRIX,
    SO3_MATRIX,
    Case,
    Q,
    V,
    accept,
    matrices,
    pointwise,
    refused,
    tensor,
)
from scipy.spatial.transform import Rotation

from torchspline.groups import convert

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


FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
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
    "pose_to_dual_quaternion": (convert.pose_to_dual_quaternion, {"pose": POSE}),
    "pose_from_dual_quaternion": (convert.pose_from_dual_quaternion, {"Q": DUAL}),
    "to_screw": (convert.to_screw, {"Q": DUAL}),
    "from_screw": (convert.from_screw, convert.to_screw(DUAL)._asdict()),
    "to_scipy": (convert.to_scipy, {"q": Q[0]}),
    "from_scipy": (convert.from_scipy, {"rotation": Rotation.identity(2), "dtype": F64}),
    "to_pypose": (with_pypose(convert.to_pypose), {"x": POSE, "kind": "SE3"}),
    "from_pypose": (with_pypose(convert.from_pypose), {"lietensor": PYPOSE.LieTensor()}),
    "to_transform3d": (convert.to_transform3d, {"pose": POSE[0]}),
    "from_transform3d": (convert.from_transform3d, {"transform": convert.to_transform3d(POSE[0])}),
}  # fmt: skip
accept(FUNCTIONS)

#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shape": {
        "no tensor": "from_scipy",
        "a foreign object, whose shape is its own affair": "from_pypose from_transform3d",
    },
    "dtype": {"a foreign object with a dtype of its own": "from_pypose from_transform3d"},
    "device": {"no two tensors": " ".join(FUNCTIONS.keys() - {"from_screw"})},
    "nan": {"no numbers": "from_scipy"},
    "zero quaternion": {
        "no quaternion goes in": "from_euler from_rotation_matrix from_rotation_vector from_scipy from_screw "
        "from_transform3d from_transform_matrix",
    },
    "count": {"any number of points": " ".join(FUNCTIONS)},
    "time": {"no times": " ".join(FUNCTIONS)},
}


def cases() -> Iterator[Case]:
    for function in FUNCTIONS:
        if function != "from_screw":
            yield from pointwise(function)
    yield from screws()
    yield from matrices("from_transform_matrix", 4)
    yield from matrices("from_rotation_matrix", 3)
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
