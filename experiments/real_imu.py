"""From poses to an IMU's signal, checked against the IMU that was there: fit, align, synthesise, compare.

For each recording a spline goes through the poses, the IMU's clock, mounting and biases are found from scratch, and the
readings synthesised at the IMU's own stamps are compared with the recorded, unfiltered ones. The yardstick is a SciPy
least-squares spline at four knot spacings; `auto` chooses a spacing from the poses alone. Offsets of the clocks are
found from each half of a recording by itself: they have to agree.
"""

import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch
from common import ROOT, Table, run, save, show
from matplotlib.figure import Figure
from recordings.load import YARDSTICK, Recording, load, longest_stretch, near_gaps

from torchspline import BSpline, fit_poses
from torchspline.fit import Alignment, align_imu
from torchspline.imu import measure
from torchspline.units import SECOND

SPACINGS = (20, 40, 80, 160)
#: Left out at both ends of a window, and its length at most.
MARGIN, LONGEST = 3 * SECOND // 10, 60 * SECOND
#: How far apart the halves may be, s.
AGREEMENT = 3e-4


class Compared(NamedTuple):
    """RMSE [rad/s, m/s^2] at one spacing, and how it came about."""

    gyro: float
    accel: float
    alignment: Alignment
    spacing: float
    seconds: float
    notes: list[str]


def compare(recording: Recording, spacing: float | str, alignment: Alignment | None = None) -> Compared:
    """Fit, align (unless that is done), synthesise and compare, within the longest stretch of poses without a gap."""
    start, stop = longest_stretch(recording.poses)
    poses, samples = recording.poses.window(start, stop), recording.samples
    began = time.perf_counter()
    pose = torch.cat([poses.position, poses.rotation], -1)
    dt = spacing if isinstance(spacing, str) else 1e-3 * spacing
    fit = fit_poses(poses.time_ns, pose, dt=dt, progress=False)
    notes = list(fit.notes)
    if alignment is None:
        alignment = align_imu(fit.trajectory, samples.time_ns, samples.gyroscope, samples.accelerometer)
        notes += alignment.notes
    gyro, accel = errors(fit.trajectory, recording, alignment, start, min(stop, start + LONGEST))
    seconds = time.perf_counter() - began
    assert fit.trajectory.dt_ns is not None
    return Compared(gyro, accel, alignment, fit.trajectory.dt_ns / SECOND, seconds, notes)


def best_alignment(recording: Recording, spacings: list[int]) -> Alignment | None:
    """That with the trajectory whose knots suit the recording best: noise and missed motion spoil the others."""
    found = []
    for spacing in spacings:
        try:
            found.append(compare(recording, spacing).alignment)
        except ValueError:  # so wide that the trajectory has little in common with the readings
            continue
    return min(found, key=lambda a: a.gyro_rms * (a.accel_rms or 0.0), default=None)


def errors(
    trajectory: BSpline, recording: Recording, alignment: Alignment, start: int, stop: int
) -> tuple[float, float]:
    """RMSE between recorded and synthesised readings, pooled over samples and axes."""
    samples = recording.samples
    assert alignment.gravity is not None
    rmse = []
    for sensor, recorded in (("gyro", samples.gyroscope), ("accel", samples.accelerometer)):
        t = alignment.pose_time(samples.time_ns, sensor=sensor)
        inside = (t >= start + MARGIN) & (t <= stop - MARGIN)
        with torch.no_grad():
            made = measure(
                trajectory,
                t[inside],
                gravity=alignment.gravity,
                gyroscope_bias=alignment.gyro_bias,
                accelerometer_bias=alignment.accel_bias,
                T_body_imu=alignment.T_body_imu,
            )
        error = recorded[inside] - (made.gyroscope if sensor == "gyro" else made.accelerometer)
        rmse.append(math.sqrt(error.square().nanmean().item()))
    return rmse[0], rmse[1]


def halves(recording: Recording) -> dict[str, Any]:
    """Time offsets of the two halves of a whole recording, each found by itself, with and without a skew.

    Without a skew each is the offset in the middle of its half; with one, that in the middle of the recording.
    """
    fit = fit_poses(recording.poses.time_ns, recording.pose, dt="auto", progress=False)
    samples = recording.samples
    first, last = fit.trajectory.domain
    middle = (first + last) // 2
    whole = align_imu(fit.trajectory, samples.time_ns, *_kept(recording, None))
    on_poses = whole.pose_time(samples.time_ns)
    offsets: dict[str, list[float]] = {"constant": [], "drifting": []}
    deviations: dict[str, list[float]] = {"constant": [], "drifting": []}
    middles = []
    for part in (on_poses < middle, on_poses >= middle):
        for kind in offsets:
            a = align_imu(
                fit.trajectory, samples.time_ns, *_kept(recording, part), estimate_skew=kind == "drifting"
            )
            away = (middle - a.t_mid) / SECOND
            offsets[kind].append(a.time_offset + a.clock_skew * away)
            skew = a.std.get("clock_skew", 0.0)
            assert isinstance(skew, float)
            assert isinstance(a.std["time_offset"], float)
            deviations[kind].append(math.hypot(a.std["time_offset"], skew * away))
            if kind == "constant":
                middles.append(a.t_mid / SECOND)
    apart = {kind: x[1] - x[0] for kind, x in offsets.items()}
    return {
        "offsets_s": offsets,
        "standard_deviations_s": deviations,
        "apart_s": apart,
        "seconds_apart": middles[1] - middles[0],
        "needs_skew": abs(apart["constant"]) > AGREEMENT,
        "skew": whole.clock_skew,
        "skew_standard_deviation": whole.std["clock_skew"],
        "time_offset_s": whole.time_offset,
        "accelerometer_delay_s": whole.accel_delay,
        "accelerometer_delay_standard_deviation_s": whole.std["accel_delay"],
        "lever_arm_m": whole.lever_arm,
        "rotation_imu_body": whole.rotation_imu_body,
    }


def judge(clocks: dict[str, dict[str, Any]]) -> None:
    """Adds how far the halves are apart if the clocks drift as in the other recordings with the same devices.

    Those know the drift better than half a recording does, whose offset has to be carried to the middle of the whole;
    and they know it independently.
    """
    for name, x in clocks.items():
        others = [
            y for other, y in clocks.items() if other != name and other.split("/")[0] == name.split("/")[0]
        ]
        if others:
            weights = [y["skew_standard_deviation"] ** -2 for y in others]
            skew = sum(w * y["skew"] for w, y in zip(weights, others, strict=True)) / sum(weights)
            x["apart_s"]["drifting as others"] = x["apart_s"]["constant"] - skew * x["seconds_apart"]
        x["agree"] = min(map(abs, x["apart_s"].values())) <= AGREEMENT


def _kept(recording: Recording, part: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Readings away from gaps of the poses, of one part; the others are NaN."""
    samples = recording.samples
    left_out = near_gaps(recording.poses, samples.time_ns)
    if part is not None:
        left_out = left_out | ~part
    gyro, accel = (
        x.masked_fill(left_out[:, None], math.nan) for x in (samples.gyroscope, samples.accelerometer)
    )
    return gyro, accel


def best(name: str) -> tuple[float, float]:
    """The yardstick's smallest RMSE of each sensor."""
    gyro, accel = zip(*YARDSTICK[name], strict=True)
    return min(gyro), min(accel)


def tables(found: dict[str, dict[str, Any]], spacings: list[int]) -> list[Table]:
    accuracy, clocks = [], []
    for name, x in found.items():
        yard = best(name) if name in YARDSTICK else None
        auto: Compared = x["auto"]
        cells = []
        for spacing in spacings:
            c: Compared = x[spacing]
            their = YARDSTICK[name][SPACINGS.index(spacing)] if yard and spacing in SPACINGS else None
            cells.append(f"{c.gyro:.4f} / {c.accel:.3f}" + (f" ({their[0]} / {their[1]})" if their else ""))
        verdict = "-"
        if yard:
            verdict = "yes" if auto.gyro <= yard[0] * 1.005 and auto.accel <= yard[1] * 1.005 else "NO"
        reach = f"{yard[0]} / {yard[1]}" if yard else "-"
        accuracy.append(
            (name, *cells, f"{auto.gyro:.4f} / {auto.accel:.3f}", f"{auto.spacing * 1e3:.3g}", reach, verdict,
             f"{auto.seconds:.1f}")
        )  # fmt: skip
        h = x["halves"]
        clocks.append(
            (
                name,
                f"{h['time_offset_s'] * 1e3:+.3f}",
                f"{h['skew'] * 1e6:+.1f} ± {h['skew_standard_deviation'] * 1e6:.1f}",
                f"{h['apart_s']['constant'] * 1e3:+.3f}",
                f"{h['apart_s']['drifting'] * 1e3:+.3f}",
                f"{h['apart_s']['drifting as others'] * 1e3:+.3f}" if len(h["apart_s"]) > 2 else "-",
                f"{h['accelerometer_delay_s'] * 1e3:+.2f} ± {h['accelerometer_delay_standard_deviation_s'] * 1e3:.2f}",
                "yes" if h["needs_skew"] else "no",
                "yes" if h["agree"] else "NO",
            )
        )
    header = ["recording", *(f"{s} ms (yardstick)" for s in spacings), "auto", "knots [ms]", "yardstick's best",
              "reached", "time [s]"]  # fmt: skip
    clock_header = ["recording", "offset [ms]", "skew [1e-6]", "halves apart [ms]", "apart with skew [ms]",
                    "with that of the others [ms]", "accelerometer later by [ms]",
                    "needs skew", "agree to 0.3 ms"]  # fmt: skip
    return [
        Table("Gyroscope [rad/s] / accelerometer [m/s²], RMSE", header, accuracy),
        Table("Clocks", clock_header, clocks),
    ]


def figure(found: dict[str, dict[str, Any]], spacings: list[int]) -> Figure:
    drawn = Figure(figsize=(11, 7), layout="constrained")
    axes = drawn.subplots(1, 3, sharey=True, width_ratios=(2, 2, 1.4))
    names = list(found)
    rows = range(len(names))
    for axis, sensor in zip(axes, ("gyro", "accel"), strict=False):
        for column in (*spacings, "auto"):
            scale = [
                best(n)[sensor == "accel"] if n in YARDSTICK else getattr(found[n]["auto"], sensor)
                for n in names
            ]
            ratio = [getattr(found[n][column], sensor) / s for n, s in zip(names, scale, strict=True)]
            auto = column == "auto"
            axis.plot(
                ratio, rows, "k*" if auto else "o", markersize=11 if auto else 6,
                label=column if auto else f"{column} ms", alpha=1.0 if auto else 0.7,
            )  # fmt: skip
        axis.axvline(1.0, color="0.4", linewidth=1)
        axis.set_xscale("log")
        ticks = [x for x in (1, 2, 5, 10, 20, 50) if axis.get_xlim()[0] <= x <= axis.get_xlim()[1]]
        axis.set_xticks(ticks, list(map(str, ticks)))
        axis.set_xticks([], minor=True)
        axis.set_title({"gyro": "gyroscope", "accel": "accelerometer"}[sensor])
        axis.set_xlabel("RMSE / yardstick's best")
        axis.grid(alpha=0.3, which="both")
    axes[0].legend()
    axes[0].set_yticks(list(rows), [n.replace("_undisturbed", "").replace("_", " ") for n in names])
    axes[0].invert_yaxis()
    labels = {"constant": "offset", "drifting": "offset and skew", "drifting as others": "skew of the others"}
    for (kind, label), marker in zip(labels.items(), "o*x", strict=True):
        apart = [1e3 * found[n]["halves"]["apart_s"].get(kind, math.nan) for n in names]
        axes[2].plot(apart, rows, marker, label=label)
    axes[2].axvspan(-1e3 * AGREEMENT, 1e3 * AGREEMENT, color="0.9")
    axes[2].set(xlabel="second half minus first [ms]", title="time offset")
    axes[2].grid(alpha=0.3)
    axes[2].legend()
    return drawn


def experiment(out: Path, data: str, recordings: list[str], spacings: list[int], seed: int) -> dict[str, Any]:
    """Synthesise IMU readings from the poses of real recordings and compare them with those recorded.

    Args:
        out: folder for the results.
        data: folder of the recordings, from the root of the project.
        recordings: those to compare; "synthetic" needs no data.
        spacings: of the knots, ms, tried besides the automatic one.
        seed: of the synthetic recording.
    """
    found: dict[str, dict[str, Any]] = {}
    compare(load(ROOT / data, "synthetic", seed), "auto")  # compiles what is compiled once
    for name in recordings:
        recording = load(ROOT / data, name, seed)
        x: dict[Any, Any] = {"auto": compare(recording, "auto")}
        alignment = best_alignment(recording, spacings) or x["auto"].alignment
        x.update((spacing, compare(recording, spacing, alignment)) for spacing in spacings)
        x["halves"] = halves(recording)
        found[name] = x
        a = x["auto"]
        print(f"{name}: {a.gyro:.4f} rad/s, {a.accel:.3f} m/s² in {a.seconds:.1f} s", flush=True)
    judge({name: x["halves"] for name, x in found.items()})
    show(out, tables(found, spacings))
    save(figure(found, spacings), out / "real_imu.png")
    return {
        name: {
            "rmse": {
                str(column): {
                    "gyroscope_rad_s": x[column].gyro,
                    "accelerometer_m_s2": x[column].accel,
                    "knot_spacing_s": x[column].spacing,
                    "seconds": x[column].seconds,
                    "notes": x[column].notes,
                }
                for column in ("auto", *spacings)
            },
            "yardstick_best": best(name) if name in YARDSTICK else None,
            "clock": x["halves"],
        }
        for name, x in found.items()
    }


if __name__ == "__main__":
    run(experiment, smoke={"recordings": ["synthetic"], "spacings": [80]})
