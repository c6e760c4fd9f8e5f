"""Bad arguments of Allan deviations."""

from collections.abc import Iterator

import torch
from error_arguments import F64, INF, NAN, Case, accept, changed, refused, tensor

from torchspline import imu

RECORD = torch.randn(2, 40, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
TIMES = torch.arange(40, dtype=F64)
DEVIATION = imu.allan_deviation(RECORD, TIMES)
NAMES = ("white_noise", "random_walk")
accept(
    {
        "allan_deviation": (imu.allan_deviation, {"x": RECORD, "t": TIMES, "clusters": [1, 2]}),
        "AllanDeviation.bounds": (DEVIATION.bounds, {"confidence": 0.9}),
        "fit_noise": (imu.fit_noise, {"allan": DEVIATION, "components": NAMES, "tau": (1.0, 10.0)}),
    }
)
_DONE = "AllanDeviation.bounds fit_noise"
#: What is made and handed out.
RESULTS = {"AllanDeviation", "NoiseEstimate"}
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "shape": {"computed before": _DONE},
    "dtype": {"computed before": _DONE},
    "device": {"computed on the CPU": _DONE},
    "zero quaternion": {"records": f"allan_deviation {_DONE}"},
    "time": {"no times": _DONE},
    "count": {"one number": "AllanDeviation.bounds"},
}


def cases() -> Iterator[Case]:
    function = "allan_deviation"
    for case in tensor(function, "x", "", like=RECORD):
        if case.category in ("type", "dtype"):
            yield case
    yield refused(function, "x", "shape", RECORD[0, 0], "got (3,)", "(*batch, N, C)")
    yield refused(function, "x", "count", RECORD[:, :2], "got (2, 2, 3)", "at least 3 samples")
    yield refused(function, "x", "nan", changed(RECORD, (0, 1, 2), INF), "got inf", "NaN for missing ones")
    for bad in (None, 0.5, TIMES.numpy()):
        yield refused(function, "t", "type", bad, f"got {type(bad).__name__}", "expected a torch.Tensor")
    yield refused(function, "t", "dtype", TIMES.to(torch.int32), "torch.int32", "torch.float64")
    yield refused(function, "t", "device", TIMES.to("meta"), "meta", "cpu")
    for bad in (TIMES[:5], TIMES.expand(2, 40)):
        yield refused(function, "t", "shape", bad, f"got {tuple(bad.shape)}", "expected shape (40,)")
    yield refused(function, "t", "nan", changed(TIMES, 1, NAN), "got nan", "finite")
    yield refused(function, "t", "time", TIMES.flip(0), "got 39.0 and then 38.0", "increasing times")
    bad = TIMES.clone()
    bad[20:] += 0.5
    yield refused(
        function, "t", "time", bad, "got 1.5 s between samples 19 and 20", "multiples of one interval"
    )
    for bad in (5, "12", torch.tensor([1])):
        yield refused(function, "clusters", "type", bad, f"got {type(bad).__name__}", "whole numbers")
    for bad in (0, 1.0, True):
        yield refused(function, "clusters", "option", [bad], f"got {bad!r}", "whole number of at least 1")
    yield refused(function, "clusters", "option", [1, 21], "got 21", "half the 40 samples")
    yield refused(function, "clusters", "option", [], "got none", "at least one")
    holes = changed(RECORD, (slice(None), slice(None, None, 3)), NAN)
    yield refused(function, "clusters", "count", [1, 2], "got 2 samples, 2 s", "between gaps", x=holes)

    function = "AllanDeviation.bounds"
    for bad in (None, "a", True):
        yield refused(function, "confidence", "type", bad, f"got {type(bad).__name__}", "expected a number")
    for bad in (0.0, 1.0, NAN, -1.0):
        yield refused(function, "confidence", "nan", bad, f"got {bad}", "between 0 and 1")

    function = "fit_noise"
    yield refused(function, "allan", "type", RECORD, "got Tensor", "an AllanDeviation")
    yield refused(
        function, "components", "option", ["walk"], "got 'walk'", "'white_noise', 'bias_instability'"
    )
    for bad in ((), ("white_noise", "white_noise")):
        yield refused(function, "components", "option", bad, f"got {bad!r}", "different names")
    for bad in (1.0, (1.0,)):
        yield refused(function, "tau", "type", bad, f"got {bad!r}", "the shortest and the longest")
    for bad in (0.0, NAN):
        yield refused(function, "tau", "nan", (bad, 1.0), f"got {bad}", "above zero")
    yield refused(function, "tau", "count", (0.5, 2.5), "got 2", "more cluster times than components (2)")
