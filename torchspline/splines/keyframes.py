"""From poses one has to control points: start and end at given poses, or a first guess for a fit."""

import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups.components import join, split
from torchspline.groups.group import Group
from torchspline.splines.sweep import continue_signs, first, second


def consistent_signs(points: Tensor, group: Group) -> Tensor:
    """The same points `(*batch, M, P)`, unit, each quaternion on the side of its predecessor.

    A rotation has two quaternions; component-wise filters, plots and fits need neighbours that do not jump between
    them. Differentiable in `points`.

    Raises:
        TypeError, ValueError: a wrong type, dtype, shape or value.
    """
    _check_group(group)
    checks.points("points", points, group, least=1)
    algebra = group.arithmetic
    unit = algebra.normalize(split(points))
    return join(continue_signs(algebra, unit, algebra.between(first(unit), second(unit))), points)


def phantom_points(keyframes: Tensor, group: Group, order: int = 4) -> Tensor:
    """Control points of a B-spline that starts exactly at the first and ends exactly at the last keyframe.

    The keyframes are the inner control points; before the first and after the last one stand
    `ceil((order - 2) / 2)` phantom points ([H18] section 3): the neighbours `Y` of the end keyframe `X` mirrored in
    it, `X Y^-1 X`. With an odd order the domain ends halfway between two control points, and the end keyframe itself
    comes twice. In the cumulative product of [S20] (23) the factors of mirrored neighbours cancel from the inside
    out, so this is exact on every group and for every order.

    Args:
        keyframes: `(*batch, M, P)`, M >= max(2, order // 2).
    Returns:
        `(*batch, M + 2 ceil((order - 2) / 2), P)`. An even order then spans M - 1 knot intervals from keyframe to
        keyframe, an odd one M.
    Differentiable in keyframes, to any order.
    Examples:
        >>> import torch
        >>> from torchspline import R3, BSpline
        >>> keys = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1, 0]], dtype=torch.float64)
        >>> spline = BSpline(phantom_points(keys, R3), group=R3, order=4, dt=1.0)
        >>> spline.domain, spline(torch.tensor(2.0)).tolist()
        ((0.0, 2.0), [1.0, 1.0, 0.0])
    """
    _check_group(group)
    checks.whole("order", order, least=2)
    checks.points("keyframes", keyframes, group, least=max(2, order // 2))
    mirrored = order // 2 - 1
    first, last = keyframes[..., :1, :], keyframes[..., -1:, :]
    front = _mirror(first, keyframes[..., 1 : 1 + mirrored, :], group)
    back = _mirror(last, keyframes[..., -1 - mirrored : -1, :], group)
    inner = [keyframes] if order % 2 == 0 else [first, keyframes, last]
    return torch.cat([front, *inner, back], dim=-2)


def _mirror(centre: Tensor, points: Tensor, group: Group) -> Tensor:
    """`centre points^-1 centre`, in the opposite order."""
    return group.compose(centre, group.between(points, centre)).flip(-2)


def initial_control_points(
    t: Tensor, poses: Tensor, *, group: Group, order: int, dt: float, t0: float, count: int
) -> Tensor:
    """A first guess of control points: timed poses interpolated geodesically where control points act.

    Control point i has its largest influence at `t0 + (i - (order - 2) / 2) dt`; before the first and after the last
    pose the end pose is held.

    Args:
        t: `(N,)` seconds, increasing; `poses`: `(N, P)`.
    Returns:
        `(count, P)`, unit, quaternion signs consistent.
    """
    _check_group(group)
    checks.whole("order", order, least=2)
    checks.whole("count", count, least=1)
    checks.positive("dt", dt)
    checks.finite_number("t0", t0)
    checks.is_floating_tensor("t", t)
    checks.points("poses", poses, group, least=1)
    if t.shape != poses.shape[:1] or poses.ndim != 2:
        raise ValueError(
            f"t, poses: expected shapes (N,) and (N, P), got {tuple(t.shape)} and {tuple(poses.shape)}"
        )
    if t.device != poses.device:
        raise ValueError(
            f"t: on device {t.device}, but poses are on {poses.device}; move one with .to(device)"
        )
    checks.finite("t", t)
    later = t.detach().diff() > 0
    if checks.values_visible(t) and checks.seen_true(later.all()) is False:
        i = int(later.int().argmin())
        raise ValueError(
            f"t: expected increasing times, got {t[i].item()} and then {t[i + 1].item()}; sort them and drop "
            "duplicates first"
        )
    peaks = t0 + (torch.arange(count, dtype=torch.float64, device=t.device) - (order - 2) / 2) * dt
    if poses.shape[0] == 1:
        return group.normalize(poses).expand(count, -1).clone()
    times = t.to(torch.float64)
    before = (torch.searchsorted(times, peaks) - 1).clamp(0, len(times) - 2)
    s = ((peaks - times[before]) / (times[before + 1] - times[before])).clamp(0.0, 1.0)
    poses = consistent_signs(poses, group)
    guess = group.interpolate(poses[before], poses[before + 1], s.to(poses.dtype))
    return consistent_signs(guess, group)


def _check_group(group: Group) -> None:
    checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
