"""People: IMUs on every joint of a captured motion, and what smoothing does to accelerations.

The frequency response of splines beside that of second differences, which most data sets of synthetic inertial
readings come from [DIP, TransPose: over four frames on each side at 60 Hz]; then both on a motion whose readings are
known, with noise on its poses; then on a walk.
"""

import math
import time
from pathlib import Path
from typing import Any

import torch
from common import ROOT, Table, run, save, show
from matplotlib.figure import Figure
from torch import Tensor

from torchspline import SO3, SplitBSpline, imu, use_kernels
from torchspline.io import read_bvh
from torchspline.people import fit_body, response

DOUBLE = torch.float64
#: y is up.
GRAVITY = (0.0, -9.80665, 0.0)
#: Frames on each side of the usual recipe.
STEP = 4


def differences(poses: Tensor, rate: float, step: int) -> tuple[Tensor, Tensor]:
    """Gyroscope and accelerometer (J, N - 2 step, 3) from poses (J, N, 7) by differences, as data sets make them.

    Angular velocity over a frame on each side, acceleration over `step`.
    """
    x, q = poses[..., :3], poses[..., 3:]
    middle = slice(step, poses.shape[1] - step)
    a = (x[:, 2 * step :] + x[:, : -2 * step] - 2.0 * x[:, middle]) * (rate / step) ** 2
    turn = SO3.log(SO3.between(q[:, step - 1 : -step - 1], q[:, step + 1 : poses.shape[1] - step + 1]))
    force = SO3.act(SO3.inverse(q[:, middle]), a - torch.tensor(GRAVITY, dtype=DOUBLE))
    return turn * (0.5 * rate), force


def difference_noise(rate: float, step: int) -> float:
    """RMS acceleration that white noise of positions becomes, times 1/s^2."""
    return math.sqrt(6.0) * (rate / step) ** 2


def named(step: int) -> str:
    return f"differences over {step} frame{'s' if step > 1 else ''}"


# ---------------------------------------------------------------------- a motion whose readings are known


class Motion:
    """A trunk and limbs that swing at 1 Hz and shake at the frequencies of footsteps; readings by forward mode."""

    def __init__(self, joints: int, seed: int):
        generator = torch.Generator().manual_seed(seed)
        self.axes = torch.nn.functional.normalize(
            torch.randn(joints, 3, generator=generator, dtype=DOUBLE), dim=-1
        )
        self.phases = 6.28 * torch.rand(4, joints, 1, generator=generator, dtype=DOUBLE)

    def waves(self, t: Tensor) -> list[Tensor]:
        return [
            torch.sin(2 * math.pi * f * t + phase)
            for f, phase in zip((1.0, 3.0, 6.0, 9.0), self.phases, strict=True)
        ]

    def position(self, t: Tensor) -> Tensor:
        a, b, c, d = self.waves(t)
        return torch.stack([1.2 * t + 0.1 * a + 4e-3 * d, 0.9 + 0.04 * b + 4e-3 * c, 0.1 * a + 0.01 * c], -1)

    def rotation(self, t: Tensor) -> Tensor:
        a, b, c, d = self.waves(t)
        return SO3.exp((0.6 * a + 0.1 * b + 0.03 * c + 0.01 * d)[..., None] * self.axes[:, None])

    def poses(self, t: Tensor) -> Tensor:
        return torch.cat([self.position(t), self.rotation(t)], -1)

    def readings(self, t: Tensor) -> tuple[Tensor, Tensor]:
        def along(f: Any) -> Any:
            return lambda t: torch.func.jvp(f, (t,), (torch.ones_like(t),))[1]

        q = self.rotation(t)
        rate = along(lambda s: SO3.log(SO3.between(q, self.rotation(s))))(t)
        fall = along(along(self.position))(t) - torch.tensor(GRAVITY, dtype=DOUBLE)
        return rate, SO3.act(SO3.inverse(q), fall)


def against_truth(
    frame_rate: float, bandwidths: list[float], noise: tuple[float, float], seed: int
) -> dict[str, dict[str, float]]:
    """RMS errors of readings at the frames, from exact and from noisy poses."""
    motion, t = Motion(8, seed), torch.arange(0.0, 8.0, 1.0 / frame_rate, dtype=DOUBLE)
    gyroscope, accelerometer = motion.readings(t)
    exact = motion.poses(t)
    generator = torch.Generator().manual_seed(seed + 1)
    shake = torch.randn(*exact.shape[:2], 6, generator=generator, dtype=DOUBLE)
    noisy = torch.cat(
        [
            exact[..., :3] + 1e-3 * noise[0] * shake[..., :3],
            SO3.retract(exact[..., 3:], 1e-3 * noise[1] * shake[..., 3:], side="right"),
        ],
        -1,
    )
    inside = slice(round(0.5 * frame_rate), -round(0.5 * frame_rate))

    def rms(x: Tensor, y: Tensor) -> float:
        return float((x - y).square().mean().sqrt())

    found: dict[str, dict[str, float]] = {}
    for label, poses in (("exact poses", exact), ("noisy poses", noisy)):
        for step in (1, STEP):
            made = torch.zeros_like(gyroscope), torch.zeros_like(accelerometer)
            for x, y in zip(made, differences(poses, frame_rate, step), strict=True):
                x[:, step:-step] = y
            found.setdefault(key := named(step), {})[f"gyroscope, {label}"] = rms(
                made[0][:, inside], gyroscope[:, inside]
            )
            found[key][f"accelerometer, {label}"] = rms(made[1][:, inside], accelerometer[:, inside])
        for bandwidth in bandwidths:
            with torch.no_grad():
                reading = imu.measure(fit_body(t, poses, bandwidth=bandwidth), t, gravity=GRAVITY)
            key = f"spline, {bandwidth:g} Hz"
            found.setdefault(key, {})[f"gyroscope, {label}"] = rms(
                reading.gyroscope[:, inside], gyroscope[:, inside]
            )
            found[key][f"accelerometer, {label}"] = rms(
                reading.accelerometer[:, inside], accelerometer[:, inside]
            )
    found["the readings themselves"] = {
        f"{name}, {label}": rms(x, x.mean(1, keepdim=True))
        for label in ("exact poses", "noisy poses")
        for name, x in (("gyroscope", gyroscope), ("accelerometer", accelerometer))
    }
    return found


# ---------------------------------------------------------------------- the run


def load(motion: str, unit: float, seed: int) -> tuple[Tensor, Tensor, list[str]]:
    """Times, poses (J, F, 7) and names of joints."""
    if motion == "synthetic":
        t = torch.arange(0.0, 2.0, 1 / 120, dtype=DOUBLE)
        return t, Motion(3, seed).poses(t), ["first", "second", "third"]
    skeleton = read_bvh(ROOT / motion, unit=unit)
    return skeleton.time, skeleton.poses(), list(skeleton.names)


def draw(
    out: Path, frequencies: Tensor, curves: dict[str, Tensor], body: SplitBSpline, joint: int, name: str,
    t: Tensor, poses: Tensor, frame_rate: float,
) -> None:  # fmt: skip
    figure = Figure(figsize=(12, 10), layout="constrained")
    axes = figure.subplots(3, 1)
    for label, gain in curves.items():
        axes[0].plot(frequencies, gain, "--" if "differences" in label else "-", label=label)
    axes[0].axhline(1.0, color="0.7", linewidth=0.8)
    axes[0].set(
        xlabel="frequency of the motion [Hz]", ylabel="share of the acceleration that is kept",
        title=f"what is kept of accelerations, poses at {frame_rate:g} Hz",
    )  # fmt: skip
    dense = torch.linspace(float(t[0]) + 0.3, float(t[-1]) - 0.3, 2000, dtype=DOUBLE)
    with torch.no_grad():
        reading = imu.measure(body, dense, gravity=GRAVITY)
    other = differences(poses, frame_rate, STEP)
    times = t[STEP:-STEP]
    shown = (times >= dense[0]) & (times <= dense[-1])
    for ax, made, recipe, label in zip(
        axes[1:], reading, other, ("gyroscope [rad/s]", "accelerometer [m/s²]"), strict=True
    ):
        for i, axis in enumerate("xyz"):
            ax.plot(dense, made[joint, :, i], color=f"C{i}", label=f"{axis}, spline")
            ax.plot(
                times[shown],
                recipe[joint, shown, i],
                ".",
                markersize=4,
                color=f"C{i}",
                alpha=0.5,
                label=f"{axis}, differences",
            )
        ax.set(xlabel="time [s]", ylabel=label)
    axes[1].set_title(f"IMU on {name}: spline, and differences over {STEP} frames on each side (dots)")
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.legend(ncols=3, fontsize=8)
    save(figure, out / "people.png")


def experiment(
    out: Path, motion: str, unit: float, bandwidths: list[float], bandwidth: float, frame_rate: float, rate: float,
    joint: str, noise: tuple[float, float], seed: int,
) -> dict[str, Any]:  # fmt: skip
    """Frequency response of splines and differences, both against known readings, and a walk.

    Args:
        out: folder for the results.
        motion: BVH file, from the root of the project; "synthetic" needs no data.
        unit: of its lengths, m.
        bandwidths: of the splines, Hz.
        bandwidth: for which one readings of the motion are made.
        frame_rate: of the poses that go in, Hz.
        rate: of the readings that come out, Hz.
        joint: that is drawn.
        noise: of poses, mm and mrad.
        seed: of motion and noise.
    """
    with use_kernels("reference"):  # nothing here is worth waiting for loops to compile
        frequencies = torch.arange(0.5, 0.5 * frame_rate, 0.5, dtype=DOUBLE)
        curves = {named(n): torch.sinc(frequencies * n / frame_rate) ** 2 for n in (1, STEP)}
        noises = {named(n): difference_noise(frame_rate, n) for n in (1, STEP)}
        for b in bandwidths:
            found = response(frequencies, frame_rate, bandwidth=b)
            curves[f"spline, {b:g} Hz"], noises[f"spline, {b:g} Hz"] = found.gain, found.noise
        compared = against_truth(frame_rate, bandwidths, noise, seed)

        t, poses, names = load(motion, unit, seed)
        every = max(round(1.0 / (frame_rate * float(t.diff().median()))), 1)
        since = time.perf_counter()
        full = fit_body(t, poses, bandwidth=bandwidth)
        times = torch.arange(float(t[0]) + 0.3, float(t[-1]) - 0.3, 1.0 / rate, dtype=DOUBLE)
        with torch.no_grad():
            reading = imu.measure(full, times, gravity=GRAVITY)
            seconds = time.perf_counter() - since
            thin = fit_body(t[::every], poses[:, ::every], bandwidth=bandwidth)
            fewer = imu.measure(thin, times, gravity=GRAVITY)
        change = reading.accelerometer - fewer.accelerometer
    at = [f for f in (2.0, 5.0, 10.0, 15.0, 20.0) if f < frequencies[-1]]
    gains = {
        name: {f"{f:g}": float(gain[int((frequencies - f).abs().argmin())]) for f in at}
        for name, gain in curves.items()
    }
    walk = {
        name: {
            "accelerometer_rms_m_s2": float(reading.accelerometer[j].square().sum(-1).mean().sqrt()),
            "gyroscope_rms_rad_s": float(reading.gyroscope[j].square().sum(-1).mean().sqrt()),
            "largest_accelerometer_m_s2": float(reading.accelerometer[j].norm(dim=-1).max()),
            "change_with_frames_at_frame_rate_m_s2": float(change[j].square().sum(-1).mean().sqrt()),
        }
        for j, name in enumerate(names)
    }
    columns = list(next(iter(compared.values())))
    show(
        out,
        [
            Table(
                f"Share of acceleration that is kept, poses at {frame_rate:g} Hz; noise: m/s² from 1 mm, white",
                ["", *(f"{f:g} Hz" for f in at), "noise"],
                [
                    [name, *(f"{row[f'{f:g}']:.3f}" for f in at), f"{1e-3 * noises[name]:.2f}"]
                    for name, row in gains.items()
                ],
            ),
            Table(
                f"RMS error on a known motion, poses at {frame_rate:g} Hz, noise {noise[0]:g} mm, {noise[1]:g} mrad",
                ["rad/s and m/s²", *columns],
                [[name, *(f"{row[c]:.3f}" for c in columns)] for name, row in compared.items()],
            ),
            Table(
                f"{motion}: {len(names)} IMUs, {reading.gyroscope.shape[0] * reading.gyroscope.shape[1]} readings at "
                f"{rate:g} Hz in {seconds:.2f} s, bandwidth {bandwidth:g} Hz",
                ["joint", "gyroscope RMS [rad/s]", "accelerometer RMS [m/s²]", "largest",
                 f"change if every {every}. frame"],
                [
                    [
                        name, f"{x['gyroscope_rms_rad_s']:.2f}", f"{x['accelerometer_rms_m_s2']:.2f}",
                        f"{x['largest_accelerometer_m_s2']:.1f}", f"{x['change_with_frames_at_frame_rate_m_s2']:.2f}",
                    ]
                    for name, x in walk.items()
                ],
            ),
        ],
    )  # fmt: skip
    drawn = names.index(joint)
    draw(
        out,
        frequencies,
        curves,
        thin,
        drawn,
        joint,
        t[::every],
        poses[:, ::every],
        1.0 / float(t[::every].diff().median()),
    )
    return {
        "gains": gains, "noise_1_s2": noises, "against_truth": compared, "motion": walk, "seconds": seconds,
        "response": {"frequency_hz": frequencies, **curves},
    }  # fmt: skip


if __name__ == "__main__":
    run(experiment, smoke={"motion": "synthetic", "bandwidths": [10.0], "joint": "second"})
