"""Random inertial data made while a network trains on it."""

from collections.abc import Iterator
from typing import Any

from torch.utils.data import IterableDataset, get_worker_info

from torchspline import checks
from torchspline.generate.blocks import compute_block, items_per_block, rows
from torchspline.generate.processes import rank_and_world
from torchspline.generate.recipe import Recipe


class GeneratedDataset(IterableDataset):
    """Items `start` to `start + count - 1` of a data set without end, each determined by the seed and its index.

    Processes and workers take turns in blocks of items, which is how these are computed; the bits of an item do not
    depend on who computes it, nor on what else is asked for. With several processes (as `torchrun` starts them, or as
    `torch.distributed` knows them) each of them sees its share; shares are equal if `count` is a multiple of
    `items_per_block(recipe)` times the number of processes times that of workers.

    Items are dictionaries: `index`; `motion`, a word; `motion_parameters`, JSON; `time` (N,) s, `gyroscope`,
    `accelerometer` (N, 3), what the sensor says; `angular_velocity`, `specific_force` (N, 3), what it should say;
    `gyroscope_bias`, `accelerometer_bias` (N, 3); `rotation` (N, 4), `position`, `velocity` (N, 3) of the body in the
    world; `control_points` (M, 7) of its `SplitBSpline` of order 6; what was drawn of the sensor, as
    `sensor_gyroscope_scale` etc.; where samples get lost, `valid` (N,), 0 for those. Units are rad/s, m/s^2, m and s.
    `DataLoader(dataset, batch_size=..., num_workers=...)` makes batches of them.

    Args:
        recipe: what they are drawn from.
        seed: of all random numbers, 0 or more.
        count: how many; None: without end.
        start: index of the first, for training that goes on after an interruption.
    Raises:
        TypeError, ValueError: a wrong type or value.
    """

    def __init__(self, recipe: Recipe, seed: int, count: int | None = None, start: int = 0):
        checks.instance("recipe", recipe, Recipe, "a Recipe")
        checks.whole("seed", seed, 0)
        if count is not None:
            checks.whole("count", count, 0)
        checks.whole("start", start, 0)
        self.recipe, self.seed, self.count, self.start = recipe, seed, count, start

    def __iter__(self) -> Iterator[dict[str, Any]]:
        rank, world = rank_and_world()
        info = get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        size = items_per_block(self.recipe)
        end = None if self.count is None else self.start + self.count
        number = self.start // size + rank * workers + worker
        while end is None or number * size < end:
            first = number * size
            stop = size if end is None else min(end - first, size)
            columns = rows(compute_block(self.recipe, self.seed, number), max(self.start - first, 0), stop)
            for i in range(len(columns["index"])):
                yield {name: x[i] for name, x in columns.items()}
            number += world * workers
