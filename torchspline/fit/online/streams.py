"""Measurements that keep coming: residuals of one kind become one, and parts of a residual become another."""

import copy
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline.fit.residual import Argument, Clock, Residual, set_weighting
from torchspline.fit.variables import Variable
from torchspline.splines.bspline import BSpline
from torchspline.units import seconds_since

Array = NDArray[Any]
#: What a residual may have for each of its measurements.
_EACH = {"t", "measured", "arguments", "clock", "weighting", "_weights"}


class Stream(NamedTuple):
    """A residual bound to a trajectory, and for its arguments of several which one each measurement sees."""

    residual: Residual
    which: dict[str, Tensor]

    def select(self, chosen: Tensor) -> "Stream":
        """Of some measurements, (N,) bool."""
        old = self.residual
        new = copy.copy(old)
        new.t, new.measured = old.t[..., chosen], old.measured[chosen]
        if old.clock.late is not None:
            new.clock = _with_late(old.clock, old.clock.late[chosen])
        new.arguments = {slot: _of_each(x, chosen) for slot, x in old.arguments.items()}
        kind, x = old.weighting
        if x is not None and _weighs_each(kind, x):
            set_weighting(new, kind, x[chosen])
        return Stream(new, {slot: i[chosen] for slot, i in self.which.items()})

    def join(self, other: "Stream") -> "Stream | None":
        """Both as one; None if more than the measurements differs."""
        first, second = self.residual, other.residual
        if type(first) is not type(second) or set(self.which) != set(other.which):
            return None
        if not _same(_common(first), _common(second)):
            return None
        new = copy.copy(first)
        if not _join_weights(new, first, second):
            return None
        new.t = torch.cat([first.t, second.t], dim=-1)
        new.measured = torch.cat([first.measured, second.measured.to(first.measured)])
        late = first.clock.late, second.clock.late
        if late[0] is not None and late[1] is not None:
            new.clock = _with_late(first.clock, torch.cat([late[0], late[1]]))
        new.arguments = {
            slot: torch.cat([x, second.arguments[slot]]) if _own(x) else x  # type: ignore[list-item]
            for slot, x in first.arguments.items()
        }
        return Stream(new, {slot: torch.cat([i, other.which[slot]]) for slot, i in self.which.items()})


def trajectory_times(residual: Residual, origin: float | int) -> Array:
    """Times of the trajectory at which a residual looks at it, by its clock as it stands now.

    (moments, N), seconds from the origin.
    """
    clock = residual.clock
    t = seconds_since(residual.t.detach().cpu().reshape(type(residual).moments, -1), origin).numpy()
    if not clock.unknowns:
        return t
    offset, skew, delay = (
        0.0 if v is None else float(v.value[0]) for v in (clock.offset, clock.skew, clock.delay)
    )
    mid = 0.0  # matters to a skew only
    if clock.skew is not None:
        if clock.mid is None:
            raise ValueError(
                f"clock: the skew of {residual.name} turns about the middle of the trajectory, which moves in "
                "a window; expected Clock(mid=...)"
            )
        mid = float(seconds_since(torch.as_tensor(clock.mid, dtype=residual.t.dtype), origin))
    late = 0.0 if clock.late is None else delay * clock.late.detach().cpu().numpy()
    return mid + (t - mid - offset - late) / (1.0 + skew)


def variables_of(residual: Residual) -> list[Variable]:
    """The unknowns of a residual besides splines."""
    return [x for x in (*residual.arguments.values(), *residual.clock.unknowns) if isinstance(x, Variable)]


def _with_late(clock: Clock, late: Tensor) -> Clock:
    return Clock(clock.offset, clock.skew, clock.mid, clock.delay, late)


def _of_each(x: Argument, chosen: Tensor) -> Argument:
    return x[chosen] if isinstance(x, Tensor) and _own(x) else x


def _own(x: Any) -> bool:
    """Whether each measurement has its own value of a known argument."""
    return isinstance(x, Tensor) and x.ndim == 2


def _common(residual: Residual) -> dict[str, Any]:
    """What has to agree for two residuals to become one."""
    found = {name: x for name, x in vars(residual).items() if name not in _EACH}
    clock = residual.clock
    found["clock"] = (clock.offset, clock.skew, clock.mid, clock.delay, clock.late is None)
    found["arguments"] = {slot: None if _own(x) else x for slot, x in residual.arguments.items()}
    found["dtype"] = residual.t.dtype
    return found


def _same(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return a.shape == b.shape and a.dtype == b.dtype and np.array_equal(a.detach(), b.detach())
    if type(a) is not type(b) or isinstance(a, (Variable, BSpline)):
        return False
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_same(a[k], b[k]) for k in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if hasattr(a, "__dict__"):  # losses: two of one kind and scale
        return _same(vars(a), vars(b))
    return bool(a == b)


def _weighs_each(kind: str, x: Tensor) -> bool:
    return x.ndim == (2 if kind == "sigma" else 3)


def _join_weights(new: Residual, first: Residual, second: Residual) -> bool:
    """One weight for all where it is the same, else one for each measurement; False where neither goes."""
    (kind, x), (other, y) = first.weighting, second.weighting
    if kind != other or (x is None) != (y is None):
        return False
    if x is None or y is None or (not _weighs_each(kind, x) and _same(x, y)):
        set_weighting(new, kind, x)
        return True
    each = [
        w if _weighs_each(kind, w) else w.expand(len(r), *(w.shape or (1,)))
        for w, r in ((x, first), (y, second))
    ]
    width = max(w.shape[-1] for w in each)
    set_weighting(new, kind, torch.cat([w.expand(*w.shape[:-1], width).to(each[0]) for w in each]))
    return True
