"""Inertial data to train on: random motions, sensors of random quality, data sets of any size.

`Recipe` says what is drawn from what, `GeneratedDataset` makes items while a network trains, `write` (and
`torchspline generate`) puts them on disk and `read` takes them from there. To add a kind of motion, see `motions`.
"""

from torchspline.generate.blocks import items_per_block
from torchspline.generate.dataset import GeneratedDataset
from torchspline.generate.motions import MOTIONS
from torchspline.generate.recipe import Recipe
from torchspline.generate.sensors import SENSOR_PARAMETERS
from torchspline.generate.shards import ShardedDataset, Written, read, write
from torchspline.generate.trajectories import random_motion

__all__ = [
    "MOTIONS",
    "SENSOR_PARAMETERS",
    "GeneratedDataset",
    "Recipe",
    "ShardedDataset",
    "Written",
    "items_per_block",
    "random_motion",
    "read",
    "write",
]
