"""What a trajectory is made of: where its pieces meet, how smoothly, and what they are in between."""

from dataclasses import dataclass
from functools import singledispatch

import torch
from torch import Tensor

from torchspline.splines.bspline import BSpline
from torchspline.splines.hermite import HermiteSpline
from torchspline.splines.interpolation import SCHEMES, SURVEY, KeyframeSpline
from torchspline.splines.nonuniform import NonuniformBSpline
from torchspline.splines.trajectory import Mounted, Trajectory

#: Continuous derivatives where nothing is known to jump.
SMOOTH = 1_000
#: Pieces a trajectory of unknown make is looked at in.
_UNKNOWN = 32
#: Degree of the schemes' polynomials on R^n; None: one less than there are keys.
_DEGREES = {
    "geodesic": 1,
    "linear": 1,
    "squad": 3,
    "composite_bezier": 3,
    "bspline": 3,
    "cumulative_bspline": 3,
    "bezier": None,
    "bernstein": None,
}


@dataclass(frozen=True)
class Pieces:
    """The pieces of a trajectory, on the CPU."""

    #: (S + 1,) increasing: float64 seconds or int64 nanoseconds.
    breaks: Tensor
    #: (S - 1,) int64: how many derivatives are continuous at the inner breaks, SMOOTH if all.
    smooth: Tensor
    #: Of polynomials on R^n; None if they are none.
    degree: int | None
    #: Whether the pieces are geodesics, on any group.
    geodesic: bool = False


def _made(breaks: Tensor, smooth: int, degree: int | None, geodesic: bool = False) -> Pieces:
    breaks = breaks.detach().cpu()
    breaks = breaks if breaks.dtype == torch.int64 else breaks.to(torch.float64)
    return Pieces(breaks, torch.full((len(breaks) - 2,), smooth), degree, geodesic)


def uniform_breaks(start: float | int, end: float | int, count: int) -> Tensor:
    """`count` stretches from start to end: as long as one another, up to a nanosecond for int64 times."""
    if isinstance(start, int) and isinstance(end, int):
        return start + torch.arange(count + 1) * (end - start) // count
    i = torch.arange(count + 1, dtype=torch.float64)
    return torch.lerp(torch.full_like(i, start), torch.full_like(i, end), i / count)


@singledispatch
def pieces(trajectory: Trajectory) -> Pieces:
    """Of a trajectory of any family; a new one adds its case here, else it is looked at in equal stretches."""
    start, end = trajectory.domain
    return _made(uniform_breaks(start, end, _UNKNOWN), SMOOTH, None)


@pieces.register
def _(trajectory: BSpline) -> Pieces:
    segments, order = trajectory.control_points.shape[-2] - trajectory.order + 1, trajectory.order
    i = torch.arange(segments + 1)
    start, end = trajectory.domain
    if trajectory.dt_ns is not None:
        breaks = start + i * trajectory.dt_ns
    else:
        assert trajectory.dt is not None
        breaks = start + i.to(torch.float64) * float(trajectory.dt.detach())
        breaks[-1] = end
    return _made(breaks, order - 2, order - 1, geodesic=order == 2)


@pieces.register
def _(trajectory: NonuniformBSpline) -> Pieces:
    order, count = trajectory.order, trajectory.control_points.shape[-2]
    knots = trajectory.knots.detach().cpu()
    breaks, times = torch.unique_consecutive(knots[order - 1 : count + 1], return_counts=True)
    inner = (order - 1 - times)[1:-1]
    return Pieces(breaks, inner, order - 1, geodesic=order == 2)


@pieces.register
def _(trajectory: HermiteSpline) -> Pieces:
    return _made(trajectory.times, 2, 5)


@pieces.register
def _(trajectory: KeyframeSpline) -> Pieces:
    scheme = scheme_of(trajectory)
    degree = _DEGREES.get(scheme)
    continuity = trajectory.properties.continuity
    if continuity is None:  # one piece over all keys
        return _made(trajectory.times[:: len(trajectory.times) - 1], SMOOTH, len(trajectory.times) - 1)
    straight = scheme == "geodesic" and trajectory.way == "short"
    return _made(trajectory.times, continuity, degree, straight)


@pieces.register
def _(trajectory: Mounted) -> Pieces:
    inner = pieces(trajectory.trajectory)
    # A lever arm turns with the body: nothing of a position's polynomial is left.
    return Pieces(inner.breaks, inner.smooth, None)


def scheme_of(trajectory: KeyframeSpline) -> str:
    """The plain name of its scheme, whatever the survey calls it."""
    return plain_name(trajectory.method)


def plain_name(method: str) -> str:
    """The plain name of a scheme, or an empty one of what is none."""
    names = {name.lower(): named.scheme for name, named in SURVEY.items()}
    return method if method in SCHEMES else names.get(str(method).lower(), "")
