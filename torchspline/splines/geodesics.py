"""Products of geodesics with given scalar functions, [E17] section 3: what all splines here are made of."""

from torch import Tensor

from torchspline import checks
from torchspline.arithmetic.recurrence import MAX_DERIVATIVES
from torchspline.groups.group import Group
from torchspline.groups.operations import geodesics
from torchspline.splines.trajectory import State


def geodesic_product(
    start: Tensor, steps: Tensor, weights: Tensor, *, group: Group, validate: bool = True
) -> State:
    """`start Exp(l_1 d_1) ... Exp(l_n d_n)` and its time derivatives, O(n): [E17] (24), (33), (36) in the body frame.

    [E17] multiplies on the left: `Exp(l_n p_n) ... Exp(l_1 p_1) B` is the inverse of this product with -p and B^-1.

    Args:
        start: `(..., P)` points of `group`.
        steps: `(..., n, D)` tangents d_1 ... d_n, of any length.
        weights: `(..., R + 1, n)`: the scalars l_j(t), then their first derivatives by t, and so on; R from 0 to 3.
        validate: look at values (finite numbers, quaternion lengths).
    Returns:
        State: value `(..., P)` and R rates `(..., D)`, body frame, per unit of t. Leading dimensions broadcast.
    Differentiable in all three to any order, by one reverse sweep, which holds the structural differentials (39)-(52).
    Raises:
        TypeError: wrong type or dtype. ValueError: wrong shape, device or value.
    """
    checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
    checks.is_floating_tensor("start", start)
    checks.has_last("start", start, group.point_size, f"a point of {group}")
    for name, x in (("steps", steps), ("weights", weights)):
        checks.is_floating_tensor(name, x)
    if steps.ndim < 2 or steps.shape[-1] != group.tangent_size or steps.shape[-2] < 1:
        raise ValueError(
            f"steps: expected shape (..., n, {group.tangent_size}), n tangents of {group}, got {tuple(steps.shape)}"
        )
    if (
        weights.ndim < 2
        or weights.shape[-1] != steps.shape[-2]
        or not 1 <= weights.shape[-2] <= MAX_DERIVATIVES + 1
    ):
        raise ValueError(
            f"weights: expected shape (..., R + 1, {steps.shape[-2]}), one for each step and R from 0 to "
            f"{MAX_DERIVATIVES} derivatives, got {tuple(weights.shape)}"
        )
    checks.same_kind(start=start, steps=steps, weights=weights)
    checks.broadcast(start=start.shape[:-1], steps=steps.shape[:-2], weights=weights.shape[:-2])
    if validate:
        for name, x in (("start", start), ("steps", steps), ("weights", weights)):
            checks.finite(name, x)
        checks.quaternions("start", start, group.arithmetic.unit_blocks)
    return State(*geodesics(group.name, start, steps, weights))
