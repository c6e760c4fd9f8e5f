"""Robots: links against differences, a recorded run fitted, and joints from IMUs alone.

Rates of every link are compared with differences of its poses and with forward mode; what pytorch-kinematics does in
the same places is measured beside it. Then the log of encoders of a UR10e becomes a spline, whose velocity is compared
with the recorded one and with the noise of that. Last, IMUs are put on the links of that motion, and the joints are
found from their readings.
"""

import gzip
import time
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from common import ROOT, Table, run, save, show
from matplotlib.figure import Figure
from torch import Tensor

from torchspline import SE3, SO3, BSpline, Rn, Trajectory, fit, imu, use_kernels
from torchspline.robot import JointFit, Robot, fit_joints

DOUBLE = torch.float64
#: Differences of sixth order: first and second derivative.
FIRST = (-1 / 60, 3 / 20, -3 / 4, 0.0, 3 / 4, -3 / 20, 1 / 60)
SECOND = (1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90)
#: For runs without data: two turns, a slide, and a tool.
SYNTHETIC = """<robot name="synthetic">
  <link name="base"/> <link name="upper_arm"/> <link name="forearm"/> <link name="slider"/> <link name="tool"/>
  <joint name="pan" type="continuous"><parent link="base"/><child link="upper_arm"/>
    <origin xyz="0 0 0.4" rpy="0.3 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper_arm"/><child link="forearm"/>
    <origin xyz="0.5 0 0.1"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" velocity="9" effort="9"/></joint>
  <joint name="reach" type="prismatic"><parent link="forearm"/><child link="slider"/>
    <origin xyz="0.1 0.2 0"/><axis xyz="1 0 0"/><limit lower="-9" upper="9" velocity="9" effort="9"/></joint>
  <joint name="flange" type="fixed"><parent link="slider"/><child link="tool"/><origin xyz="0.1 0 0"/></joint>
</robot>"""


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def description(data: Path, name: str) -> str:
    return SYNTHETIC if name == "synthetic" else (data / f"{name}.urdf").read_text()


def end_of(robot: Robot) -> str:
    """The link that most joints move."""
    q = normal(robot.dof, seed=0)
    rates = robot.motion(robot.links, q.expand(robot.dof, -1), torch.eye(robot.dof, dtype=DOUBLE)).velocity
    assert rates is not None
    return robot.links[int((rates.abs().amax(-1) > 0).sum(-1).argmax())]


# ---------------------------------------------------------------------- links


def velocity_of(trajectory: Trajectory, t: Tensor) -> Tensor:
    state = trajectory.evaluate(t, derivatives=1)
    assert state.velocity is not None
    return state.velocity


def differences(robot: Robot, samples: int, seed: int) -> dict[str, float]:
    """Largest errors of twist and acceleration over links and times, as shares of the largest values."""
    spline = BSpline(normal(24, robot.dof, seed=seed), group=Rn(robot.dof), order=6, dt=0.4, learnable=False)
    links = robot.link(spline, robot.links)
    # In the middle of segments: differences must not reach over knots.
    generator = torch.Generator().manual_seed(seed)
    t = 0.4 * (torch.randint(19, (samples,), generator=generator) + 0.3)
    t, h = (t + 0.16 * torch.rand(samples, generator=generator)).to(DOUBLE), 0.008
    around = links(t[:, None] + h * torch.arange(-3, 4, dtype=DOUBLE))  # (L, N, 7, 7)
    first, second = torch.tensor(FIRST, dtype=DOUBLE) / h, torch.tensor(SECOND, dtype=DOUBLE) / h**2
    motion = links.kinematics(t)
    assert motion.rotation is not None
    # Rotations near the middle one, as vectors: their first derivative is w, their second its derivative.
    turns = SO3.log(SO3.between(motion.rotation.unsqueeze(-2), around[..., 3:]))
    pairs = {
        "velocity": (motion.velocity, torch.einsum("k,lnkc->lnc", first, around[..., :3])),
        "angular velocity": (motion.angular_velocity, torch.einsum("k,lnkc->lnc", first, turns)),
        "acceleration": (motion.acceleration, torch.einsum("k,lnkc->lnc", second, around[..., :3])),
        "angular acceleration": (motion.angular_acceleration, torch.einsum("k,lnkc->lnc", second, turns)),
    }
    found = {}
    for name, (x, y) in pairs.items():
        assert x is not None
        found[name] = float((x - y).abs().max() / y.abs().max())
    forward = torch.func.jvp(partial(velocity_of, links), (t,), (torch.ones_like(t),))[1]
    exact = links.evaluate(t).acceleration
    assert exact is not None
    found["acceleration, forward mode"] = float((exact - forward).abs().max() / forward.abs().max())
    return found


def gradients(robot: Robot, seed: int) -> float:
    """Largest error of gradients of all readings of an IMU on the last link to control points, against differences."""
    points = normal(8, robot.dof, seed=seed).requires_grad_()
    t, end = torch.linspace(0.05, 1.0, 5, dtype=DOUBLE), end_of(robot)
    weights = normal(2, 5, 3, seed=seed + 1)

    def loss(points: Tensor) -> Tensor:
        spline = BSpline(points, group=Rn(robot.dof), order=6, dt=0.4, learnable=False)
        return (torch.stack(imu.measure(robot.link(spline, end), t)) * weights).sum()

    (gradient,) = torch.autograd.grad(loss(points), points)
    flat, h = points.detach().flatten(), 1e-3
    steps = h * torch.eye(len(flat), dtype=DOUBLE)
    with torch.no_grad():
        moved = [
            torch.stack(
                [c * loss((flat + (i - 3) * step).view_as(points)) for i, c in enumerate(FIRST) if c]
            ).sum()
            / h
            for step in steps
        ]
    return float((gradient.flatten() - torch.stack(moved)).abs().max() / gradient.abs().max())


def peers(text: str, robot: Robot, samples: int, seed: int) -> dict[str, Any]:
    """What pytorch-kinematics does with the same robot: offsets, double backward, `vmap`, time."""
    import pytorch_kinematics as pk

    chain = pk.build_chain_from_urdf(text.encode()).to(dtype=DOUBLE)
    q, last = normal(samples, robot.dof, seed=seed), end_of(robot)
    index = chain.frame_to_idx[last]
    theirs = chain.forward_kinematics_tensor(q)[index]
    offsets = float((SE3.to_matrix(robot.motion(last, q).value) - theirs).abs().max())

    def twice(pose: Any) -> Tensor:
        x = q[:1].clone().requires_grad_()
        (g,) = torch.autograd.grad(pose(x)[..., :3, 3].square().sum(), x, create_graph=True)
        if not g.requires_grad:
            return torch.full_like(x, torch.nan)
        return torch.autograd.grad(g.square().sum(), x)[0]

    ours = twice(lambda x: SE3.to_matrix(robot.motion(last, x).value))
    scale = ours.abs().max()
    default = twice(lambda x: chain.forward_kinematics_tensor(x)[index])
    exact = twice(lambda x: chain.forward_kinematics_tensor(x, analytical_grad=False)[index])
    try:
        torch.func.vmap(lambda x: chain.forward_kinematics(x)[last].get_matrix())(q[:4])
        vmapped = "works"
    except Exception as reason:  # whatever it is, that is the finding
        vmapped = f"fails: {type(reason).__name__}"
    clocks = {}
    for name, call in (
        ("pytorch-kinematics, pose", lambda: chain.forward_kinematics_tensor(q)),
        ("here, pose", lambda: robot.motion(last, q)),
        ("here, pose, twist, acceleration", lambda: robot.motion(last, q, q, q)),
    ):
        best = np.inf
        for _ in range(5):
            since = time.perf_counter()
            with torch.no_grad():
                call()
            best = min(best, time.perf_counter() - since)
        clocks[name] = best / samples * 1e6
    return {
        "largest difference of poses (their offsets are float32)": offsets,
        "double backward off, default": float((default - ours).abs().max() / scale),
        "double backward off, analytical_grad=False": float((exact - ours).abs().max() / scale),
        "vmap over forward_kinematics": vmapped,
        **{f"{name}, us per configuration": value for name, value in clocks.items()},
    }


# ---------------------------------------------------------------------- a recorded run


def read_log(data: Path, log: str, robot: Robot, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Times, positions and velocities; "synthetic" makes some."""
    if log != "synthetic":
        with gzip.open(data / log, "rt") as file:
            table = torch.from_numpy(np.loadtxt(file, delimiter=","))
        return table[:, 0], table[:, 1 : 1 + robot.dof], table[:, 1 + robot.dof : 1 + 2 * robot.dof]
    t = 392.0 + torch.arange(0.0, 2.0, 0.01, dtype=DOUBLE)
    phase = 2.0 * (t[:, None] - 392.0) + normal(robot.dof, seed=seed)
    q, rate = torch.sin(phase), 2.0 * torch.cos(phase)
    return t, q + 5e-5 * normal(*q.shape, seed=seed + 1), rate + 2e-3 * normal(*q.shape, seed=seed + 2)


def noise_of(t: Tensor, x: Tensor, count: int = 9) -> Tensor:
    """Standard deviation of each column about cubics through so many neighbours, (dof,): no spline involved."""
    times, values = t.unfold(0, count, 1), x.unfold(0, count, 1)  # (W, count), (W, dof, count)
    s = (times - times.mean(-1, keepdim=True)) / (times[:, -1:] - times[:, :1])
    basis, _ = torch.linalg.qr(s[:, :, None] ** torch.arange(4))
    rest = values - (values @ basis) @ basis.mT
    return (rest.square().sum(-1).mean(0) / (count - 4)).sqrt()


def delay_of(fitted: JointFit, j: int, t: Tensor, q: Tensor, rate: Tensor) -> tuple[float, float]:
    """How late the recorded velocity of a joint is, s, and its standard deviation, as an unknown of `fit.Problem`."""
    spline = fitted.trajectory
    assert fitted.velocity_sigma is not None
    sigmas = fitted.position_sigma[j], fitted.velocity_sigma[j]
    one = BSpline(
        spline.control_points.detach()[:, j : j + 1],
        group=Rn(1), order=spline.order, dt=fitted.spacing, t0=spline.domain[0],
    )  # fmt: skip
    delay = fit.Variable("delay", torch.zeros(1, dtype=DOUBLE))
    problem = fit.Problem(one)
    problem.add(fit.StateValue(t, q[:, j : j + 1], sigma=float(sigmas[0])))
    problem.add(
        fit.StateVelocity(
            t, rate[:, j : j + 1], sigma=float(sigmas[1]), clock=fit.Clock(offset=delay), name="rate"
        )
    )
    result = problem.solve()
    return float(delay.value), float(result.standard_deviation(delay))


def recorded(
    robot: Robot, t: Tensor, q: Tensor, rate: Tensor, spacing: float | Literal["auto"]
) -> tuple[JointFit, dict[str, Any]]:
    since = time.perf_counter()
    fitted = fit_joints(t, q, rate, dt=spacing, estimate_delay=True)
    seconds = time.perf_counter() - since
    assert fitted.velocity_residual is not None
    assert fitted.velocity_sigma is not None
    assert fitted.velocity_delay is not None
    at_once = fit_joints(
        t, q, rate, dt=fitted.spacing,
        position_sigma=fitted.position_sigma, velocity_sigma=fitted.velocity_sigma,
    )  # fmt: skip
    assert at_once.velocity_residual is not None
    alone = fit_joints(t, q, dt=fitted.spacing, position_sigma=fitted.position_sigma)
    derived = velocity_of(alone.trajectory, t).detach()
    rows, local = {}, noise_of(t, rate)
    for j, joint in enumerate(robot.joints):
        late, sure = delay_of(fitted, j, t, q, rate)
        noise = float(fitted.velocity_sigma[j])
        rows[joint.name] = {
            "position_noise_rad": float(fitted.position_sigma[j]),
            "position_residual_rad": float(fitted.position_residual[:, j].square().mean().sqrt()),
            "velocity_noise_rad_s": noise,
            "velocity_noise_local_cubics_rad_s": float(local[j]),
            "velocity_residual_rad_s": float(fitted.velocity_residual[:, j].square().nanmean().sqrt()),
            "velocity_residual_positions_only_rad_s": float((rate - derived)[:, j].square().mean().sqrt()),
            "velocity_residual_no_delay_rad_s": float(at_once.velocity_residual[:, j].square().mean().sqrt()),
            "velocity_late_s": float(fitted.velocity_delay[j]),
            "velocity_late_by_another_solver_s": late,
            "velocity_late_sigma_s": sure,
        }
    over = [x._asdict() for x in robot.over_limits(fitted.trajectory, t)]
    return fitted, {
        "joints": rows, "spacing_s": fitted.spacing, "notes": fitted.notes, "beyond_limits": over, "seconds": seconds,
        "samples": len(t),
    }  # fmt: skip


# ---------------------------------------------------------------------- joints from IMUs


def from_imus(
    robot: Robot, fitted: JointFit, links: list[str], window: tuple[float, float], rate: float,
    noise: tuple[float, float], disturbance: float, seed: int,
) -> tuple[dict[str, Any], Tensor, Tensor, Tensor]:  # fmt: skip
    """Joints from gyroscopes and accelerometers on links, and three encoder readings at the start.

    A joint about the vertical turns nothing that an IMU at rest sees; the readings say where it starts.
    """
    full = fitted.trajectory
    dt, (start, end) = fitted.spacing, full.domain
    first = max(int((window[0] - start) / dt), 0)
    last = min(int((window[1] - start) / dt), round((end - start) / dt))
    points = full.control_points.detach()[first : last + full.order - 1]
    options: dict[str, Any] = {"group": full.group, "order": full.order, "dt": dt, "t0": start + first * dt}
    truth = BSpline(points, learnable=False, **options)
    t = torch.arange(truth.domain[0], truth.domain[1], 1.0 / rate, dtype=DOUBLE)
    spline = BSpline(points + disturbance * normal(*points.shape, seed=seed), **options)
    problem = fit.Problem(spline)
    kinds: list[type[fit.Gyroscope] | type[fit.Accelerometer]] = [fit.Gyroscope, fit.Accelerometer]
    for i, link in enumerate(links):
        reading = imu.measure(robot.link(truth, link), t)
        for k, (kind, ideal) in enumerate(zip(kinds, reading, strict=True)):
            made = ideal + noise[k] * normal(*ideal.shape, seed=seed + 1 + 2 * i + k)
            problem.add(robot.residual(link, kind, t, made, sigma=noise[k]))
    problem.add(fit.StateValue(t[:3], truth(t[:3]), sigma=1e-4))
    since = time.perf_counter()
    result = problem.solve()
    seconds = time.perf_counter() - since
    error = (spline(t) - truth(t)).detach()
    few = t[:: max(len(t) // 50, 1)]
    sure = result.trajectory_covariance(few).diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    return {
        "imus": len(links),
        "readings": 2 * len(links) * len(t),
        "converged": result.converged,
        "evaluations": result.evaluations,
        "seconds": seconds,
        "variance_factor": result.variance_factor,
        "start_off_rad": disturbance,
        "rms_error_rad": dict(zip(robot.joint_names, error.square().mean(0).sqrt().tolist(), strict=True)),
        "predicted_rad": dict(zip(robot.joint_names, sure.tolist(), strict=True)),
    }, t, error, torch.cat(list(imu.measure(robot.link(truth, links[-1]), t)), -1)  # fmt: skip


# ---------------------------------------------------------------------- the run


def draw(
    out: Path,
    robot: Robot,
    t: Tensor,
    rate: Tensor,
    fitted: JointFit,
    times: Tensor,
    error: Tensor,
    reading: Tensor,
):
    figure = Figure(figsize=(13, 10), layout="constrained")
    axes = figure.subplots(2, 2)
    shown = (t - t[0] > 0.45 * (t[-1] - t[0])) & (t - t[0] < 0.55 * (t[-1] - t[0]))
    dense = torch.linspace(float(t[shown][0]), float(t[shown][-1]), 800, dtype=DOUBLE)
    velocity = velocity_of(fitted.trajectory, dense).detach()
    assert fitted.velocity_residual is not None
    assert fitted.velocity_sigma is not None
    for j, name in enumerate(robot.joint_names):
        axes[0, 0].plot(t[shown], rate[shown, j], ".", color=f"C{j}", alpha=0.4)
        axes[0, 0].plot(dense, velocity[:, j], color=f"C{j}", label=name)
        axes[0, 1].plot(
            t,
            fitted.velocity_residual[:, j] / fitted.velocity_sigma[j] + 12 * j,
            color=f"C{j}",
            linewidth=0.6,
        )
        axes[1, 1].plot(times, 1e3 * error[:, j], color=f"C{j}", label=name)
    axes[0, 0].set(title="velocity of joints: recorded (dots), spline", xlabel="time [s]", ylabel="rad/s")
    axes[0, 1].set(title="recorded minus spline, in standard deviations (12 apart)", xlabel="time [s]")
    axes[1, 0].plot(times, reading[:, 3:], label=["x", "y", "z"])
    axes[1, 0].set(title="accelerometer on the last link", xlabel="time [s]", ylabel="m/s²")
    axes[1, 1].set(title="joints from IMUs on links: error", xlabel="time [s]", ylabel="mrad")
    for ax in axes.flat:
        ax.grid(alpha=0.3)
    for ax in (axes[0, 0], axes[1, 0], axes[1, 1]):
        ax.legend(fontsize=8)
    save(figure, out / "robot.png")


def experiment(
    out: Path, data: str, robots: list[str], samples: int, log: str, log_robot: str,
    spacing: float | Literal["auto"],
    links: list[str], window: tuple[float, float], rate: float, noise: tuple[float, float],
    disturbance: float, seed: int,
) -> dict[str, Any]:  # fmt: skip
    """Links against differences, a recorded run fitted, joints from IMUs.

    Args:
        out: folder for the results.
        data: folder of descriptions and of the log, from the root of the project.
        robots: URDF files there, without ending; "synthetic" needs no data.
        samples: times at which links are compared with differences.
        log: file of the recorded run, "synthetic" for a made one.
        log_robot: whose it is.
        spacing: of its knots, s, or "auto".
        links: that carry IMUs.
        window: of the run, s, where joints are estimated from these.
        rate: of the IMUs, Hz.
        noise: of gyroscopes and accelerometers a reading, rad/s and m/s^2.
        disturbance: of the control points that the estimate starts from, rad.
        seed: of motions and noise.
    """
    folder = ROOT / data
    with use_kernels("reference"):  # nothing here is worth waiting for loops to compile
        rates, others = {}, {}
        for name in robots:
            text = description(folder, name)
            robot = Robot.from_urdf(text)
            rates[name] = {
                **differences(robot, samples, seed),
                "gradients of IMU readings": gradients(robot, seed),
            }
            others[name] = peers(text, robot, samples, seed)
        robot = Robot.from_urdf(description(folder, log_robot))
        t, q, velocity = read_log(folder, log, robot, seed)
        fitted, figures = recorded(robot, t, q, velocity, spacing)
        imus, times, error, reading = from_imus(robot, fitted, links, window, rate, noise, disturbance, seed)
    header = list(next(iter(rates.values())))
    show(
        out,
        [
            Table(
                "Rates of all links: largest difference from differences of poses, relative",
                ["robot", *header],
                [[name, *(f"{x[key]:.1e}" for key in header)] for name, x in rates.items()],
            ),
            Table(
                "pytorch-kinematics on the same robots",
                ["", *others],
                [
                    [key, *(x if isinstance(x := o[key], str) else f"{x:.3g}" for o in others.values())]
                    for key in next(iter(others.values()))
                ],
            ),
            Table(
                f"{log}: {len(t)} samples, knots {fitted.spacing * 1e3:.1f} ms apart, {figures['seconds']:.2f} s; "
                "mrad, mrad/s, ms",
                ["joint", "position noise", "residual", "velocity noise", "by local cubics", "residual",
                 "without delays", "from positions only", "velocities late by", "by fit.Problem"],
                [
                    [
                        name, *(f"{1e3 * x[key]:.3f}" for key in (
                            "position_noise_rad", "position_residual_rad", "velocity_noise_rad_s",
                            "velocity_noise_local_cubics_rad_s", "velocity_residual_rad_s",
                            "velocity_residual_no_delay_rad_s", "velocity_residual_positions_only_rad_s",
                        )),
                        f"{1e3 * x['velocity_late_s']:.2f}",
                        f"{1e3 * x['velocity_late_by_another_solver_s']:.2f} ± {1e3 * x['velocity_late_sigma_s']:.2f}",
                    ]
                    for name, x in figures["joints"].items()
                ],
            ),
            Table(
                f"Joints from {imus['imus']} IMUs on links, {imus['readings']} readings, "
                f"{imus['evaluations']} evaluations in {imus['seconds']:.1f} s, "
                f"variance factor {imus['variance_factor']:.3f}",
                ["joint", "RMS error [mrad]", "predicted [mrad]"],
                [
                    [name, f"{1e3 * imus['rms_error_rad'][name]:.3f}", f"{1e3 * imus['predicted_rad'][name]:.3f}"]
                    for name in robot.joint_names
                ],
            ),
        ],
    )  # fmt: skip
    draw(out, robot, t, velocity, fitted, times, error, reading)
    return {"links": rates, "peers": others, "log": figures, "imus": imus}


if __name__ == "__main__":
    run(
        experiment,
        smoke={
            "robots": ["synthetic"], "samples": 50, "log": "synthetic", "log_robot": "synthetic",
            "links": ["upper_arm", "forearm", "tool"], "window": (392.0, 393.0), "rate": 100.0,
        },
    )  # fmt: skip
