"""`torchspline kernels show`."""

from typing import Literal

import torch

from torchspline.cli.report import Report
from torchspline.groups import Group
from torchspline.splines.fused import kernels_of, triton_kernels_of

EXAMPLES = """
torchspline kernels show SO3
torchspline kernels show SE3 --order 6 --sweep reverse --precision float32
torchspline kernels show SO3 --target triton
"""

_HIGHEST = 20


def show(
    group: str,
    order: int = 4,
    derivatives: Literal[0, 1, 2, 3] = 2,
    sweep: Literal["forward", "reverse"] = "forward",
    precision: Literal["float64", "float32"] = "float64",
    target: Literal["numba", "triton"] = "numba",
) -> Report:
    """Print the source of the compiled loop that evaluates a spline.

    Args:
        group: name of the group, such as SO3, SE3, R3 or R3xSO3.
        order: of the spline.
        derivatives: how many time derivatives, 0 to 3.
        sweep: the values, or the gradients.
        precision: of the numbers.
        target: what compiles it: numba for the CPU, triton for a GPU.
    """
    if not order <= _HIGHEST:
        raise ValueError(f"order: expected at most {_HIGHEST}, got {order}; loops grow with its square")
    chosen = Group(group).name, order, derivatives, getattr(torch, precision)
    kernels = kernels_of(*chosen, nanoseconds=False) if target == "numba" else triton_kernels_of(*chosen)
    source = kernels.forward_source() if sweep == "forward" else kernels.reverse_source()
    return Report(f"{sweep} sweep of {group}", {"source": source}, text=source)
