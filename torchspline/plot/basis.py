"""Basis functions: how much every key has to say, and when."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups import Rn
from torchspline.plot.figure import SAMPLES, new_figure, numbers
from torchspline.splines import BSpline
from torchspline.splines.interpolation import interpolate
from torchspline.splines.interpolation.registry import SCHEMES, SURVEY

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def basis_functions(method: str | int, times: Tensor, t: Tensor, derivative: int = 0) -> Tensor:
    """How the value at `t` is made of the keys, where keys are numbers: (N, M).

    On numbers every scheme is linear in its keys, so that its basis functions are its curves through the unit vectors;
    on a group the same functions weigh the keys, or the steps between them, in the way of the scheme.

    Args:
        method: a name that `interpolate` takes, or the order of a uniform B-spline with its control points for keys.
        times: (M,) times of the keys, s, increasing; of a uniform B-spline where its control points act most.
        t: (N,) s.
        derivative: 0 to 3, of the functions by time.
    Raises:
        TypeError, ValueError: an unknown method, a wrong type, shape or value, a time outside the domain.
    """
    times = _checked(method, times)
    checks.choice("derivative", derivative, (0, 1, 2, 3))  # type: ignore[arg-type]
    keys = torch.eye(len(times), dtype=torch.float64)[..., None]
    if isinstance(method, int):
        dt = float(times[1] - times[0])
        spline = BSpline(
            keys,
            group=Rn(1),
            order=method,
            dt=dt,
            t0=float(times[0]) + (method - 2) / 2 * dt,
            learnable=False,
        )
        state = spline.evaluate(t, derivatives=derivative)
    else:
        names = {name.lower(): named.scheme for name, named in SURVEY.items()}
        state = interpolate(names.get(method.lower(), method), keys, times, t, derivative, group=Rn(1))
    found = state[derivative]
    assert found is not None
    return found[..., 0].T


def basis(
    method: str | int,
    times: Tensor,
    *,
    cumulative: bool = False,
    title: str = "",
) -> "Figure":
    """Basis functions of a scheme over time; their sum, which is 1, is dashed.

    Args:
        method: a name that `functional.interpolate` takes ("SQUAD", "cumulative_bspline", ...), or the order of a
            uniform B-spline, 2 or more.
        times: (M,) times of the keys, s, increasing; for a B-spline evenly spaced, where its control points act most.
        cumulative: sums over this and all later keys, [S20] (21) and [H18] (15): what weighs the steps between keys.
    Raises:
        TypeError, ValueError: an unknown method, a wrong type, shape or value.
    """
    times = _checked(method, times)
    first, last = float(times[0]), float(times[-1])
    if isinstance(method, int):
        inset = (method - 2) / 2 * float(times[1] - times[0])
        first, last = first + inset, last - inset
    shares = torch.linspace(0.0, 1.0, SAMPLES, dtype=torch.float64)
    t = (first + (last - first) * shares).clamp(first, last)
    weights = basis_functions(method, times, t)
    if cumulative:
        weights = weights.flip(-1).cumsum(-1).flip(-1)
    figure = new_figure(8, 3.6)
    axes = figure.subplots()
    for i, curve in enumerate(numbers(weights).T):
        axes.plot(numbers(t), curve, color=f"C{i % 10}", linewidth=1.4, label=f"{i}")
    if not cumulative:
        axes.plot(numbers(t), numbers(weights.sum(-1)), "--", color="0.5", linewidth=0.8, label="sum")
    axes.plot(numbers(times), 0.0 * numbers(times), "|", color="black", markersize=8)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("cumulative weight" if cumulative else "weight of a key")
    axes.grid(alpha=0.3)
    axes.margins(x=0.01)
    if len(times) <= 12:
        axes.legend(
            fontsize=7, ncols=len(times) + 1, loc="upper center", bbox_to_anchor=(0.5, -0.18), frameon=False
        )
    axes.set_title(title or (f"uniform B-spline of order {method}" if isinstance(method, int) else method))
    return figure


def _checked(method: str | int, times: Tensor) -> Tensor:
    """The times in float64 on the CPU, if they and the method are as they should be."""
    checks.is_floating_tensor("times", times)
    if isinstance(method, bool) or not isinstance(method, (str, int)):
        raise TypeError(f"method: expected a name or the order of a B-spline, got {type(method).__name__}")
    least = 2
    if isinstance(method, int):
        checks.whole("method", method, least=2)
        least = method
    elif method.lower() not in {name.lower() for name in (*SURVEY, *SCHEMES)}:
        raise ValueError(f"method: expected one of {', '.join([*SURVEY, *SCHEMES])}, got {method!r}")
    if times.ndim != 1 or len(times) < least:
        raise ValueError(f"times: expected shape (M,), M at least {least}, got {tuple(times.shape)}")
    checks.finite("times", times)
    times = times.detach().to("cpu", torch.float64)
    steps = times.diff()
    if bool((steps <= 0).any()):
        raise ValueError("times: expected increasing times, got equal or falling ones")
    if isinstance(method, int) and float(steps.max() - steps.min()) > 1e-6 * float(steps.mean()):
        raise ValueError(f"times: expected evenly spaced times for a B-spline, got {times.tolist()}")
    return times
