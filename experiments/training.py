"""A spline layer inside a network: from gyroscope readings to orientation at any time.

The network sees what a gyroscope measured on random rotations and outputs the control points of a spline on SO(3);
the loss compares the spline's orientation at random times with the truth. Gradients reach the network through the
hand-derived reverse sweep.
"""

from pathlib import Path
from typing import Any

import torch
from common import Table, run, save, show
from matplotlib.figure import Figure
from torch import nn

from torchspline import SO3
from torchspline.functional import bspline

ORDER, POINTS, SAMPLES = 4, 8, 48


def random_rotations(count: int, generator: torch.Generator) -> torch.Tensor:
    """Control points (count, POINTS, 4) of smooth rotations that all start near the identity."""
    turns = 0.4 * torch.randn(count, POINTS, 3, generator=generator)
    return SO3.exp(turns.cumsum(dim=1) - turns[:, :1])


# The training script proper: twenty lines.
def train(steps: int, batch: int, learning_rate: float, generator: torch.Generator) -> list[float]:
    spline = {"group": SO3, "order": ORDER, "dt": 1.0}
    span = float(POINTS - ORDER + 1)
    network = nn.Sequential(nn.Linear(3 * SAMPLES, 256), nn.GELU(), nn.Linear(256, 256), nn.GELU())
    network.append(nn.Linear(256, POINTS * 4))
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, learning_rate, total_steps=steps)
    measured_at, losses = torch.linspace(0.0, span, SAMPLES), []
    for _ in range(steps):
        truth = random_rotations(batch, generator)
        gyroscope = bspline(truth, measured_at, derivatives=1, **spline).velocity
        control_points = network(gyroscope.flatten(1)).reshape(batch, POINTS, 4) + SO3.identity(
            dtype=torch.float32
        )
        times = span * torch.rand(32, generator=generator)
        predicted, wanted = (
            bspline(c, times, derivatives=0, **spline).value for c in (control_points, truth)
        )
        loss = SO3.log(SO3.between(predicted, wanted)).square().sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    return losses


def experiment(out: Path, steps: int, batch: int, learning_rate: float, seed: int) -> dict[str, Any]:
    """Train a network with a spline layer inside and report by how much its loss falls.

    Args:
        out: folder for the results.
        steps: of the optimiser.
        batch: trajectories a step; every step sees new ones.
        learning_rate: highest one of the schedule.
        seed: of the data and the network.
    """
    torch.manual_seed(seed)
    losses = train(steps, batch, learning_rate, torch.Generator().manual_seed(seed))
    first, last = losses[0], sum(losses[-10:]) / len(losses[-10:])
    rows = [
        ["first step", f"{first:.4g}"],
        ["last ten steps", f"{last:.4g}"],
        ["ratio", f"{first / last:.1f}"],
    ]
    show(out, [Table("Mean squared angle [rad²]", ["", "loss"], rows)])
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.semilogy(losses)
    axes.set(xlabel="step", ylabel="mean squared angle [rad²]", title="a spline layer inside a network")
    axes.grid(alpha=0.3)
    save(figure, out / "training.png")
    return {"first_loss_rad2": first, "last_loss_rad2": last, "ratio": first / last, "losses": losses}


if __name__ == "__main__":
    run(experiment, smoke={"steps": 20, "batch": 16})
