"""Simulated noise beside that of real IMUs: power spectra and Allan deviations drawn over each other.

Two kinds of records. At rest, a record is noise and nothing else: its parameters are fitted to the Allan deviation and
noise with those parameters is simulated. Where an IMU never rests, the motion fitted to the poses is subtracted; what
remains is noise and whatever the poses do not tell, so the same is done to a twin: the fitted motion, simulated poses
and readings with the noise of the data sheet, fitted and subtracted in the same way.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import ROOT, Table, run, save, show
from matplotlib.figure import Figure
from recordings.load import Recording, load, longest_stretch
from scipy.signal import welch
from torch import Tensor

from torchspline import SO3, fit_poses
from torchspline.fit import align_imu
from torchspline.imu import (
    AllanDeviation,
    NoiseEstimate,
    allan_deviation,
    fit_noise,
    item_generator,
    measure,
    random_walk,
    white_noise,
)
from torchspline.imu.noise import flicker_noise
from torchspline.io import ImuRecord, PoseRecord
from torchspline.plot import allan_panel
from torchspline.units import SECOND

SENSORS = ("gyroscope", "accelerometer")
UNITS = {"gyroscope": "rad/s", "accelerometer": "m/s²"}
#: A window is quiet if neither sensor scatters more than this many times as much as in its quietest one; s.
QUIET, WINDOW = 2.0, 0.25
#: Left out at both ends, and the length at most, of records with motion; ns.
MARGIN, LONGEST = 3 * SECOND // 10, 60 * SECOND
#: Share of half the rate whose spectrum is the floor: above all motion.
FLOOR = (0.8, 0.95)


class Record(NamedTuple):
    """Of one sensor: times (N,) s and what it read without motion (N, 3), beside the simulated (N, 3)."""

    t: Tensor
    real: Tensor
    made: Tensor
    estimate: NoiseEstimate | None


def quiet_stretch(samples: ImuRecord) -> slice:
    """The longest quiet stretch."""
    per = max(2, round(WINDOW * SECOND / samples.time_ns.diff().double().median().item()))
    count = len(samples) // per
    quiet = torch.ones(count, dtype=torch.bool)
    for x in (samples.gyroscope, samples.accelerometer):
        spread = x[: count * per].view(count, per, 3).std(1).norm(dim=-1)
        quiet &= spread < QUIET * spread.min()
    edges = torch.nonzero(torch.cat([torch.tensor([False]), quiet, torch.tensor([False])]).diff()).flatten()
    start, stop = max(edges.view(-1, 2).tolist(), key=lambda piece: piece[1] - piece[0])
    # A window at either edge may hold some of what comes next.
    return slice((start + 1) * per, max(stop - 1, start + 2) * per)


def at_rest(recording: Recording, seed: int) -> dict[str, Record]:
    samples = recording.samples
    piece = quiet_stretch(samples)
    stamps = samples.time_ns[piece]
    t = (stamps - stamps[0]).double() / SECOND
    found = {}
    for i, sensor in enumerate(SENSORS):
        x = getattr(samples, sensor)[piece]
        real = x - x.mean(0)
        estimate = fit_noise(allan_deviation(real, t))
        made = simulated(t, estimate.coefficient, item_generator(seed, i))
        found[sensor] = Record(t, real, made, estimate)
    return found


def simulated(t: Tensor, coefficient: dict[str, Tensor], generator: torch.Generator) -> Tensor:
    """Noise of three channels with the coefficients that a fit has found."""
    shape, rate = (len(t), 3), (len(t) - 1) / (t[-1] - t[0]).item()
    return (
        white_noise(shape, coefficient["white_noise"], rate, generator)
        + flicker_noise(shape, coefficient["bias_instability"], t, generator)
        + random_walk(shape, coefficient["random_walk"], t, generator)
    )


def without_motion(recording: Recording, spacing: int, sheet: list[float], seed: int) -> dict[str, Record]:
    """What poses do not tell of the readings, and the same of a twin with the noise of the data sheet."""
    start, stop = longest_stretch(recording.poses)
    poses = recording.poses.window(start, min(stop, start + LONGEST))
    motion, t, real, scatter = residual(poses, recording.samples, spacing)
    seconds = (t - t[0]).double() / SECOND

    generator = item_generator(seed, 0)
    exact = motion(poses.time_ns)
    noise = torch.randn(len(poses), 6, generator=generator, dtype=torch.float64)
    twin_poses = PoseRecord(
        poses.time_ns,
        exact[:, :3] + scatter[0] * noise[:, :3],
        SO3.retract(exact[:, 3:], scatter[1] * noise[:, 3:], side="right"),
    )
    reading = measure(motion, t)
    rate = (len(t) - 1) / seconds[-1].item()
    read = [
        x + white_noise(x.shape, density, rate, generator) + random_walk(x.shape, walk, seconds, generator)
        for x, density, walk in zip(reading, sheet[::2], sheet[1::2], strict=True)
    ]
    _, twin_t, made, _ = residual(twin_poses, ImuRecord(t, read[0], read[1]), spacing)
    count = min(len(t), len(twin_t))  # alignment may move the ends by a sample
    return {
        sensor: Record(seconds[:count], real[i][:count], made[i][:count], None)
        for i, sensor in enumerate(SENSORS)
    }


def residual(
    poses: PoseRecord, samples: ImuRecord, spacing: int
) -> tuple[Any, Tensor, list[Tensor], list[float]]:
    """The fitted motion, stamps on its clock, what the readings differ by, and the scatter of position and rotation."""
    pose = torch.cat([poses.position, poses.rotation], -1)
    fit = fit_poses(poses.time_ns, pose, dt=1e-3 * spacing, progress=False)
    motion = fit.trajectory.requires_grad_(False)
    alignment = align_imu(motion, samples.time_ns, samples.gyroscope, samples.accelerometer)
    on_poses = alignment.pose_time(samples.time_ns)
    first, last = motion.domain
    inside = (on_poses >= first + MARGIN) & (on_poses <= last - MARGIN)
    assert alignment.gravity is not None
    made = measure(motion, on_poses[inside], alignment.gravity, alignment.gyro_bias, alignment.accel_bias,
                   alignment.T_body_imu)  # fmt: skip
    left = [x[inside] - y for x, y in zip((samples.gyroscope, samples.accelerometer), made, strict=True)]
    at = motion(poses.time_ns)
    position = (at[:, :3] - poses.position).square().nanmean().sqrt().item()
    rotation = SO3.log(SO3.between(at[:, 3:], poses.rotation)).square().nanmean().sqrt().item()
    return motion, on_poses[inside], left, [position, rotation]


def spectrum(t: Tensor, x: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Square root of the two-sided density, the density of white noise; pieces of a second or a quarter of all."""
    rate = (len(t) - 1) / (t[-1] - t[0]).item()
    f, power = welch(x.numpy(), rate, nperseg=min(len(t) // 4, round(rate)), axis=0)
    return f[1:], np.sqrt(0.5 * power[1:])


def floor(t: Tensor, x: Tensor) -> float:
    """Density of white noise that the upper end of the spectrum is, root mean square over axes."""
    f, density = spectrum(t, x)
    band = (f > FLOOR[0] * f[-1]) & (f < FLOOR[1] * f[-1])
    return math.sqrt(np.mean(density[band] ** 2))


def figure(
    found: dict[str, dict[str, Record]], deviations: dict[str, dict[str, dict[str, AllanDeviation]]]
) -> Figure:
    drawn = Figure(figsize=(19, 3.6 * len(found)), layout="constrained")
    panels = drawn.subplots(len(found), 4, squeeze=False)
    for row, (name, records) in zip(panels, found.items(), strict=True):
        for i, (sensor, record) in enumerate(records.items()):
            left, right = row[2 * i : 2 * i + 2]
            for j, (label, x) in enumerate((("real", record.real), ("simulated", record.made))):
                f, density = spectrum(record.t, x)
                left.loglog(f, density, color=f"C{j}", linewidth=0.8, alpha=0.75)
                left.plot([], [], color=f"C{j}", label=label)
            unit = UNITS[sensor]
            left.set(title=f"{name}: {sensor}", xlabel="frequency [Hz]", ylabel=f"density [{unit}/√Hz]")
            left.grid(alpha=0.3, which="both")
            left.legend(fontsize=8)
            allan_panel(right, deviations[name][sensor])
            right.set(xlabel="cluster time [s]", ylabel=f"Allan deviation [{unit}]")
    return drawn


def experiment(
    out: Path,
    data: str,
    rest: list[str],
    moving: list[str],
    data_sheets: dict[str, list[float]],
    spacing: int,
    seed: int,
) -> dict[str, Any]:
    """Noise of real records beside simulated noise, and its parameters beside those of data sheets.

    Args:
        data: folder of the recordings, from the root of the project; "synthetic" needs none.
        rest: recordings with a quiet stretch. moving: recordings whose motion is subtracted.
        data_sheets: by the beginning of a recording's name, the densities of white noise and random walk of the
            gyroscope, rad/s/√Hz and rad/s²/√Hz, then those of the accelerometer, m/s²/√Hz and m/s³/√Hz.
        spacing: knots of the fitted motion, ms.
        seed: of the simulated noise.
    """
    folder = ROOT / data
    found, rows, figures = {}, [], {}
    for i, name in enumerate([*rest, *moving]):
        recording = load(folder, name, seed)
        sheet = next((x for start, x in data_sheets.items() if name.startswith(start)), None)
        if name in rest:
            found[name] = at_rest(recording, seed + i)
        else:
            assert sheet is not None, f"{name}: its data sheet is needed for the twin"
            with torch.no_grad():
                found[name] = without_motion(recording, spacing, sheet, seed + i)
        figures[name] = {}
        for j, (sensor, record) in enumerate(found[name].items()):
            figures[name][sensor] = summary(record, None if sheet is None else sheet[2 * j : 2 * j + 2])
            rows.append(line(name, sensor, name in rest, figures[name][sensor]))
    deviations = {
        name: {
            sensor: {"real": allan_deviation(r.real, r.t), "simulated": allan_deviation(r.made, r.t)}
            for sensor, r in records.items()
        }
        for name, records in found.items()
    }
    header = ["recording", "sensor", "record", "s", "white noise", "sheet", "real / simulated", "floor real",
              "floor simulated", "bias instability", "random walk", "sheet"]  # fmt: skip
    units = "gyroscope rad/s, accelerometer m/s²; white noise and floor /√Hz, random walk /√s"
    show(out, [Table(f"Noise ({units})", header, rows)])
    shown = {name: x for name, x in found.items() if not name.startswith("broad") or name == rest[-1]}
    save(figure(shown, deviations), out / "real_noise.png")
    return figures


def summary(record: Record, sheet: list[float] | None) -> dict[str, Any]:
    """Figures of one sensor; densities over the axes are root mean squares."""

    def mean(x: Tensor) -> float:
        return x.square().mean().sqrt().item()

    result: dict[str, Any] = {
        "seconds": record.t[-1].item(),
        "floor": floor(record.t, record.real),
        "floor_simulated": floor(record.t, record.made),
        "rms": mean(record.real),
        "rms_simulated": mean(record.made),
        "data_sheet": sheet,
    }
    if record.estimate is not None:
        again = fit_noise(allan_deviation(record.made, record.t))
        for name, value in record.estimate.coefficient.items():
            result[name] = {
                "axes": value,
                "std": record.estimate.std[name],
                "mean": mean(value),
                "mean_std": mean(record.estimate.std[name]) / math.sqrt(3),
                "simulated": mean(again.coefficient[name]),
            }
    return result


def line(name: str, sensor: str, resting: bool, x: dict[str, Any]) -> tuple[Any, ...]:
    sheet = x["data_sheet"]
    white, flicker, walk = (
        f"{x[key]['mean']:.2e} ± {x[key]['mean_std']:.0e}" if key in x else "-"
        for key in ("white_noise", "bias_instability", "random_walk")
    )
    return (
        name.partition("_undisturbed")[0], sensor, "rest" if resting else "residual", f"{x['seconds']:.1f}", white,
        f"{sheet[0]:.2e}" if sheet else "-", f"{x['rms'] / x['rms_simulated']:.2f}", f"{x['floor']:.2e}",
        f"{x['floor_simulated']:.2e}", flicker, walk, f"{sheet[1]:.2e}" if sheet else "-",
    )  # fmt: skip


if __name__ == "__main__":
    run(experiment, smoke={"rest": [], "moving": ["synthetic"]})
