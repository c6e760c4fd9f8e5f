"""Items of a data set in blocks, the unit in which they are computed.

An item is a row of a block, and a block depends on the recipe, the seed and its own number alone: it is always
computed whole and on one thread, because vectorised functions round differently at the end of a stretch of numbers than
inside of it. So an item has the same bits whoever asks for it.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from torchspline import checks
from torchspline.generate.motions.motion import ORDER
from torchspline.generate.recipe import Recipe
from torchspline.generate.sensors import draw_sensor, simulate
from torchspline.generate.trajectories import REST, control_points, draw_motion
from torchspline.imu.noise import item_generator
from torchspline.splines import SplitBSpline

#: Readings that a block has at most, unless a single item has more, and items.
_MOST_READINGS, _MOST_ITEMS = 2**17, 256

#: A column of items: numbers, or words.
Column = Tensor | list[str]


def items_per_block(recipe: Recipe) -> int:
    """A power of two, so that shards of usual sizes are made of whole blocks."""
    checks.instance("recipe", recipe, Recipe, "a Recipe")
    wanted = max(1, min(_MOST_ITEMS, _MOST_READINGS // recipe.samples))
    return 1 << (wanted.bit_length() - 1)


def compute_block(recipe: Recipe, seed: int, number: int) -> dict[str, Column]:
    """The items `number * B` to `number * B + B - 1`, B = `items_per_block`, as columns with B rows each."""
    checks.whole("seed", seed, 0)
    size = items_per_block(recipe)
    with _one_thread(), torch.no_grad():
        generator = item_generator(seed, number)
        kinds, parameters, points = _trajectories(recipe, size, generator)
        trajectory = SplitBSpline(
            points, order=ORDER, dt=recipe.knot_spacing, learnable=False, extrapolate="linear", validate=False
        )
        t = torch.arange(recipe.samples, dtype=torch.float64) / recipe.rate
        drawn = draw_sensor(recipe.sensor_distributions, size, generator)
        motion = trajectory.kinematics(t)
        readings = simulate(trajectory, t, recipe.rate, drawn, generator)
        assert motion.rotation is not None
        assert motion.position is not None
        assert motion.velocity is not None
        dtype = getattr(torch, recipe.dtype)
        columns: dict[str, Column] = {
            "index": torch.arange(number * size, (number + 1) * size),
            "motion": kinds,
            "motion_parameters": parameters,
            "time": t.expand(size, -1),
            **{name: x.to(dtype) if x.is_floating_point() else x for name, x in readings.items()},
            "rotation": motion.rotation.to(dtype),
            "position": motion.position.to(dtype),
            "velocity": motion.velocity.to(dtype),
            "control_points": points,
            **{f"sensor_{name}": x.to(dtype) for name, x in drawn.items()},
        }
    return columns


def _trajectories(
    recipe: Recipe, size: int, generator: torch.Generator
) -> tuple[list[str], list[str], Tensor]:
    weights = recipe.weights
    names = list(weights)
    share = torch.tensor([weights[name] for name in names], dtype=torch.float64)
    which = torch.multinomial(share, size, replacement=True, generator=generator)
    rest = REST.draw(recipe.rest_distribution, size, generator)
    parameters, points = [""] * size, None
    for number, kind in enumerate(names):
        rows = torch.nonzero(which == number).flatten()
        if not len(rows):
            continue
        drawn = draw_motion(kind, recipe.motion_distributions[kind], len(rows), generator)
        made = control_points(
            kind, drawn, rest[rows], recipe.duration, recipe.knot_spacing, recipe.mounting, generator
        )
        points = made.new_empty(size, *made.shape[1:]) if points is None else points
        points[rows] = made
        values = {"rest": rest[rows].tolist(), **{name: x.tolist() for name, x in drawn.items()}}
        for i, row in enumerate(rows.tolist()):
            parameters[row] = json.dumps({name: x[i] for name, x in values.items()})
    assert points is not None
    return [names[i] for i in which.tolist()], parameters, points


def rows(columns: dict[str, Column], start: int, stop: int) -> dict[str, Column]:
    """Some rows of a block."""
    return {name: x[start:stop] for name, x in columns.items()}


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
