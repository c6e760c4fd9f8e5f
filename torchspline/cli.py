"""The command line: `torchspline demo`, `imu`, `body`, `generate`, `calibrate camera-imu`, `kernels show`."""

import json
import math
import sys
from itertools import pairwise
from pathlib import Path
from typing import Literal

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torchspline.calibrate.command import COMMAND, camera_imu, run
from torchspline.cli_body import body
from torchspline.fit import PoseFit, fit_poses
from torchspline.generate.command import generate
from torchspline.groups import SO3, Group
from torchspline.imu import STANDARD_GRAVITY, ImuReading, measure
from torchspline.io import ImuRecord, PoseRecord, read_imu, read_poses, write_imu, write_poses
from torchspline.plot import imu_comparison
from torchspline.splines import SplitBSpline, Trajectory
from torchspline.splines.fused import kernels_of, triton_kernels_of

_NS = 1_000_000_000
_console = Console()


def demo(out: Path = Path("torchspline-demo"), duration: float = 20.0, seed: int = 0) -> int:
    """From a known motion to noisy poses, a fitted spline and its IMU signal, checked against the truth.

    Args:
        out: folder for the results; made if it is not there.
        duration: length of the motion, s.
        seed: of the random motion and noise.
    """
    if duration < 2.0:
        raise ValueError(f"duration: expected at least 2 s, got {duration}")
    out.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator().manual_seed(seed)
    truth = _random_motion(duration, generator)
    position_noise, rotation_noise = 1e-4, 5e-4
    stamps = torch.arange(0, int(duration * _NS), _NS // 120)
    exact = truth(stamps)
    noise = torch.randn(len(stamps), 6, generator=generator, dtype=torch.float64)
    rotations = SO3.retract(exact[:, 3:], rotation_noise * noise[:, 3:], side="right")
    poses = PoseRecord(stamps, exact[:, :3] + position_noise * noise[:, :3], rotations, "demo")

    spacing = 0.1
    fit = fit_poses(stamps, torch.cat([poses.position, poses.rotation], -1), dt=spacing)
    margin = int(0.3 * _NS)
    times = torch.arange(margin, int(stamps[-1]) - margin, _NS // 200)
    with torch.no_grad():
        ideal, made = measure(truth, times), measure(fit.trajectory, times)
    errors = _rmse(made, ideal.gyroscope, ideal.accelerometer)
    # Twice what seeds 0 to 5 give: noise of the poses, differentiated once and twice by a spline of this spacing.
    allowed = (0.006, 0.03)
    passed = errors[0] <= allowed[0] and errors[1] <= allowed[1]

    write_poses(out / "poses.txt", poses)
    _write_results(out, fit.trajectory, times, made)
    write_imu(out / "imu_truth.csv", ImuRecord(times, ideal.gyroscope, ideal.accelerometer, "demo"))
    shown = times < margin + 10 * _NS
    imu_comparison(
        out / "imu.png",
        _excerpt(times, made, shown, 0),
        _excerpt(times[::4], ImuReading(*(x[::4] for x in ideal)), shown[::4], 0),
        "IMU synthesised from noisy poses, and the truth",
        ("synthesised", "truth"),
    )

    table = Table("", "value", "unit", title="torchspline demo")
    table.add_row("poses at 120 Hz", str(len(stamps)), "")
    table.add_row("noise of a pose", f"{position_noise * 1e3:g} / {rotation_noise * 1e3:g}", "mm / mrad")
    _add_fit_rows(table, fit, spacing)
    table.add_row("gyroscope error, RMS", f"{errors[0]:.4f}  (at most {allowed[0]})", "rad/s")
    table.add_row("accelerometer error, RMS", f"{errors[1]:.4f}  (at most {allowed[1]})", "m/s²")
    _console.print(table)
    _console.print(f"written to {out}: poses.txt trajectory.txt imu.csv imu_truth.csv imu.png report.json")
    _console.print("check against the truth: passed" if passed else "check against the truth: FAILED")
    report = {
        "gyroscope_rmse_rad_s": errors[0],
        "accelerometer_rmse_m_s2": errors[1],
        "allowed": allowed,
        "passed": passed,
        "seed": seed,
        "fit": _fit_report(fit, spacing),
    }
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return 0 if passed else 1


def imu(
    poses: Path,
    recorded: Path | None = None,
    rate: float = 200.0,
    out: Path = Path("torchspline-imu"),
    spacing: float | None = None,
    order: int = 6,
    representation: Literal["split", "joint"] = "split",
    gravity: tuple[float, float, float] = STANDARD_GRAVITY,
    gap: float | None = None,
    start: float = 0.0,
    duration: float = math.inf,
    margin: float = 0.3,
    format: Literal["tum", "euroc", "kitti"] | None = None,
    times: Path | None = None,
) -> int:
    """IMU readings from a file of poses, compared with a recording if there is one.

    Args:
        poses: TUM, EuRoC or KITTI file of poses of the IMU's frame, gzipped or not.
        recorded: EuRoC IMU file on the same clock. Constant biases are estimated and removed before comparing.
        rate: of the synthesised readings, Hz.
        out: folder for the results; made if it is not there.
        spacing: of the knots, ms; by default five median pose intervals. A wrong one costs accuracy.
        order: of the spline; the curve has order - 2 continuous derivatives.
        representation: split (R3 x SO3) or joint (SE3).
        gravity: acceleration in the world of the poses, m/s²; KITTI's y axis points down: [0, 9.80665, 0].
        gap: the longest stretch without poses that is bridged, ms; by default 30, or three median pose intervals
            if that is more. The longest stretch without a larger gap is used.
        start: offset into that stretch, s.
        duration: how much of it to use, s.
        margin: left out at both ends, where a spline knows least, s.
        format: of the poses; by default recognised from their content.
        times: file of times that goes with KITTI poses.
    """
    if not (math.isfinite(rate) and rate > 0):
        raise ValueError(f"rate: expected a finite number above zero (Hz), got {rate}")
    if not margin >= 0:
        raise ValueError(f"margin: expected seconds, zero or more, got {margin}")
    record = read_poses(poses, format, times)
    recording = None if recorded is None else read_imu(recorded)
    record = _longest_stretch(record, gap, start, duration)
    out.mkdir(parents=True, exist_ok=True)
    interval = record.time_ns.unique().diff().to(torch.float64).median().item() / _NS
    dt = 5 * interval if spacing is None else spacing * 1e-3
    fit = fit_poses(
        record.time_ns,
        torch.cat([record.position, record.rotation], -1),
        dt=dt,
        order=order,
        representation=representation,
    )
    first, last = int(record.time_ns[0]), int(record.time_ns[-1])
    low, high = first + round(margin * _NS), last - round(margin * _NS)
    if low >= high:
        raise ValueError(
            f"margin: nothing is left of {(last - first) / _NS:.3g} s between margins of {margin} s"
        )
    if (high - low) / _NS * rate > 1e9:
        raise ValueError(f"rate: {rate:g} Hz over {(high - low) / _NS:g} s makes more than 1e9 readings")
    steps = torch.arange(int((high - low) / _NS * rate) + 1, dtype=torch.float64)
    stamps = low + (steps * (_NS / rate)).round().to(torch.int64)
    with torch.no_grad():
        made = measure(fit.trajectory, stamps, gravity)

    table = Table("", "value", "unit", title=f"IMU from {poses.name}")
    table.add_row("poses used", f"{len(record)} over {(last - first) / _NS:.2f} s", "")
    _add_fit_rows(table, fit, dt)
    table.add_row("readings synthesised", f"{len(stamps)} at {rate:g} Hz", "")
    report: dict = {"fit": _fit_report(fit, dt), "window_ns": [first, last]}
    title = f"{poses.name}: {representation} spline of order {order}, knots {dt * 1e3:.4g} ms apart"
    shown = stamps < low + 10 * _NS
    lines, dots = _excerpt(stamps, made, shown, first), None
    if recording is not None:
        within = recording.window(low, high)
        if len(within) == 0:
            raise ValueError(
                f"recorded: {recorded} has no reading between {low} and {high} ns, where the poses are"
            )
        with torch.no_grad():
            here = measure(fit.trajectory, within.time_ns, gravity)
        bias = (
            (within.gyroscope - here.gyroscope).mean(0),
            (within.accelerometer - here.accelerometer).mean(0),
        )
        biased = ImuReading(here.gyroscope + bias[0], here.accelerometer + bias[1])
        errors = _rmse(biased, within.gyroscope, within.accelerometer)
        report |= {
            "gyroscope_rmse_rad_s": errors[0],
            "accelerometer_rmse_m_s2": errors[1],
            "gyroscope_bias_rad_s": bias[0].tolist(),
            "accelerometer_bias_m_s2": bias[1].tolist(),
            "readings_compared": len(within),
        }
        table.add_row("readings compared", str(len(within)), "")
        table.add_row("gyroscope bias", _three(bias[0]), "rad/s")
        table.add_row("accelerometer bias", _three(bias[1]), "m/s²")
        table.add_row("gyroscope RMSE", f"{errors[0]:.4f}", "rad/s")
        table.add_row("accelerometer RMSE", f"{errors[1]:.4f}", "m/s²")
        excerpt = within.time_ns < low + 10 * _NS
        lines = lines[0], ImuReading(lines[1].gyroscope + bias[0], lines[1].accelerometer + bias[1])
        dots = _excerpt(within.time_ns, ImuReading(within.gyroscope, within.accelerometer), excerpt, first)
        _write_comparison(out / "comparison.csv", within, biased)
    _write_results(out, fit.trajectory, stamps, made)
    imu_comparison(out / "imu.png", lines, dots, title)
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    _console.print(table)
    for note in fit.notes:
        _console.print(f"note: {note}")
    files = "trajectory.txt imu.csv imu.png report.json" + ("" if recording is None else " comparison.csv")
    _console.print(f"written to {out}: {files}")
    return 0


def show(
    group: str,
    order: int = 4,
    derivatives: Literal[0, 1, 2, 3] = 2,
    sweep: Literal["forward", "reverse"] = "forward",
    precision: Literal["float64", "float32"] = "float64",
    target: Literal["numba", "triton"] = "numba",
) -> int:
    """Print the source of the compiled loop that evaluates a spline.

    Args:
        group: name of the group, such as SO3, SE3, R3 or R3xSO3.
        order: of the spline.
        derivatives: how many time derivatives, 0 to 3.
        sweep: the values, or the gradients.
        precision: of the numbers.
        target: what compiles it: numba for the CPU, triton for a GPU.
    """
    chosen = Group(group).name, order, derivatives, getattr(torch, precision)
    kernels = kernels_of(*chosen, nanoseconds=False) if target == "numba" else triton_kernels_of(*chosen)
    print(kernels.forward_source() if sweep == "forward" else kernels.reverse_source())
    return 0


def _random_motion(duration: float, generator: torch.Generator) -> SplitBSpline:
    """A smooth motion about 1 m across with turns of about a radian a second, on nanosecond stamps."""
    knot, order = 0.5, 6
    count = math.ceil(duration / knot) + order
    position = 0.6 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    turns = 0.5 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    rotation = [SO3.identity()]
    for turn in turns[1:]:
        rotation.append(SO3.retract(rotation[-1], turn, side="right"))
    points = torch.cat([position, torch.stack(rotation)], dim=-1)
    return SplitBSpline(points, order=order, dt_ns=int(knot * _NS), t0_ns=0, learnable=False)


def _longest_stretch(record: PoseRecord, gap: float | None, start: float, duration: float) -> PoseRecord:
    """The longest run of usable poses without a larger gap, cut to `start` and `duration`."""
    usable = ~(record.position.isnan().any(-1) | record.rotation.isnan().any(-1))
    rows = torch.argsort(record.time_ns, stable=True)
    rows = rows[usable[rows]]
    record = PoseRecord(record.time_ns[rows], record.position[rows], record.rotation[rows], record.source)
    time = record.time_ns.unique()
    if len(time) < 2:
        raise ValueError(
            f"poses: {record.source} has {len(time)} usable poses at distinct times; two are needed"
        )
    steps = time.diff()
    median = steps.to(torch.float64).median().item()
    largest = max(0.03 * _NS, 3 * median) if gap is None else gap * 1e6
    edges = [0, *(torch.nonzero(steps > largest).flatten() + 1).tolist(), len(time)]
    low, high = max(
        ((int(time[a]), int(time[b - 1])) for a, b in pairwise(edges)),
        key=lambda stretch: stretch[1] - stretch[0],
    )
    if not (math.isfinite(start) and start >= 0):
        raise ValueError(f"start: expected seconds, zero or more, got {start}")
    low += round(start * _NS)
    if math.isfinite(duration):
        high = min(high, low + round(duration * _NS))
    if low >= high:
        raise ValueError(
            f"start, duration: nothing is left of the longest stretch without a gap ({start=}, {duration=})"
        )
    return record.window(low, high)


def _excerpt(stamps: Tensor, reading: ImuReading, shown: Tensor, origin: int) -> tuple[Tensor, ImuReading]:
    """Seconds since `origin` and readings of the samples `shown`."""
    return (stamps[shown] - origin) / _NS, ImuReading(*(x[shown] for x in reading))


def _rmse(made: ImuReading, gyroscope: Tensor, accelerometer: Tensor) -> tuple[float, float]:
    """Pooled over samples and axes."""
    pairs = ((made.gyroscope, gyroscope), (made.accelerometer, accelerometer))
    first, second = (math.sqrt((a - b).square().mean().item()) for a, b in pairs)
    return first, second


def _add_fit_rows(table: Table, fit: PoseFit, dt: float) -> None:
    position, rotation = fit.rms()
    points = fit.trajectory.control_points.shape[-2]
    table.add_row("knot spacing", f"{dt * 1e3:.4g}", "ms")
    table.add_row(
        "spline", f"{fit.trajectory.group}, order {fit.trajectory.order}, {points} control points", ""
    )
    table.add_row("pose residual, RMS", f"{position * 1e3:.4f} / {rotation * 1e3:.4f}", "mm / mrad")


def _fit_report(fit: PoseFit, dt: float) -> dict:
    position, rotation = fit.rms()
    return {
        "group": str(fit.trajectory.group),
        "order": fit.trajectory.order,
        "knot_spacing_s": dt,
        "control_points": fit.trajectory.control_points.shape[-2],
        "position_residual_rms_m": position,
        "rotation_residual_rms_rad": rotation,
        "iterations": len(fit.cost) - 1,
        "stopped": fit.reason,
        "notes": fit.notes,
    }


def _write_results(out: Path, trajectory: Trajectory, stamps: Tensor, made: ImuReading) -> None:
    with torch.no_grad():
        motion = trajectory.kinematics(stamps)
    assert motion.position is not None
    assert motion.rotation is not None
    write_poses(out / "trajectory.txt", PoseRecord(stamps, motion.position, motion.rotation, "torchspline"))
    write_imu(out / "imu.csv", ImuRecord(stamps, made.gyroscope, made.accelerometer, "torchspline"))


def _write_comparison(path: Path, recorded: ImuRecord, made: ImuReading) -> None:
    """Recorded and synthesised readings side by side."""
    import numpy as np

    names = [
        f"{sensor}_{kind}_{axis}"
        for kind in ("recorded", "synthesised")
        for sensor in ("w", "a")
        for axis in "xyz"
    ]
    columns = torch.cat([recorded.gyroscope, recorded.accelerometer, made.gyroscope, made.accelerometer], -1)
    rows = np.column_stack([recorded.time_ns.numpy().astype(object), columns.numpy()])
    header = ",".join(["timestamp_ns", *names])
    np.savetxt(path, rows, delimiter=",", fmt=["%d", *["%.9g"] * len(names)], header=header, comments="")


def _three(x: Tensor) -> str:
    return " ".join(f"{v:+.4f}" for v in x.tolist())


def main() -> None:
    """Entry point of the `torchspline` command."""
    from jsonargparse import CLI

    commands = {
        "demo": demo,
        "imu": imu,
        "body": body,
        "generate": generate,
        "calibrate": {"camera-imu": camera_imu},
        "kernels": {"show": show},
    }
    # A truth value takes a word of its own, but nobody types one after --json.
    arguments = ["--json=true" if argument == "--json" else argument for argument in sys.argv[1:]]
    try:
        own = tuple(arguments[:2]) == COMMAND
        status = run(arguments[2:]) if own else CLI(commands, args=arguments, prog="torchspline")
    except (TypeError, ValueError, OSError, MemoryError, ModuleNotFoundError) as error:
        print(f"torchspline: {error}", file=sys.stderr)
        status = 2
    sys.exit(status)


if __name__ == "__main__":
    main()
