"""Bad arguments of noise."""

from collections.abc import Iterator
from typing import Any

import torch
from error_arguments import F64, INF, NAN, Case, T, accept, changed, refused

from torchspline import imu

SHAPE = (2, 3, 3)
_TIMED = {
    "random_walk": {"density": 0.1},
    "gauss_markov": {"density": 0.1, "correlation_time": 5.0},
    "flicker_noise": {"level": 0.1, "correlation_times": (0.1, 5.0)},
}
accept(
    {
        "item_generator": (imu.item_generator, {"seed": 0, "index": 2}),
        "white_noise": (imu.white_noise, {"shape": SHAPE, "density": 0.1, "rate": 100.0}),
        **{
            name: (getattr(imu, name), {"shape": SHAPE, "t": T, **parameters})
            for name, parameters in _TIMED.items()
        },
    }
)
NOISES = ("white_noise", *_TIMED)
_NOISES = " ".join(NOISES)

#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE = {
    "shape": {"a whole number": "item_generator"},
    "dtype": {"a whole number": "item_generator"},
    "device": {"a whole number": "item_generator"},
    "nan": {"a whole number": "item_generator"},
    "zero quaternion": {"no rotations": f"item_generator {_NOISES}"},
    "count": {"any number of samples": f"item_generator {_NOISES}"},
    "time": {"no times": "item_generator white_noise"},
}


def parameter(function: str, name: str, above: bool = False, infinite: bool = False) -> Iterator[Case]:
    """A number or a tensor that broadcasts to the channels."""

    def case(category: str, bad: Any, came: str, expected: str, **also: Any) -> Case:
        return refused(function, name, category, bad, came, expected, **also)

    for bad in (None, "a", True, [1.0]):
        yield case("type", bad, f"got {type(bad).__name__}", "expected a number")
    good = torch.ones(3, dtype=F64)
    yield case("dtype", good.to(torch.int64), "torch.int64", "torch.float64")
    for shape in ((2,), (3, 3), (4, 1, 3), (1, 2, 1, 3)):
        yield case("shape", torch.ones(shape, dtype=F64), f"got {shape}", "broadcasts to (2, 1, 3)")
    for bad in (NAN, *(() if infinite else (INF,))):
        for x in (bad, changed(good, 1, bad)):
            yield case("nan", x, f"got {bad}", "expected ")
    outside = (-1.0, 0.0) if above else (-1.0,)
    for bad in outside:
        yield case(
            "option", changed(good, 1, bad), f"got {bad}", "above zero" if above else "of at least zero"
        )


def cases() -> Iterator[Case]:
    for name in ("seed", "index"):
        for bad in (-1, 1.0, None, True):
            yield refused(
                "item_generator", name, "option", bad, f"got {bad!r}", "a whole number of at least 0"
            )
        yield refused("item_generator", name, "option", 2**63, f"got {2**63}", "below 2^63")
    for function in NOISES:
        for bad in (5, None, "233"):
            yield refused(function, "shape", "type", bad, f"got {type(bad).__name__}", "(*batch, N, C)")
        yield refused(function, "shape", "shape", (3,), "got (3,)", "samples and channels last")
        for bad in (-1, 2.0, True):
            yield refused(
                function, "shape", "shape", (2, bad, 3), f"got {bad!r}", "whole number of at least 0"
            )
        for bad in (5, "a"):
            yield refused(function, "generator", "type", bad, f"got {type(bad).__name__}", "torch.Generator")
        yield refused(function, "generator", "type", [None] * 2, "got NoneType", "torch.Generator")
        three = [torch.Generator() for _ in range(3)]
        yield refused(function, "generator", "option", three, "got 3", "one for each row")
        for bad in (torch.float16, torch.int64, "float64"):
            yield refused(function, "dtype", "dtype", bad, f"got {bad}", "torch.float32 or torch.float64")
        first = "level" if function == "flicker_noise" else "density"
        yield from parameter(function, first)
    yield from parameter("white_noise", "rate", above=True)
    meta = torch.ones(3, dtype=F64, device="meta")
    rate = torch.ones((), dtype=F64)
    yield refused("white_noise", "rate", "device", rate, "on device cpu", "density is on meta", density=meta)
    yield from parameter("gauss_markov", "correlation_time", above=True, infinite=True)
    yield refused("gauss_markov", "correlation_time", "device", meta, "meta", "cpu")
    for function in _TIMED:
        first = "level" if function == "flicker_noise" else "density"
        yield refused(function, first, "device", meta, "meta", "cpu")
        yield from times(function)
    function, name = "flicker_noise", "correlation_times"
    for bad in (5.0, (1.0,), (1.0, 2.0, 3.0)):
        yield refused(function, name, "type", bad, f"got {bad!r}", "expected the shortest and the longest")
    for bad in ("a", True, T):
        yield refused(function, name, "type", (0.1, bad), f"got {type(bad).__name__}", "expected a number")
    for bad in (0.0, -1.0, NAN, INF):
        yield refused(function, name, "option", (bad, 1.0), f"got {bad}", "above zero")
    yield refused(function, name, "option", (5.0, 0.1), "got (5.0, 0.1)", "the shortest and then the longest")


def times(function: str) -> Iterator[Case]:
    for bad in (None, 0.5, [0.0, 0.2, 0.5], T.numpy()):
        yield refused(function, "t", "type", bad, f"got {type(bad).__name__}", "expected a torch.Tensor")
    for dtype in (torch.int32, torch.float16, torch.bool):
        yield refused(function, "t", "dtype", T.to(dtype), f"got {dtype}", "torch.float32 or torch.float64")
    for bad in (T[:2], T[0], T[None].mT):
        yield refused(function, "t", "shape", bad, f"got {tuple(bad.shape)}", "expected shape (3,) or")
    yield refused(function, "t", "shape", T.expand(4, 3), "got (4, 3)", "broadcasts to (2, 3)")
    for bad in (NAN, INF):
        yield refused(function, "t", "nan", changed(T, 1, bad), f"got {bad}", "finite")
    yield refused(function, "t", "time", T.flip(0), "got 0.5 and then 0.2", "do not decrease")
