"""Bad arguments of splines whose knots are in nanoseconds, and of going from one family to another."""

from collections.abc import Iterator

import torch
from error_arguments import ACCEPTED, I64, NS, Case, T, refused
from error_online import CASES as OTHER_CASES
from error_online import NOT_APPLICABLE as OTHERS_NOT_APPLICABLE


def nanoseconds(seconds: torch.Tensor) -> torch.Tensor:
    return (seconds * 1e9).round().to(I64)


def clocks() -> Iterator[Case]:
    for function, knots in (("hermite", "times"), ("nonuniform_bspline", "knots"), ("interpolate", "times")):
        whole = nanoseconds(ACCEPTED[function][1][knots])
        for bad in (T, T.float(), NS.int()):
            yield refused(
                function, "t", "dtype", bad, f"got {bad.dtype}", "int64 nanoseconds", **{knots: whole}
            )
        for bad, came in ((NS - 1, "is -1;"), (NS + 499_999_999, "is 500000001;")):
            outside = "outside the domain [0, 500000000] ns"
            yield refused(function, "t", "time", bad, came, outside, **{knots: whole})
        for bad in (whole.flip(0), 0 * whole):
            yield refused(function, knots, "option", bad, "got ", "expected ", t=NS)


NOT_APPLICABLE = OTHERS_NOT_APPLICABLE
CASES = [*OTHER_CASES, *clocks()]
