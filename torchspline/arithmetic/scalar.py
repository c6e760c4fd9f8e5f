"""The few scalar operations the arithmetic needs beyond `+ - * /`, for every kind of number it runs on.

Components are torch tensors, NumPy arrays, Python floats, or anything registered with `namespace` (symbols that record
what is done to them, multi-precision numbers in the tests).
"""

import math
from functools import singledispatch
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

# A component: a tensor, a float, a symbol. The arithmetic never asks which.
Scalar = Any


@singledispatch
def namespace(x: Scalar) -> Any:
    """The functions `sqrt sin cos where` for numbers of the kind of `x`."""
    raise TypeError(f"no scalar functions are registered for {type(x).__name__}")


_FLOAT = SimpleNamespace(
    sqrt=math.sqrt,
    sin=math.sin,
    cos=math.cos,
    where=lambda condition, yes, no: yes if condition else no,
)
namespace.register(torch.Tensor, lambda x: torch)
namespace.register(np.ndarray, lambda x: np)
namespace.register(float, lambda x: _FLOAT)
namespace.register(int, lambda x: _FLOAT)


def sqrt(x: Scalar) -> Scalar:
    return namespace(x).sqrt(x)


def sin(x: Scalar) -> Scalar:
    return namespace(x).sin(x)


def cos(x: Scalar) -> Scalar:
    return namespace(x).cos(x)


def where(condition: Scalar, yes: Scalar, no: Scalar) -> Scalar:
    """`yes` where `condition` holds, else `no`; at least one of the two is a component, not a constant."""
    kind = no if isinstance(yes, (int, float)) else yes
    return namespace(kind).where(condition, yes, no)


def is_single(x: Scalar) -> bool:
    """Whether `x` carries only single precision, so that a shorter polynomial is enough."""
    return getattr(x, "dtype", None) == torch.float32
