"""Figures of inertial readings and their noise."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchspline import checks
from torchspline.imu import AllanDeviation, ImuReading, NoiseEstimate
from torchspline.imu.allan import allan_variance
from torchspline.plot.figure import AXES, new_figure, numbers

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def imu_comparison(
    lines: tuple[Tensor, ImuReading],
    dots: tuple[Tensor, ImuReading] | None = None,
    title: str = "",
    labels: Sequence[str] = ("synthesised", "recorded"),
) -> "Figure":
    """Recorded inertial readings as dots under synthesised lines, as in [S20] Figure 1.

    Args:
        lines, dots: times (N,) in s and readings (N, 3) in rad/s and m/s^2.
        labels: what the lines and the dots are.
    """
    for name, pair in (("lines", lines), ("dots", dots)):
        if pair is not None:
            if not isinstance(pair, tuple) or len(pair) != 2 or not isinstance(pair[1], ImuReading):
                raise TypeError(f"{name}: expected (times, ImuReading), got {type(pair).__name__}")
            checks.is_floating_tensor(f"{name}: times", pair[0])
            if pair[0].shape != pair[1].gyroscope.shape[:1]:
                raise ValueError(
                    f"{name}: expected times of shape {tuple(pair[1].gyroscope.shape[:1])}, got {tuple(pair[0].shape)}"
                )
            checks.has_last(f"{name}: gyroscope", pair[1].gyroscope, 3, "x, y, z")
            checks.has_last(f"{name}: accelerometer", pair[1].accelerometer, 3, "x, y, z")
    figure = new_figure(11, 7)
    panels = figure.subplots(2, 1, sharex=True)
    for axes, sensor, label in (
        (panels[0], "accelerometer", "specific force [m/s²]"),
        (panels[1], "gyroscope", "angular velocity [rad/s]"),
    ):
        for i, name in enumerate(AXES):
            color = f"C{i}"
            if dots is not None:
                axes.plot(
                    numbers(dots[0]), numbers(getattr(dots[1], sensor)[:, i]), ".", color=color, markersize=5,
                    alpha=0.5, markeredgewidth=0, label=f"{name} {labels[1]}",
                )  # fmt: skip
            axes.plot(
                numbers(lines[0]), numbers(getattr(lines[1], sensor)[:, i]), color=color, linewidth=1.2,
                label=f"{name} {labels[0]}",
            )  # fmt: skip
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
    panels[1].set_xlabel("time [s]")
    panels[0].set_title(title)
    panels[0].legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=6, fontsize=8, frameon=False, markerscale=2
    )
    return figure


def allan(
    deviations: Mapping[str, AllanDeviation],
    fits: Mapping[str, NoiseEstimate] | None = None,
    unit: str = "",
    title: str = "",
) -> "Figure":
    """Allan deviations over cluster time with their 95 % bounds, and fits as dashed lines.

    Args:
        deviations: of records (N, C) or batches of them, by name; every channel is a line.
        fits: what `imu.fit_noise` found in those of the same names.
        unit: of the records.
    """
    figure = new_figure(8, 6)
    axes = figure.subplots()
    allan_panel(axes, deviations, fits)
    axes.set_xlabel("cluster time [s]")
    axes.set_ylabel(f"Allan deviation [{unit}]" if unit else "Allan deviation")
    axes.set_title(title)
    return figure


def allan_panel(
    axes: Any, deviations: Mapping[str, AllanDeviation], fits: Mapping[str, NoiseEstimate] | None = None
) -> None:
    """The same on `axes` of Matplotlib, without titles."""
    for name, x in (("deviations", deviations), ("fits", {} if fits is None else fits)):
        if not isinstance(x, Mapping):
            raise TypeError(f"{name}: expected a mapping of names, got {type(x).__name__}")
    for i, (name, found) in enumerate(deviations.items()):
        checks.instance(f"deviations[{name!r}]", found, AllanDeviation, "an AllanDeviation")
        tau = numbers(found.tau)
        curves, lower, upper = (
            numbers(x.transpose(-1, -2).flatten(0, -2)) for x in (found.deviation, *found.bounds(0.95))
        )
        for j, curve in enumerate(curves):
            axes.loglog(tau, curve, color=f"C{i}", linewidth=1.2, label=None if j else name)
            axes.fill_between(tau, lower[j], upper[j], color=f"C{i}", alpha=0.12, linewidth=0)
        if fits and name in fits:
            checks.instance(f"fits[{name!r}]", fits[name], NoiseEstimate, "a NoiseEstimate")
            parts = [
                allan_variance(part, numbers(found.clusters), found.interval) * numbers(x.reshape(-1, 1)) ** 2
                for part, x in fits[name].coefficient.items()
            ]
            for curve in sum(parts) ** 0.5:
                axes.loglog(tau, curve, "--", color=f"C{i}", linewidth=0.8)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
