"""Quintic Hermite splines: what [E17] promises, measured.

Boundary conditions, continuity across joints, differentials, and the order in which a spline through samples
of a smooth motion approaches that motion; then [E17]'s motivating example, a spline on SE(3) fitted to a
gyroscope and an accelerometer.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import Table, run, save, show
from matplotlib.figure import Figure
from scipy.optimize import least_squares
from torch import Tensor

from torchspline import SE3, SO3, Group, HermiteSpline, Rn, imu
from torchspline.functional import hermite
from torchspline.splines.trajectory import to_world_frame

DOUBLE = torch.float64
KINDS = ("product", "logarithm")
OUTPUTS = ("value", "velocity", "acceleration")


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


# ---------------------------------------------------------------------- a motion that is no spline


class Motion:
    """A product of exponentials of sines, with rates by automatic differentiation; or of one of them, which commute."""

    def __init__(self, group: Group, seed: int, commuting: bool = False):
        self.group, self.commuting = group, commuting
        self.axes = normal(3, group.tangent_size, seed=seed)

    def value(self, t: Tensor) -> Tensor:
        a, b, c = self.axes
        first = torch.sin(1.3 * t)[:, None] * a
        if self.commuting:
            return self.group.exp(first, validate=False)
        first = first + torch.cos(0.7 * t)[:, None] * b
        second = (0.3 * t * t)[:, None] * c
        exp = self.group.exp
        return self.group.compose(exp(first, validate=False), exp(second, validate=False), validate=False)

    def states(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Value, velocity and acceleration in the body frame: `Log(X(t)^-1 X(t + s))` by s is the velocity at s = 0."""
        group = self.group

        def velocity(t: Tensor) -> Tensor:
            base = self.value(t)

            def ahead(s: Tensor) -> Tensor:
                return group.log(group.between(base, self.value(t + s), validate=False), validate=False)

            return torch.func.jvp(ahead, (torch.zeros_like(t),), (torch.ones_like(t),))[1]

        rate, second = torch.func.jvp(velocity, (t,), (torch.ones_like(t),))
        return self.value(t), rate, second


def errors(motion: Motion, segments: int, duration: float, coordinates: str, t: Tensor) -> list[float]:
    """Largest distance of value, velocity and acceleration from the motion."""
    times = torch.linspace(0.0, duration, segments + 1, dtype=DOUBLE)
    spline = HermiteSpline(
        *motion.states(times), group=motion.group, times=times, coordinates=coordinates, learnable=False
    )
    state, (value, *rates) = spline.evaluate(t), motion.states(t)
    step = motion.group.log(motion.group.between(value, state.value))
    return [float(x.abs().max()) for x in (step, *(a - b for a, b in zip(state[1:3], rates, strict=True)))]


def convergence(segments: list[int], duration: float, seed: int) -> dict[str, dict[str, Any]]:
    """For each motion and kind: errors, one row for each number of segments, and the orders between the finest ones."""
    t = torch.linspace(0.0, duration, 1001, dtype=DOUBLE)
    motions = {
        "SO3": Motion(SO3, seed),
        "SE3": Motion(SE3, seed),
        "SE3, factors that commute": Motion(SE3, seed, commuting=True),
        "R3": Motion(Rn(3), seed),
    }
    found = {}
    for name, motion in motions.items():
        for kind in KINDS:
            table = np.array([errors(motion, n, duration, kind, t) for n in segments])
            # The slope where rounding does not show yet.
            orders = []
            for column in table.T:
                seen = [i for i, e in enumerate(column) if e > 3e-11]
                i, j = seen[-2:] if len(seen) > 1 else (0, 1)
                orders.append(float(np.log(column[i] / column[j]) / np.log(segments[j] / segments[i])))
            found[f"{name}, {kind}"] = {"errors": table.tolist(), "orders": orders}
    return found


# ---------------------------------------------------------------------- what holds to rounding


def random_spline(group: Group, kind: str, frame: str, seed: int) -> tuple[HermiteSpline, tuple[Tensor, ...]]:
    times = torch.tensor([0.0, 0.8, 1.1, 2.3], dtype=DOUBLE)
    values = group.random(4, generator=torch.Generator().manual_seed(seed))
    knots = (
        values,
        normal(4, group.tangent_size, seed=seed + 1),
        normal(4, group.tangent_size, seed=seed + 2),
    )
    return HermiteSpline(
        *knots, group=group, times=times, coordinates=kind, frame=frame, learnable=False
    ), knots


def ends(group: Group, kind: str, frame: str, seed: int) -> float:
    """Largest error of a boundary condition [E17] (82)-(85), from both sides of every knot, which also is C2."""
    spline, (X, v, a) = random_spline(group, kind, frame, seed)
    worst = 0.0
    for i in range(3):  # every segment by itself: its ends are one-sided limits
        part = slice(i, i + 2)
        alone = HermiteSpline(
            *(x[part] for x in (X, v, a)), times=spline.times[part], learnable=False,
            group=group, coordinates=spline.coordinates, frame=spline.frame,
        )  # fmt: skip
        state = alone.evaluate(spline.times[part], frame=frame)
        step = group.log(group.between(X[part], state.value))
        assert state.velocity is not None
        assert state.acceleration is not None
        worst = max(
            worst,
            *(float(x.abs().max()) for x in (step, state.velocity - v[part], state.acceleration - a[part])),
        )
    return worst


def differentials(group: Group, kind: str, frame: str, seed: int) -> float:
    """Largest difference between `HermiteSpline.differentials` and forward mode through the whole spline."""
    spline, (X, v, a) = random_spline(group, kind, frame, seed)
    t = torch.tensor([0.3, 0.95, 2.0], dtype=DOUBLE)
    base, found = spline(t), spline.differentials(t, side="left")

    def outputs(delta: Tensor, v: Tensor, a: Tensor) -> Tensor:
        moved = group.retract(X, delta, validate=False)
        state = hermite(
            moved, v, a, t, group=group, times=spline.times, coordinates=spline.coordinates, frame=spline.frame,
            validate=False,
        )  # fmt: skip
        step = group.compose(state.value, group.inverse(base, validate=False), validate=False)
        state = to_world_frame(state, group) if frame == "world" else state
        return torch.stack([group.log(step, validate=False), *state[1:3]], dim=-2)

    blocks = torch.func.jacfwd(outputs, (0, 1, 2))(torch.zeros_like(v), v, a)
    worst = 0.0
    for q, i in enumerate(found.segment.tolist()):
        expected = torch.stack([blocks[k // 2][q][:, :, i + k % 2] for k in range(6)], dim=1)
        worst = max(worst, float((found.jacobian[q] - expected).abs().max()))
    return worst


# ---------------------------------------------------------------------- [E17] 1.1: gyroscope and accelerometer


def fit_imu(readings: int, knots: int, iterations: int, duration: float, seed: int) -> dict[str, Any]:
    """A spline on SE(3) from what an IMU reads on it; the first pose and velocity are known, as they have to be."""
    motion = Motion(SE3, seed + 3)
    t = torch.linspace(0.0, duration, readings, dtype=DOUBLE)
    times = torch.linspace(0.0, duration, knots, dtype=DOUBLE)
    dense = torch.linspace(0.0, duration, 401, dtype=DOUBLE)
    truth = HermiteSpline(
        *motion.states(dense), group=SE3, times=dense, coordinates="logarithm", learnable=False
    )
    measured = imu.measure(truth, t)
    gyroscope = measured.gyroscope + 1e-3 * normal(readings, 3, seed=seed + 4)
    accelerometer = measured.accelerometer + 1e-2 * normal(readings, 3, seed=seed + 5)
    X0, v0, a0 = (x[:1] for x in motion.states(times))

    def spline(x: Tensor) -> HermiteSpline:
        """From local coordinates (knots, 18): poses perturbed on the right of the first one, rates."""
        values = SE3.compose(X0.expand(knots, 7), SE3.exp(x[:, :6], validate=False), validate=False)
        anchor = torch.zeros(knots, 1, dtype=DOUBLE)
        anchor[0] = 1.0
        values = anchor * X0 + (1 - anchor) * values
        velocities = anchor * v0 + (1 - anchor) * x[:, 6:12]
        return HermiteSpline(
            values, velocities, x[:, 12:], group=SE3, times=times, coordinates="logarithm", learnable=False,
            validate=False,
        )  # fmt: skip

    def residuals(x: Tensor) -> Tensor:
        reading = imu.measure(spline(x.reshape(knots, 18)), t)
        rows = [(reading.gyroscope - gyroscope) / 1e-3, (reading.accelerometer - accelerometer) / 1e-2]
        return torch.cat(rows).flatten()

    start = torch.zeros(knots, 18, dtype=DOUBLE)
    start[:, :6] = (times[:, None]) * v0
    start[:, 6:12], start[:, 12:] = v0, a0
    jacobian = torch.func.jacrev(residuals)
    solution = least_squares(
        lambda x: residuals(torch.as_tensor(x)).detach().numpy(),
        start.flatten().numpy(),
        jac=lambda x: jacobian(torch.as_tensor(x)).detach().numpy(),
        method="trf",
        max_nfev=iterations,
    )
    fitted = spline(torch.as_tensor(solution.x).reshape(knots, 18))
    ours, exact = fitted.kinematics(t), truth.kinematics(t)
    assert ours.position is not None
    assert exact.position is not None
    rotation = SO3.log(SO3.between(ours.rotation, exact.rotation)).norm(dim=-1)
    return {
        "position_rmse_m": float((ours.position - exact.position).square().sum(-1).mean().sqrt()),
        "rotation_rmse_rad": float(rotation.square().mean().sqrt()),
        "residual_rms": float(np.sqrt(np.mean(solution.fun**2))),
        "first_residual_rms": float(residuals(start.flatten()).square().mean().sqrt()),
        "evaluations": int(solution.nfev),
        "why_stopped": solution.message,
        "_paths": [ours.position.detach().numpy(), exact.position.detach().numpy()],
    }


# ---------------------------------------------------------------------- the run


def draw(out: Path, found: dict[str, Any], segments: list[int], paths: list[Any]) -> None:
    figure = Figure(figsize=(15, 8), layout="constrained")
    axes = figure.subplots(2, 4)
    for ax, (name, results) in zip(axes.flat, found.items(), strict=True):
        for output, column, order in zip(
            OUTPUTS, np.array(results["errors"]).T, results["orders"], strict=True
        ):
            ax.loglog(segments, np.maximum(column, 1e-17), "o-", label=f"{output}: order {order:.2f}")
        ax.set(title=name, xlabel="segments", ylabel="largest error")
        ax.grid(alpha=0.3)
        ax.legend()
    save(figure, out / "convergence.png")
    figure = Figure(figsize=(7, 4), layout="constrained")
    ax = figure.subplots()
    for i, axis in enumerate("xyz"):
        ax.plot(paths[1][:, i], color="0.6", linewidth=4, label="truth" if i == 0 else None)
        ax.plot(paths[0][:, i], label=f"{axis}, from gyroscope and accelerometer")
    ax.set(xlabel="reading", ylabel="position [m]", title="a Hermite spline on SE(3) fitted to an IMU")
    ax.legend()
    save(figure, out / "imu_fit.png")


def experiment(
    out: Path, segments: list[int], duration: float, readings: int, knots: int, iterations: int, seed: int
) -> dict[str, Any]:
    """Boundary conditions, differentials and order of convergence of Hermite splines, and a fit to IMU readings.

    Args:
        out: folder for the results.
        segments: numbers of segments for the order of convergence.
        duration: of the motions, s.
        readings: of the IMU in the fit.
        knots: of the fitted spline.
        iterations: of the fit, at most.
        seed: of motions, knots and noise.
    """
    groups = (SO3, SE3, Group("DualQuaternion"), Group("SE2"), Group("R3xSO3"))
    exactness = {
        f"{group}, {kind}, {frame}": {
            "boundary_conditions": ends(group, kind, frame, seed),
            "differentials": differentials(group, kind, frame, seed),
        }
        for group in groups
        for kind in KINDS
        for frame in ("body", "world")
    }
    found = convergence(segments, duration, seed)
    fit = fit_imu(readings, knots, iterations, duration, seed)
    paths = fit.pop("_paths")
    rows = [[name, *(f"{x:.1e}" for x in case.values())] for name, case in exactness.items()]
    orders = [[name, *(f"{x:.2f}" for x in case["orders"])] for name, case in found.items()]
    fitted = [[name, f"{x:.4g}" if isinstance(x, float) else x] for name, x in fit.items()]
    show(
        out,
        [
            Table(
                "Largest errors: boundary conditions and C2 at the joints; differentials against forward mode",
                ["spline", "boundary conditions", "differentials"],
                rows,
            ),
            Table("Order of convergence", ["motion", *OUTPUTS], orders),
            Table("A spline on SE(3) fitted to a gyroscope and an accelerometer", ["", ""], fitted),
        ],
    )
    draw(out, found, segments, paths)
    return {"exactness": exactness, "convergence": found, "imu_fit": fit}


if __name__ == "__main__":
    run(experiment, smoke={"segments": [4, 8], "readings": 30, "knots": 4, "iterations": 3})
