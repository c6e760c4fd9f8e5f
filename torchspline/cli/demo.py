"""`torchspline demo`."""

import math
from pathlib import Path

import torch

from torchspline.cli.common import (
    excerpt,
    fit_report,
    fit_rows,
    rmse,
    save_figure,
    write_report,
    write_results,
)
from torchspline.cli.report import Report
from torchspline.fit import fit_poses
from torchspline.groups import SO3
from torchspline.imu import ImuReading, measure
from torchspline.io import ImuRecord, PoseRecord, write_imu, write_poses
from torchspline.plot import imu_comparison
from torchspline.splines import SplitBSpline
from torchspline.units import SECOND

EXAMPLES = """
torchspline demo
torchspline demo --duration 60 --seed 3 --out DIR --json
"""

_LONGEST = 1e5  # s, of which there are 12 million poses


def demo(out: Path = Path("torchspline-demo"), duration: float = 20.0, seed: int = 0) -> Report:
    """From a known motion to noisy poses, a fitted spline and its IMU signal, checked against the truth.

    Args:
        out: folder for the results; made if it is not there.
        duration: length of the motion, s.
        seed: of the random motion and noise.
    """
    if not duration >= 2.0:
        raise ValueError(f"duration: expected at least 2 s, got {duration}")
    if not duration <= _LONGEST:
        raise ValueError(f"duration: expected at most {_LONGEST:g} s, got {duration}")
    out.mkdir(parents=True, exist_ok=True)
    generator = torch.Generator().manual_seed(seed)
    truth = _random_motion(duration, generator)
    position_noise, rotation_noise = 1e-4, 5e-4
    stamps = torch.arange(0, int(duration * SECOND), SECOND // 120)
    exact = truth(stamps)
    noise = torch.randn(len(stamps), 6, generator=generator, dtype=torch.float64)
    rotations = SO3.retract(exact[:, 3:], rotation_noise * noise[:, 3:], side="right")
    poses = PoseRecord(stamps, exact[:, :3] + position_noise * noise[:, :3], rotations, "demo")

    spacing = 0.1
    fit = fit_poses(stamps, torch.cat([poses.position, poses.rotation], -1), dt=spacing)
    margin = int(0.3 * SECOND)
    times = torch.arange(margin, int(stamps[-1]) - margin, SECOND // 200)
    with torch.no_grad():
        ideal, made = measure(truth, times), measure(fit.trajectory, times)
    errors = rmse(made, ideal.gyroscope, ideal.accelerometer)
    # Twice what seeds 0 to 5 give: noise of the poses, differentiated once and twice by a spline of this spacing.
    allowed = (0.006, 0.03)
    passed = errors[0] <= allowed[0] and errors[1] <= allowed[1]

    write_poses(out / "poses.txt", poses)
    write_results(out, fit.trajectory, times, made)
    write_imu(out / "imu_truth.csv", ImuRecord(times, ideal.gyroscope, ideal.accelerometer, "demo"))
    shown = times < margin + 10 * SECOND
    figure = imu_comparison(
        excerpt(times, made, shown, 0),
        excerpt(times[::4], ImuReading(*(x[::4] for x in ideal)), shown[::4], 0),
        "IMU synthesised from noisy poses, and the truth",
        ("synthesised", "truth"),
    )
    save_figure(out / "imu.png", figure)

    rows = [
        ("poses at 120 Hz", str(len(stamps)), ""),
        ("noise of a pose", f"{position_noise * 1e3:g} / {rotation_noise * 1e3:g}", "mm / mrad"),
        *fit_rows(fit, spacing),
        ("gyroscope error, RMS", f"{errors[0]:.4f}  (at most {allowed[0]})", "rad/s"),
        ("accelerometer error, RMS", f"{errors[1]:.4f}  (at most {allowed[1]})", "m/s²"),
    ]
    values = {
        "gyroscope_rmse_rad_s": errors[0],
        "accelerometer_rmse_m_s2": errors[1],
        "allowed": allowed,
        "seed": seed,
        "fit": fit_report(fit, spacing),
    }
    write_report(out / "report.json", {"passed": passed, **values})
    names = ("poses.txt", "trajectory.txt", "imu.csv", "imu_truth.csv", "imu.png", "report.json")
    notes = [f"check against the truth: {'passed' if passed else 'FAILED'}"]
    return Report("torchspline demo", values, rows, notes, [out / name for name in names], passed)


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
    return SplitBSpline(points, order=order, dt_ns=int(knot * SECOND), t0_ns=0, learnable=False)
