"""The pictures of the documentation: frames and velocities, sides of a perturbation, the domain of a spline, curves."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

import torchspline as ts
from torchspline.functional import bspline, interpolate
from torchspline.groups.group import Side

F64 = torch.float64
_COLORS = ("tab:red", "tab:green", "tab:blue")


def _space(
    figure: Figure, place: int, box: Sequence[tuple[float, float]], view: tuple[float, float], zoom: float
) -> Any:
    axes = figure.add_subplot(place, projection="3d")
    axes.set(xlim=box[0], ylim=box[1], zlim=box[2])
    axes.set_box_aspect([end - start for start, end in box], zoom=zoom)
    axes.view_init(*view)
    axes.set_axis_off()
    return axes


def _frame(
    axes: Any, pose: Tensor, length: float, name: str = "", alpha: float = 1.0,
    shift: tuple[float, float, float] = (-0.3, -0.3, -0.3),
) -> None:  # fmt: skip
    """Axes x, y, z of a pose in red, green and blue; its name is shifted by a multiple of their length."""
    origin = pose[:3]
    for i, color in enumerate(_COLORS):
        tip = ts.SE3.act(pose, length * torch.eye(3, dtype=F64)[i])
        axes.plot(*torch.stack([origin, tip]).T.tolist(), color=color, alpha=alpha, linewidth=2)
    if name:
        axes.text(*(origin + length * torch.tensor(shift, dtype=F64)).tolist(), name, fontsize=11)


def _pose(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=F64)


WORLD = _pose(0, 0, 0, 1, 0, 0, 0)


def frames() -> Figure:
    """World, body and sensor frames along a trajectory, with what is measured in which."""
    keys = ts.SE3.exp(
        torch.tensor(
            [[0.1, -0.3, 0.1, 0, 0, 0.3], [1.0, 0.0, 0.5, 0, 0, 0.3], [2.0, 0.3, 0.6, 0, 0, 0.0],
             [2.9, 0.3, 0.4, 1.2, 0, 0], [3.7, 0.2, 0.0, 1.6, 0.6, 0]], dtype=F64,
        )
    )  # fmt: skip
    spline = ts.BSpline(ts.phantom_points(keys, ts.SE3), group=ts.SE3, dt=1.0)
    figure = Figure(figsize=(9.6, 4.6))
    axes = _space(figure, 111, ((-0.9, 4.1), (-1.2, 1.4), (-0.9, 1.1)), (24, -72), 1.1)
    axes.set_position((-0.3, -0.55, 1.6, 2.2))
    origin = torch.tensor([-0.6, -0.6, -0.7], dtype=F64)
    with torch.no_grad():
        poses = spline(torch.linspace(*spline.domain, 200, dtype=F64))
        axes.plot(*poses[:, :3].T.tolist(), color="0.55", linewidth=1.2)
        for i in (0, 70, 199):
            _frame(axes, poses[i], 0.25, alpha=0.4)
        _frame(axes, torch.cat([origin, WORLD[3:]]), 0.6, "world")
        now = torch.tensor(2.3, dtype=F64)
        pose, motion = spline(now), spline.kinematics(now)
        assert motion.velocity is not None
        assert motion.angular_velocity is not None
        _frame(axes, pose, 0.55, "body", shift=(-0.75, 0.0, 0.4))
        mounted = spline.mounted(_pose(-0.5, -0.3, -0.8, 0.9, 0.3, 0.3, 0.0))(now)
        _frame(axes, mounted, 0.35, "sensor")
        axes.plot(*torch.stack([pose[:3], mounted[:3]]).T.tolist(), "k:", label="lever arm, in the body")
    arrows = (
        (origin, pose[:3] - origin, "0.4", "t of p_world = R p_body + t"),
        (pose[:3], 0.9 * motion.velocity, "tab:purple", "velocity, acceleration: world frame"),
        (pose[:3], 0.9 * ts.SO3.act(pose[3:], motion.angular_velocity), "tab:orange",
         "angular velocity, acceleration: body frame"),
        (torch.tensor([3.6, 0.6, 0.75], dtype=F64), torch.tensor([0, 0, -0.6], dtype=F64), "k", "gravity: world frame"),
    )  # fmt: skip
    for start, step, color, name in arrows:
        axes.quiver(
            *start.tolist(), *step.tolist(), color=color, linewidth=1.8, arrow_length_ratio=0.08, label=name
        )
    figure.legend(loc="lower center", ncols=3, frameon=False, fontsize=9, bbox_to_anchor=(0.5, 0.0))
    return figure


def sides() -> Figure:
    """What a perturbation on the left and on the right does to a pose: Exp(delta) X and X Exp(delta)."""
    X = _pose(0.9, 0.0, 0.0, *ts.SO3.exp(torch.tensor([0.0, 0.0, 0.3], dtype=F64)).tolist())
    figure = Figure(figsize=(9, 4.0))
    sides: tuple[tuple[str, Side], ...] = (
        ("left: Exp(delta) X\nturns about the axes of the world", "left"),
        ("right: X Exp(delta)\nturns about the axes of the body", "right"),
    )
    for place, (title, side) in enumerate(sides):
        axes = _space(figure, 121 + place, ((-0.3, 1.4), (-0.4, 1.3), (-0.3, 0.7)), (35, -65), 1.5)
        _frame(axes, WORLD, 0.5, "world")
        for share in (0.25, 0.5, 0.75, 1.0):
            delta = share * torch.tensor([0, 0, 0, 0, 0, 1.1], dtype=F64)
            _frame(axes, ts.SE3.retract(X, delta, side=side), 0.35, alpha=0.3 + 0.6 * share)
        _frame(axes, X, 0.45, "X")
        axes.set_title(title, fontsize=11, y=0.98)
    return figure


def domain() -> Figure:
    """Basis functions of order 4 over eight control points, and the interval on which they sum to one."""
    count, order, dt = 8, 4, 1.0
    figure = Figure(figsize=(8.4, 3.4), layout="constrained")
    axes = figure.subplots()
    end = count - order + 1
    t = torch.linspace(0, end, 401, dtype=F64)
    for i in range(count):
        unit = torch.zeros(count, 1, dtype=F64)
        unit[i] = 1.0
        y = bspline(unit, t, group=ts.Rn(1), order=order, dt=dt, derivatives=0).value[:, 0]
        axes.plot(t, y.clamp_min(0).where(y > 1e-12, torch.nan), color=f"C{i}")
        axes.plot([i - (order - 2) / 2], [-0.06], "o", color=f"C{i}", clip_on=False)
    axes.axvspan(0, end, color="0.92", zorder=0)
    for j in range(end + 1):
        axes.axvline(j, color="0.75", linewidth=0.8, zorder=0)
    axes.text(end / 2, 0.78, "domain: t0 ... t0 + (M - k + 1) dt", ha="center")
    axes.set(
        xlabel="(t - t0) / dt", ylabel="weight of a control point", ylim=(-0.1, 0.85),
        title="M = 8 control points (dots, where they act most), order k = 4",
    )  # fmt: skip
    return figure


def curves() -> Figure:
    """One set of points in the plane under five schemes: which meet their points, which go round corners."""
    keys = torch.tensor([[0.0, 0.0], [1.0, 0.2], [1.4, 1.3], [2.6, 1.4], [3.0, 0.0], [4.2, 0.1]], dtype=F64)
    times = torch.arange(len(keys), dtype=F64)
    t = torch.linspace(0, len(keys) - 1, 400, dtype=F64)
    plane = ts.Rn(2)
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, style in (
        ("geodesic", "C7-"), ("squad", "C0-"), ("composite_bezier", "C1-"), ("cumulative_bspline", "C2-"),
    ):  # fmt: skip
        axes.plot(*interpolate(name, keys, times, t, 0, group=plane).value.T, style, label=name)
    through = ts.phantom_points(keys, plane, order=6)
    spline = bspline(through, t, group=plane, order=6, dt=1.0, derivatives=0).value
    axes.plot(*spline.T, "C3--", label="B-spline, order 6")
    axes.plot(*keys.T, "ko", markersize=6)
    axes.set(aspect="equal", xlabel="x", ylabel="y")
    figure.legend(loc="outside upper center", ncols=5, frameon=False)
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {
    "frames": frames, "sides": sides, "domain": domain, "curves": curves,
}  # fmt: skip


def draw(out: Path) -> list[Path]:
    """Writes all pictures."""
    paths = []
    for name, make in PICTURES.items():
        paths.append(out / f"{name}.png")
        make().savefig(paths[-1], dpi=120)
    return paths
