"""Bad arguments of the models of the earth."""

from collections.abc import Iterator
from typing import Any

import torch
from error_arguments import ACCEPTED, F64, INF, NAN, Case, accept, refused

from torchspline.imu import earth

LATITUDES = torch.tensor([0.1, 0.2], dtype=F64)
accept(
    {
        "earth_rate": (earth.earth_rate, {"latitude": 0.5}),
        "normal_gravity": (earth.normal_gravity, {"latitude": LATITUDES, "height": 0.0}),
        "dipole_field": (earth.dipole_field, {"latitude": LATITUDES, "longitude": LATITUDES, "height": 10.0}),
        "standard_pressure": (earth.standard_pressure, {"height": 100.0}),
    }
)
_ALL = "earth_rate normal_gravity dipole_field standard_pressure"
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shape": {"any shape, and one argument": "earth_rate standard_pressure"},
    "device": {"one argument": "earth_rate standard_pressure"},
    "zero quaternion": {"numbers": _ALL},
    "count": {"any number of places": _ALL},
    "time": {"no times": _ALL},
}


def cases() -> Iterator[Case]:
    for function in _ALL.split():
        for name in ACCEPTED[function][1]:
            yield from number(function, name)
            if name == "latitude":
                for bad, came in ((47.4, "47.4"), (torch.tensor([0.1, -1.6]), "-1.6")):
                    yield refused(function, name, "option", bad, f"got {came}", "radians from -pi/2 to pi/2")
            elif function in ("normal_gravity", "dipole_field"):
                meta, three = LATITUDES.to("meta"), torch.zeros(3, dtype=F64)
                yield refused(function, name, "device", meta, "meta", "cpu")
                yield refused(
                    function, name, "mixed dtype", LATITUDES.float(), "torch.float32", "torch.float64"
                )
                yield refused(function, name, "batch", three, f"{name} (3,)", "latitude (2,)")
    for bad in (-5001.0, 20001.0):
        yield refused(
            "standard_pressure", "height", "option", bad, f"got {bad:g}", "metres from -5000 to 20000"
        )


def number(function: str, name: str) -> Iterator[Case]:
    def case(category: str, bad: Any, came: str, expected: str) -> Case:
        return refused(function, name, category, bad, came, expected)

    for bad in (None, "a", True, [1.0]):
        yield case("type", bad, f"got {type(bad).__name__}", "expected a number")
    yield case("dtype", torch.tensor(1), "torch.int64", "torch.float64")
    for bad in (NAN, INF):
        yield case("nan", bad, f"got {bad}", "expected finite")
