"""What all figures are made with: canvases that need no screen, and the sampling of trajectories."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.splines import Kinematics, Trajectory
from torchspline.units import NANOSECOND

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
AXES = ("x", "y", "z")
#: Colours of body axes and of components along axes.
AXIS_COLORS = ("C3", "C2", "C0")
#: How finely curves are drawn where no times are given.
SAMPLES = 600


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure, inches, that draws without a screen; `figure.savefig(path)` writes it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def numbers(x: Tensor) -> Any:
    """As Matplotlib takes them."""
    return x.detach().to("cpu", torch.float64).numpy()


class Motion(NamedTuple):
    """A trajectory at the times it is drawn at."""

    #: s, those of the trajectory where they are in seconds, else since the first of them.
    seconds: Array
    kinematics: Kinematics
    #: What to write below the axis of time.
    label: str


def named(trajectories: Trajectory | Mapping[str, Trajectory]) -> dict[str, Trajectory]:
    """Trajectories by name; a single one has none."""
    if isinstance(trajectories, Trajectory):
        return {"": trajectories}
    if not isinstance(trajectories, Mapping):
        raise TypeError(
            "trajectories: expected a torchspline.Trajectory or a mapping of names to them, "
            f"got {type(trajectories).__name__}"
        )
    if not trajectories:
        raise ValueError("trajectories: expected at least one, got none")
    for name, x in trajectories.items():
        checks.instance(f"trajectories[{name!r}]", x, Trajectory, "a torchspline.Trajectory")
    return dict(trajectories)


def times_of(trajectory: Trajectory, count: int = SAMPLES) -> Tensor:
    """`count` times from the first to the last of its domain, in the unit it has."""
    first, last = trajectory.domain
    shares = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
    if isinstance(first, int):
        return first + ((last - first) * shares).round().to(torch.int64)
    return (first + (last - first) * shares).clamp(first, last)


def motion_of(trajectory: Trajectory, t: Tensor | None) -> Motion:
    """What is drawn of one trajectory.

    Raises:
        TypeError, ValueError: a batch of trajectories, times of another shape than (N,), or what the trajectory says.
    """
    if t is None:
        t = times_of(trajectory)
    elif not isinstance(t, Tensor):
        raise TypeError(
            f"t: expected a torch.Tensor, got {type(t).__name__}; convert it with torch.as_tensor"
        )
    elif t.ndim != 1 or not len(t):
        raise ValueError(f"t: expected shape (N,), N at least 1, got {tuple(t.shape)}")
    device = next((x.device for x in trajectory.state_dict().values() if isinstance(x, Tensor)), t.device)
    with torch.no_grad():
        found = trajectory.kinematics(t.to(device))
    some = found.rotation if found.position is None else found.position
    assert some is not None
    if some.ndim != 2:
        raise ValueError(
            f"trajectories: expected single trajectories, got a batch of {tuple(some.shape[:-2])}"
        )
    if t.dtype == torch.int64:
        return Motion(numbers(t - t[0]) * NANOSECOND, found, "time since start [s]")
    return Motion(numbers(t), found, "time [s]")


def equal_axes(axes: Any, points: Array) -> None:
    """Axes in metres with the same scale along all three, around `points` (N, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    # A flat motion, or one that stays, still gets a box with a depth.
    half = 0.5 * np.maximum(high - low, 0.2 * max(float((high - low).max()), 1e-3)) * 1.05
    centre = 0.5 * (low + high)
    for name, c, h in zip(AXES, centre, half, strict=True):
        getattr(axes, f"set_{name}lim")(c - h, c + h)
        getattr(axes, f"set_{name}label")(f"{name} [m]")
    axes.set_box_aspect(half)
