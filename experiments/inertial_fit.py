"""A trajectory from inertial readings and sparse poses: what motion capture saw in between is withheld and recovered.

Poses thinned to a few a second hold the trajectory in place; gyroscope and accelerometer, at their full rate, say how
it moves in between. Unknown besides the control points: biases, the direction of gravity, the mounting, the offset and
rate of the IMU's clock and the delay between its sensors. The result is compared with the poses that were left out.
"""

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from common import ROOT, Table, run, save, show
from matplotlib.figure import Figure
from recordings.load import Recording, load, usable
from torch import Tensor

from torchspline import R3, SE3, SO3, BSpline, SplitBSpline, fit_poses
from torchspline.fit.losses import Huber
from torchspline.fit.problem import Problem
from torchspline.fit.residual import Clock
from torchspline.fit.residuals import RESIDUALS
from torchspline.fit.variables import Variable
from torchspline.imu import STANDARD_GRAVITY
from torchspline.units import SECOND

ORDER = 6
#: What a residual of one weighs: position [m], rotation [rad], gyroscope [rad/s], accelerometer [m/s^2].
SIGMAS = (0.001, 0.005, 0.01, 0.1)


class Fitted(NamedTuple):
    trajectory: BSpline
    start: BSpline
    variables: dict[str, Tensor]
    reason: str
    iterations: int
    seconds: float


def fit(
    recording: Recording, chosen: Tensor, spacing: float, representation: str, bias_spacing: float
) -> Fitted:
    """Poses of the rows `chosen` and all readings; a start from the poses alone."""
    began = time.perf_counter()
    stamps, poses = recording.poses.time_ns[chosen], recording.pose[chosen]
    trajectory = _start(stamps, poses, round(spacing * SECOND), representation)
    start = type(trajectory)(trajectory.control_points.detach().clone(), **_options(trajectory))
    samples = recording.samples
    low, high = trajectory.domain
    inside = (samples.time_ns > low + SECOND // 50) & (samples.time_ns < high - SECOND // 50)
    t = samples.time_ns[inside]
    zero = torch.zeros(3, dtype=torch.float64)
    clock = Clock(
        Variable("time_offset", zero[:1]), Variable("clock_skew", zero[:1]), mid=int(low + high) // 2
    )
    # The filters of the two sensors differ: one clock for both would be wrong by a millisecond for one of them.
    late = torch.ones(len(t), dtype=torch.float64)
    accel_clock = replace(clock, delay=Variable("accel_delay", zero[:1]), late=late)
    gravity = Variable("gravity", torch.tensor(STANDARD_GRAVITY, dtype=torch.float64), sphere=True)
    # Poses are said to be the IMU's own; how well that is calibrated shows here.
    rotation = Variable("rotation", SO3.identity(), group=SO3)
    lever_arm = Variable("lever_arm", zero)
    biases: dict[str, Variable | BSpline] = {
        name: Variable(name, zero) if bias_spacing == 0.0 else _bias(low, high, bias_spacing)
        for name in ("gyro_bias", "accel_bias")
    }
    sigmas = torch.tensor([SIGMAS[0]] * 3 + [SIGMAS[1]] * 3, dtype=torch.float64)
    problem = Problem(trajectory)
    problem.add(RESIDUALS["Pose"](stamps, poses, sigma=sigmas, loss=Huber(3.0)))
    problem.add(
        RESIDUALS["Gyroscope"](
            t,
            samples.gyroscope[inside],
            sigma=SIGMAS[2],
            loss=Huber(3.0),
            clock=clock,
            bias=biases["gyro_bias"],
            rotation=rotation,
        )
    )
    problem.add(
        RESIDUALS["Accelerometer"](
            t, samples.accelerometer[inside], sigma=SIGMAS[3], loss=Huber(3.0), clock=accel_clock,
            bias=biases["accel_bias"], gravity=gravity, rotation=rotation, lever_arm=lever_arm,
        )
    )  # fmt: skip
    result = problem.solve(cost_tolerance=1e-7)
    variables = {name: v.value for name, v in problem.variables.items()}
    variables |= {n: b.control_points.detach().mean(0) for n, b in biases.items() if isinstance(b, BSpline)}
    return Fitted(
        trajectory, start, variables, result.reason, len(result.cost) - 1, time.perf_counter() - began
    )


def _start(stamps: Tensor, poses: Tensor, dt_ns: int, representation: str) -> BSpline:
    """A spline through poses interpolated between the sparse ones: straight lines and constant turning."""
    fine = torch.cat([torch.arange(int(stamps[0]), int(stamps[-1]), max(dt_ns // 2, 1)), stamps[-1:]])
    left = torch.searchsorted(stamps, fine, right=True).clamp(1, len(stamps) - 1) - 1
    share = (fine - stamps[left]).to(torch.float64) / (stamps[left + 1] - stamps[left])
    a, b = poses[left], poses[left + 1]
    position = a[:, :3] + share[:, None] * (b - a)[:, :3]
    between = torch.cat([position, SO3.interpolate(a[:, 3:], b[:, 3:], share)], -1)
    found = fit_poses(
        fine, between, dt=dt_ns / SECOND, order=ORDER, representation=representation, max_iterations=2,
        progress=False,
    )  # fmt: skip
    return found.trajectory


def _options(spline: BSpline) -> dict[str, Any]:
    options = {"order": spline.order, "dt_ns": spline.dt_ns, "t0_ns": spline.t0_ns, "learnable": False}
    return options if isinstance(spline, SplitBSpline) else {**options, "group": SE3}


def _bias(low: int, high: int, spacing: float) -> BSpline:
    dt = round(spacing * SECOND)
    points = torch.zeros(-(-(high - low) // dt) + 3, 3, dtype=torch.float64)
    return BSpline(points, group=R3, order=4, dt_ns=dt, t0_ns=int(low))


def misses(trajectory: BSpline, recording: Recording, withheld: Tensor) -> tuple[Tensor, Tensor]:
    """Distance [m] and angle [rad] to each withheld pose."""
    with torch.no_grad():
        found = trajectory(recording.poses.time_ns[withheld])
    there = recording.pose[withheld]
    angle = SO3.log(SO3.between(there[:, 3:], found[:, 3:])).norm(dim=-1)
    return (found[:, :3] - there[:, :3]).norm(dim=-1), angle


def rms(x: Tensor) -> float:
    return math.sqrt(x.square().mean().item())


def experiment(
    out: Path,
    data: str,
    recording: str,
    rate: float,
    spacing: float,
    representations: list[str],
    bias_spacings: list[float],
    seed: int,
) -> dict[str, Any]:
    """Recover withheld poses from inertial readings and poses at a low rate.

    Args:
        out: folder for the results.
        data: folder of the recordings, from the root of the project.
        recording: which; "synthetic" needs no data.
        rate: of the poses that are kept, Hz.
        spacing: of the knots, s.
        representations: "split", "joint".
        bias_spacings: of the knots of bias splines, s; 0 for constant biases.
        seed: of the synthetic recording.
    """
    raw = load(ROOT / data, recording, seed)
    record = Recording(raw.name, usable(raw.poses), raw.samples)
    stamps = record.poses.time_ns
    grid = torch.arange(int(stamps[0]), int(stamps[-1]) + 1, round(SECOND / rate))
    chosen = torch.searchsorted(stamps, grid).clamp(max=len(stamps) - 1).unique()
    inside = torch.ones(len(stamps), dtype=torch.bool)
    inside[chosen] = False
    inside &= (stamps > stamps[chosen[0]]) & (stamps < stamps[chosen[-1]])
    withheld = torch.nonzero(inside).flatten()
    rows, figures, drawn = [], {}, {}
    for representation in representations:
        for bias_spacing in bias_spacings:
            fitted = fit(record, chosen, spacing, representation, bias_spacing)
            position, angle = misses(fitted.trajectory, record, withheld)
            before = misses(fitted.start, record, withheld)
            kind = "constant" if bias_spacing == 0.0 else f"spline, {bias_spacing:g} s"
            drawn[f"{representation}, bias {kind}"] = position, angle
            rows.append(
                (
                    representation,
                    kind,
                    f"{rms(before[0]) * 1e3:.1f} / {math.degrees(rms(before[1])):.2f}",
                    f"{rms(position) * 1e3:.2f} / {math.degrees(rms(angle)):.3f}",
                    f"{position.max() * 1e3:.1f} / {math.degrees(angle.max()):.2f}",
                    f"{fitted.variables['time_offset'].item() * 1e3:+.2f}",
                    f"{fitted.variables['clock_skew'].item() * 1e6:+.1f}",
                    f"{fitted.variables['accel_delay'].item() * 1e3:+.2f}",
                    fitted.iterations,
                    f"{fitted.seconds:.1f}",
                )
            )
            figures[f"{representation}, bias {kind}"] = {
                "withheld_poses": len(withheld),
                "poses_used": len(chosen),
                "position_rms_m": rms(position),
                "rotation_rms_rad": rms(angle),
                "position_rms_before_m": rms(before[0]),
                "rotation_rms_before_rad": rms(before[1]),
                "position_largest_m": position.max().item(),
                "rotation_largest_rad": angle.max().item(),
                "variables": fitted.variables,
                "stopped": fitted.reason,
                "iterations": fitted.iterations,
                "seconds": fitted.seconds,
            }
    header = ["trajectory", "bias", "before: position [mm] / rotation [deg]", "RMS [mm] / [deg]",
              "largest [mm] / [deg]", "offset [ms]", "skew [1e-6]",
              "accelerometer later by [ms]", "iterations", "time [s]"]  # fmt: skip
    title = f"{record.name}: {len(withheld)} withheld poses from {len(chosen)} at {rate:g} Hz and the IMU"
    show(out, [Table(title, header, rows)])
    save(_figure((stamps[withheld] - stamps[0]) / SECOND, drawn, title), out / "inertial_fit.png")
    return figures


def _figure(t: Tensor, drawn: dict[str, tuple[Tensor, Tensor]], title: str) -> Figure:
    figure = Figure(figsize=(10, 6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    second = t.floor().to(torch.int64)
    for i, (name, (position, angle)) in enumerate(drawn.items()):
        for axis, x in ((upper, 1e3 * position), (lower, angle.rad2deg())):
            axis.plot(t, x, ".", color=f"C{i}", markersize=1, alpha=0.15)
            square = torch.bincount(second, x.square()) / torch.bincount(second)
            axis.step(torch.arange(len(square)), square.sqrt(), where="post", color=f"C{i}", label=name)
    upper.set(ylabel="distance [mm]", title=title)
    lower.set(ylabel="angle [deg]", xlabel="time [s]")
    for axis in (upper, lower):
        axis.set_yscale("log")
        axis.grid(alpha=0.3)
    upper.legend(title="RMS of each second", loc="lower right")
    return figure


if __name__ == "__main__":
    run(
        experiment,
        smoke={
            "recording": "synthetic",
            "spacing": 0.1,
            "bias_spacings": [0.0],
            "representations": ["split"],
        },
    )
