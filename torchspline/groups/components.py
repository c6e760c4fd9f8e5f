"""Between tensors, whose last dimension holds the numbers of a point, and the tuples the arithmetic works on."""

import torch
from torch import Tensor

from torchspline.arithmetic.vector import Vector


def split(x: Tensor) -> Vector:
    """The components along the last dimension, as views."""
    return x.unbind(-1)


def join(components: Vector, like: Tensor) -> Tensor:
    """Components along a new last dimension; constants take the shape of `like` without its last dimension."""
    shape = torch.broadcast_shapes(like.shape[:-1], *(c.shape for c in components if isinstance(c, Tensor)))
    return torch.stack(
        [c.expand(shape) if isinstance(c, Tensor) else like.new_full(shape, c) for c in components], dim=-1
    )
