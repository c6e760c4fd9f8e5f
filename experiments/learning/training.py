"""Training on generated data, in one process or several."""

import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader

from learning.estimator import GROUP, Calibration, Calibrator, grouped, running
from torchspline import SO3
from torchspline.generate import GeneratedDataset, Recipe, items_per_block

#: s, over which orientation is compared.
LAGS = (1.0, 5.0, 10.0)


class Training(NamedTuple):
    """How to train: recipes of which every step sees `blocks` blocks each, and the usual numbers."""

    recipes: list[Recipe]
    lengths: list[float]
    steps: int
    blocks: int
    learning_rate: float
    width: int


def batches(training: Training, seed: int, world: int) -> Iterator[dict[str, Tensor]]:
    """Of this process; those of all processes together are the same whatever their number."""
    loaders = []
    for i, recipe in enumerate(training.recipes):
        size = items_per_block(recipe) * training.blocks
        if size % world or training.blocks % world:
            raise ValueError(
                f"blocks: expected a multiple of the number of processes, {world}, got {training.blocks}"
            )
        dataset = GeneratedDataset(recipe, seed=1000 * seed + i, count=size * training.steps)
        loaders.append(DataLoader(dataset, batch_size=size // world))
    for parts in zip(*loaders, strict=True):
        names = ("gyroscope", "accelerometer", "angular_velocity")
        yield {name: torch.cat([part[name] for part in parts]).to(torch.float64) for name in names}


def loss_of(model: nn.Module, batch: dict[str, Tensor], dt: float, lengths: list[float]) -> Tensor:
    """Angles between integrated and true orientation over each lag, and what is left of noise in the rate."""
    gyroscope, accelerometer, truth = (
        batch[name] for name in ("gyroscope", "accelerometer", "angular_velocity")
    )
    calibration, smooth = model(gyroscope, accelerometer, dt, lengths)
    corrected = calibration.correct(gyroscope, accelerometer).gyroscope
    angles = relative_angles(grouped(corrected), grouped(truth), GROUP * dt)
    # Logarithms, because sensors differ by orders of magnitude: all of them count alike.
    drift = torch.stack([(angle.square().mean(-1) + 1e-8).log().mean() for angle in angles]).mean()
    noise = (smooth - truth).diff(dim=1).square().mean((1, 2))
    return 0.5 * drift + 0.1 * (noise + 1e-10).log().mean()


def relative_angles(rate: Tensor, truth: Tensor, h: float) -> list[Tensor]:
    """Of rotations over each lag, rad, (B, pairs)."""
    turned, right = (running(SO3.exp(h * x, validate=False)) for x in (rate, truth))
    found = []
    for lag in LAGS:
        step = round(lag / h)
        if step >= rate.shape[1]:
            continue
        a, b = (SO3.between(x[:, :-step:5], x[:, step::5], validate=False) for x in (turned, right))
        found.append((SO3.log(SO3.between(a, b, validate=False)).square().sum(-1) + 1e-16).sqrt())
    return found


class _WithDenoising(nn.Module):
    """Calibrator and filter in one call, as several processes need it."""

    def __init__(self, model: Calibrator):
        super().__init__()
        self.model = model

    def forward(
        self, gyroscope: Tensor, accelerometer: Tensor, dt: float, lengths: list[float]
    ) -> tuple[Calibration, Tensor]:
        found = self.model(gyroscope, accelerometer, dt, lengths)
        rate = found.correct(gyroscope, accelerometer).gyroscope
        return found, self.model.denoised(rate)


def train(training: Training, seed: int, rank: int = 0, world: int = 1) -> tuple[Calibrator, list[float]]:
    """The trained network and the loss of each step (the mean over processes)."""
    torch.manual_seed(seed)
    model = Calibrator(training.width).to(torch.float64)
    whole: nn.Module = _WithDenoising(model)
    if world > 1:
        whole = DistributedDataParallel(whole)
    optimizer = torch.optim.Adam(whole.parameters(), lr=training.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, training.learning_rate, total_steps=max(training.steps, 2), pct_start=0.1
    )
    losses = []
    dt = 1.0 / training.recipes[0].rate
    for batch in islice(batches(training, seed, world), training.steps):
        loss = loss_of(whole, batch, dt, training.lengths)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(whole.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        mean = loss.detach().clone()
        if world > 1:
            dist.all_reduce(mean)
            mean /= world
        losses.append(mean.item())
    return model, losses


def train_in_processes(training: Training, seed: int, world: int, meeting: Path) -> list[float]:
    """The losses of `world` processes that train together (gloo, on the CPU).

    Args:
        meeting: a file that does not exist yet, through which they find each other.
    """
    context: Any = torch.multiprocessing.get_context("spawn")
    queue = context.SimpleQueue()
    torch.multiprocessing.spawn(_process, (training, seed, world, str(meeting), queue), nprocs=world)
    return queue.get()


def _process(rank: int, training: Training, seed: int, world: int, meeting: str, queue: Any) -> None:
    torch.set_num_threads(1)
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    dist.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=world)
    try:
        _, losses = train(training, seed, rank, world)
        if rank == 0:
            queue.put(losses)
    finally:
        dist.destroy_process_group()
