"""What measurements and a fit disagree in."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.fit import PoseFit
from torchspline.plot.figure import AXES, AXIS_COLORS, new_figure, numbers
from torchspline.units import NANOSECOND

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def residuals(
    fit: PoseFit | Mapping[str, Tensor],
    t: Tensor,
    *,
    title: str = "",
) -> "Figure":
    """Residuals over time, and how they are spread beside a normal distribution of the same width.

    Args:
        fit: of `fit_poses`, or residuals by what they are called: (N,) or (N, C), with their unit in the name, such
            as "gyroscope [rad/s]". NaN is left out.
        t: (N,) times of the measurements, s, or int64 nanoseconds.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """
    if isinstance(fit, PoseFit):
        fit = {
            "position residual [mm]": 1e3 * fit.position_residual,
            "rotation residual [mrad]": 1e3 * fit.rotation_residual,
        }
    if not isinstance(fit, Mapping):
        raise TypeError(
            f"fit: expected a PoseFit or a mapping of names to residuals, got {type(fit).__name__}"
        )
    if not isinstance(t, Tensor):
        raise TypeError(
            f"t: expected a torch.Tensor, got {type(t).__name__}; convert it with torch.as_tensor"
        )
    if not fit:
        raise ValueError("fit: expected at least one residual, got none")
    if t.ndim != 1 or not len(t):
        raise ValueError(f"t: expected shape (N,), N at least 1, got {tuple(t.shape)}")
    for name, x in fit.items():
        checks.is_floating_tensor(f"fit[{name!r}]", x)
        if x.ndim not in (1, 2) or x.shape[0] != len(t):
            raise ValueError(
                f"fit[{name!r}]: expected shape ({len(t)},) or ({len(t)}, C), got {tuple(x.shape)}"
            )
    nanoseconds = t.dtype == torch.int64
    seconds = numbers(t - t[0]) * NANOSECOND if nanoseconds else numbers(t)
    figure = new_figure(11, 0.6 + 2.4 * len(fit))
    panels = figure.subplots(len(fit), 2, squeeze=False, width_ratios=[3, 1], sharey="row")
    for (over, spread), (name, x) in zip(panels, fit.items(), strict=True):
        columns = numbers(x.reshape(len(t), -1)).T
        three = len(columns) == 3
        for i, column in enumerate(columns):
            label, color = (AXES[i], AXIS_COLORS[i]) if three else (str(i), f"C{i}")
            over.plot(
                seconds, column, ".", markersize=2, color=color, label=label if len(columns) > 1 else None
            )
            good = column[np.isfinite(column)]
            if len(good) and np.ptp(good) > 0:
                counts, edges = np.histogram(good, bins=int(np.clip(len(good) ** 0.5, 10, 80)), density=True)
                spread.stairs(counts, edges, orientation="horizontal", color=color)
                grid = np.linspace(edges[0], edges[-1], 200)
                normal = np.exp(-0.5 * ((grid - good.mean()) / good.std()) ** 2) / good.std()
                spread.plot(normal / np.sqrt(2 * np.pi), grid, "--", color=color, linewidth=0.8)
        good = columns[np.isfinite(columns)]
        rms = float(np.sqrt(np.mean(good**2))) if len(good) else float("nan")
        over.set_ylabel(name)
        over.set_title(f"RMS {rms:.4g}", loc="right", fontsize=8)
        over.grid(alpha=0.3)
        over.margins(x=0.01)
        spread.grid(alpha=0.3)
        if len(columns) > 1:
            over.legend(fontsize=7, loc="upper left", ncols=3, markerscale=4)
    panels[-1, 0].set_xlabel("time since start [s]" if nanoseconds else "time [s]")
    panels[-1, 1].set_xlabel("density")
    panels[0, 0].set_title(title, loc="left")
    return figure
