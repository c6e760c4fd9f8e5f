"""Bad arguments of groups."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from error_arguments import (
    F64,
    I64,
    INF,
    NAN,
    POSE,
    SE3_MATRIX,
    TANGENT,
    Case,
    V,
    accept,
    matrices,
    pointwise,
    refused,
    wholes,
)

import torchspline
from torchspline import (
    R3,
    SE3,
    SO3,
    Rn,
)


def enter_use_kernels(mode: str) -> None:
    with torchspline.use_kernels(mode):
        pass


FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
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
    "Group.interpolate": (SE3.interpolate, {"start": POSE, "end": POSE, "s": TANGENT[..., 0]}),
}  # fmt: skip
accept(FUNCTIONS)

_TANGENT = "Group.exp Group.left_jacobian Group.left_jacobian_inverse Group.right_jacobian Group.right_jacobian_inverse"
_MAKERS = "Group Rn product use_kernels"
_NEW = "Group.identity Group.random"
_ONE = f"{_TANGENT} Group.adjoint Group.inverse Group.log Group.normalize Group.to_matrix Group.from_matrix"
_TWO = (
    "Group.power Group.interpolate Group.compose Group.between Group.act Group.adjoint_act Group.retract "
    "Group.bracket"
)
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shape": {"no tensor": _MAKERS},
    "dtype": {"no tensor": _MAKERS},
    "device": {"no two tensors": f"{_MAKERS} {_NEW} {_ONE}"},
    "nan": {"no numbers": f"{_MAKERS} {_NEW}"},
    "zero quaternion": {
        "no quaternion goes in": f"{_MAKERS} {_NEW} {_TANGENT} Group.bracket Group.from_matrix"
    },
    "count": {"one of it": "Group Rn use_kernels", "any number of points": f"{_NEW} {_ONE} {_TWO}"},
    "time": {"no times": " ".join(FUNCTIONS)},
}


def cases() -> Iterator[Case]:
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
    for function in FUNCTIONS:
        yield from pointwise(function)
    yield from matrices("Group.from_matrix", 4)
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
