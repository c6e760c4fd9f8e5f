"""Figures of a calibration's report, as PNG files in memory. Matplotlib is imported when one is drawn."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline.calibrate.coverage import CELLS, cells
from torchspline.calibrate.estimate import Calibration, SensorResiduals
from torchspline.imu import ImuReading
from torchspline.plot import imu_comparison
from torchspline.units import NANOSECOND

Array = NDArray[Any]
#: Points that a figure shows of a sensor, at most.
_MOST_POINTS = 4000
#: Length of the excerpt that compares readings, s.
_EXCERPT = 5.0


def residuals_over_time(calibration: Calibration) -> bytes:
    """Root mean square reprojection error of each image, and the residuals of each IMU."""
    panels: list[tuple[str, Callable[[Any], None]]] = []
    zero = calibration.recording.start_ns
    for i, camera in enumerate(calibration.cameras):
        t, rms = _by_image(calibration, i)
        panels.append((f"{camera.name}, RMS of an image [px]", _dots((t - zero) * NANOSECOND, rms)))
    for j, imu in enumerate(calibration.imus):
        stamps = calibration.recording.imus[j].time_ns
        for residuals in (imu.gyroscope, imu.accelerometer):
            seconds = ((stamps[residuals.used] - zero).double() * NANOSECOND).numpy()
            panels.append((f"{residuals.name} [{residuals.unit}]", _axes_over(seconds, residuals)))
    figure, all_axes = _figure(len(panels), 1, (11, 1.9 * len(panels)), sharex=True)
    for axes, (title, draw) in zip(all_axes[:, 0], panels, strict=True):
        draw(axes)
        axes.set_title(title, fontsize=9, loc="left")
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
    all_axes[-1, 0].set_xlabel("time since the first image [s]")
    return _png(figure)


def residuals_over_image(calibration: Calibration) -> bytes:
    """For each camera: corners a cell, and the mean and RMS of reprojection errors in it."""
    figure, all_axes = _figure(len(calibration.cameras), 2, (11, 3.7 * len(calibration.cameras)))
    for i, (found, row) in enumerate(zip(calibration.cameras, all_axes, strict=True)):
        camera = calibration.recording.cameras[i]
        width, height = camera.resolution
        uv = calibration.recording.corners[i].uv[found.residuals.used]
        error, where = found.residuals.values.numpy(), cells(camera, uv).numpy()
        size = CELLS[0] * CELLS[1]
        count = np.bincount(where, minlength=size)
        n = np.maximum(count, 1)
        mean = np.stack([np.bincount(where, e, size) / n for e in error.T])
        rms = np.sqrt(np.bincount(where, (error**2).sum(axis=1), size) / n)
        shape, extent = (CELLS[1], CELLS[0]), (0, width, height, 0)
        seen = np.where(count > 0, count, np.nan).reshape(shape)
        picture = row[0].imshow(seen, extent=extent, cmap="viridis", norm="log", aspect="equal")
        figure.colorbar(picture, ax=row[0], label="corners")
        row[0].set_title(f"{found.name}: corners that took part", fontsize=9, loc="left")
        picture = row[1].imshow(
            np.where(count > 0, rms, np.nan).reshape(shape),
            extent=extent,
            cmap="YlOrRd",
            aspect="equal",
            vmin=0.0,
        )
        figure.colorbar(picture, ax=row[1], label="RMS error [px]")
        x = (np.arange(CELLS[0]) + 0.5) * width / CELLS[0]
        y = (np.arange(CELLS[1]) + 0.5) * height / CELLS[1]
        there = (count > 20).reshape(shape)
        gx, gy = np.meshgrid(x, y)
        lengths = np.hypot(*mean).reshape(shape)[there]
        longest = max(float(np.quantile(lengths, 0.95)) if lengths.size else 0.0, 0.02)
        arrows = row[1].quiver(
            gx[there], gy[there], mean[0].reshape(shape)[there], mean[1].reshape(shape)[there],
            angles="xy", scale_units="xy", scale=longest / (0.8 * width / CELLS[0]), width=0.004,
        )  # fmt: skip
        row[1].quiverkey(
            arrows, 0.85, 1.05, longest, f"mean {longest:.2g} px", labelpos="W", fontproperties={"size": 8}
        )
        row[1].set_title(f"{found.name}: errors over the image", fontsize=9, loc="left")
    return _png(figure)


def distributions(calibration: Calibration) -> bytes:
    """Histograms of residuals in the standard deviations they were weighted with, and the normal density."""
    sensors = [camera.residuals for camera in calibration.cameras]
    for imu in calibration.imus:
        sensors += [imu.gyroscope, imu.accelerometer]
    columns = min(len(sensors), 4)
    rows = -(-len(sensors) // columns)
    figure, all_axes = _figure(rows, columns, (11, 2.6 * rows), sharey=True)
    edges = np.linspace(-5.0, 5.0, 81)
    middle = 0.5 * (edges[1:] + edges[:-1])
    for axes, residuals in zip(all_axes.reshape(-1), sensors, strict=False):
        names = ("u", "v") if residuals.values.shape[1] == 2 else ("x", "y", "z")
        for name, x in zip(names, (residuals.values / residuals.sigma).numpy().T, strict=True):
            density, _ = np.histogram(np.clip(x, edges[0], edges[-1]), edges, density=True)
            axes.step(middle, density, where="mid", label=name, linewidth=1.0)
        axes.plot(
            middle, np.exp(-0.5 * middle**2) / np.sqrt(2.0 * np.pi), "k--", linewidth=0.8, label="normal"
        )
        axes.set_title(
            f"{residuals.name}, σ = {residuals.sigma:.3g} {residuals.unit}", fontsize=8, loc="left"
        )
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    for axes in all_axes.reshape(-1)[len(sensors) :]:
        axes.set_visible(False)
    return _png(figure)


def readings(calibration: Calibration, j: int) -> bytes:
    """Readings of IMU j under what the trajectory says they should be, where it moves most, as [S20] Figure 1."""
    imu, record = calibration.imus[j], calibration.recording.imus[j]
    both = imu.gyroscope.used & imu.accelerometer.used
    t = ((record.time_ns - record.time_ns[0]).double() * NANOSECOND)[both]
    begin = _liveliest(t.numpy(), record.accelerometer[both].numpy())
    shown = (t >= begin) & (t <= begin + _EXCERPT)
    predicted = ImuReading(_predicted(imu.gyroscope, record.gyroscope, both, shown),
                           _predicted(imu.accelerometer, record.accelerometer, both, shown))  # fmt: skip
    measured = ImuReading(record.gyroscope[both][shown], record.accelerometer[both][shown])
    file = io.BytesIO()
    figure = imu_comparison(
        (t[shown], predicted), (t[shown], measured), f"{imu.name}: the {_EXCERPT:g} s of most motion",
        ("estimated", "measured"),
    )  # fmt: skip
    figure.savefig(file, dpi=130)
    return file.getvalue()


def motion(calibration: Calibration) -> bytes:
    """Position and angular velocity of the first IMU, and from where the cameras saw the board."""
    used = calibration.imus[0].gyroscope.used
    t = calibration.recording.imus[0].time_ns[used]
    t = t[:: max(1, len(t) // _MOST_POINTS)]
    with torch.no_grad():
        state = calibration.trajectory.kinematics(t)
    assert state.position is not None
    assert state.angular_velocity is not None
    seconds = ((t - calibration.recording.start_ns).double() * NANOSECOND).numpy()
    figure, all_axes = _figure(1, 3, (11, 3.2))
    for axes, values, title in (
        (all_axes[0, 0], state.position, "position on the board [m]"),
        (all_axes[0, 1], state.angular_velocity, "angular velocity [rad/s]"),
    ):
        for name, x in zip("xyz", values.numpy().T, strict=True):
            axes.plot(seconds, x, linewidth=0.7, label=name)
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_xlabel("time [s]")
        axes.legend(fontsize=7)
    x, y, z = state.position.numpy().T
    all_axes[0, 2].plot(x, y, linewidth=0.5, color="0.4")
    dots = all_axes[0, 2].scatter(x, y, c=z, s=1.5)
    figure.colorbar(dots, ax=all_axes[0, 2], label="z [m]")
    all_axes[0, 2].set_title("path in front of the board, x and y [m]", fontsize=9, loc="left")
    all_axes[0, 2].set_aspect("equal", adjustable="datalim")
    for axes in all_axes[0]:
        axes.grid(alpha=0.3)
    return _png(figure)


# ---------------------------------------------------------------------- parts


def _figure(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=100)
    return file.getvalue()


def _by_image(calibration: Calibration, i: int) -> tuple[Array, Array]:
    """Stamps of images with corners, and the root mean square length of their errors."""
    corners, residuals = calibration.recording.corners[i], calibration.cameras[i].residuals
    frame = corners.frame[residuals.used].numpy()
    squares = residuals.values.square().sum(dim=1).numpy()
    size = len(corners.t_ns)
    count = np.bincount(frame, minlength=size)
    there = count > 0
    return corners.t_ns.numpy()[there], np.sqrt(np.bincount(frame, squares, size)[there] / count[there])


def _dots(x: Array, y: Array) -> Callable[[Any], None]:
    def draw(axes: Any) -> None:
        axes.plot(x, y, ".", markersize=2.5)
        axes.set_ylim(0.0, None)

    return draw


def _axes_over(seconds: Array, residuals: SensorResiduals) -> Callable[[Any], None]:
    def draw(axes: Any) -> None:
        step = max(1, len(seconds) // _MOST_POINTS)
        for name, x in zip("xyz", residuals.values.numpy().T, strict=True):
            axes.plot(seconds[::step], x[::step], linewidth=0.5, alpha=0.8, label=name)
        for side in (-3.0, 3.0):
            axes.axhline(side * residuals.sigma, color="k", linestyle="--", linewidth=0.7)
        axes.legend(fontsize=7, ncols=3, loc="upper right")

    return draw


def _liveliest(t: Array, accelerometer: Array) -> float:
    """Where the stretch of `_EXCERPT` begins in which the accelerometer varies most."""
    change = np.linalg.norm(np.diff(accelerometer, axis=0, prepend=accelerometer[:1]), axis=1)
    total = np.concatenate([[0.0], np.cumsum(change)])
    last = np.searchsorted(t, t + _EXCERPT, side="right")
    whole = t + _EXCERPT <= max(t[-1], t[0] + _EXCERPT)
    return float(t[np.argmax(np.where(whole, total[last] - total[:-1], -1.0))])


def _predicted(residuals: SensorResiduals, measured: Tensor, both: Tensor, shown: Tensor) -> Tensor:
    """Residuals are predictions minus measurements, of the rows that were used."""
    values = torch.full_like(measured, float("nan"))
    values[residuals.used] = residuals.values
    return (measured + values)[both][shown]
