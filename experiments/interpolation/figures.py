"""Figures 1 to 6 of [H18], redrawn."""

from pathlib import Path
from typing import Any

import torch
from common import save
from matplotlib.figure import Figure
from torch import Tensor

from interpolation.keys import DOUBLE, figure_5, figure_6, table_1
from torchspline import SE3, SO3, Group, State
from torchspline.functional import interpolate
from torchspline.groups import convert
from torchspline.splines.basis import blending_matrix
from torchspline.splines.interpolation.bezier import bernstein

PLANE = Group("R2")
COLOURS = ("tab:red", "tab:green", "tab:blue", "tab:orange")


def _lines(ax: Any, points: Tensor, **style: Any) -> None:
    ax.plot(points[:, 0], points[:, 1], **style)


def figure_1(out: Path) -> Path:
    """De Casteljau's construction at u = 0.75, degrees 1 to 3, and Bernstein polynomials."""
    points = torch.tensor([[0.0, 0.0], [0.3, 1.0], [1.2, 1.1], [1.5, 0.1]], dtype=DOUBLE)
    u = torch.linspace(0, 1, 101, dtype=DOUBLE)
    figure = Figure(figsize=(12, 6), layout="constrained")
    axes = figure.subplots(2, 3)
    for degree in (1, 2, 3):
        ax, basis_ax = axes[0, degree - 1], axes[1, degree - 1]
        control = points[: degree + 1]
        ends = torch.tensor([0.0, 1.0], dtype=DOUBLE)
        times = torch.linspace(0, 1, degree + 1, dtype=DOUBLE) if degree > 1 else ends
        _lines(ax, interpolate("Bezier", control, times, u, 0).value, color="black", linewidth=2)
        level = control
        while len(level) > 1:
            _lines(ax, level, color="0.6", marker="o", linewidth=1)
            level = 0.25 * level[:-1] + 0.75 * level[1:]
        ax.plot(*level[0], "o", color="black")
        for i, weight in enumerate(bernstein(degree, u)):
            ax.plot(*control[i], "o", color=COLOURS[i])
            basis_ax.plot(u, weight, color=COLOURS[i])
        basis_ax.axvline(0.75, color="0.6")
        ax.set(title=f"degree {degree}, u = 0.75")
        basis_ax.set(xlabel="u", ylabel="Bernstein polynomials")
    return save(figure, out / "figure_1.png")


def figure_2(out: Path) -> Path:
    """Basis functions of uniform B-splines that influence one segment; their width is degree + 1 segments."""
    figure = Figure(figsize=(12, 3.5), layout="constrained")
    axes = figure.subplots(1, 3)
    u = torch.linspace(0, 1, 51, dtype=DOUBLE)
    for degree, ax in zip((1, 2, 3), axes, strict=True):
        rows = blending_matrix(degree + 1)
        pieces = [sum(float(c) * u**n for n, c in enumerate(row)) for row in rows]
        for i in range(degree + 1):  # basis function i of segment 0: its pieces come in the opposite order
            for j, piece in enumerate(reversed(pieces)):
                ax.plot(u + i - degree + j, piece, color=COLOURS[i])
        ax.axvspan(0, 1, color="0.9")
        ax.set(title=f"degree {degree}", xlabel="knots", ylim=(0, 1.05))
    return save(figure, out / "figure_2.png")


def figure_3(out: Path) -> Path:
    """Seven control points: a composite cubic Bezier curve and a cubic B-spline, and what one moved point does."""
    x = torch.arange(7, dtype=DOUBLE)
    points = torch.stack([x, torch.tensor([0.0, 1.0, 0.2, 1.2, 0.1, 0.9, 0.3], dtype=DOUBLE)], dim=-1)
    moved = points.clone()
    moved[3, 1] += 0.8
    t = torch.linspace(0, 6, 601, dtype=DOUBLE)
    figure = Figure(figsize=(12, 7), layout="constrained")
    axes = figure.subplots(2, 2)
    for column, (name, title) in enumerate(
        (
            ("CompositeBezier", "composite cubic Bezier: interpolates, global"),
            ("BSpline", "cubic B-spline: local, approximates"),
        )
    ):
        for keys, style in ((points, "-"), (moved, "--")):
            _lines(axes[0, column], interpolate(name, keys, x, t, 0).value, color="black", linestyle=style)
            axes[0, column].plot(
                keys[:, 0], keys[:, 1], "o", color="tab:red" if style == "--" else "tab:blue"
            )
        axes[0, column].set(title=title)
        unit = torch.eye(7, dtype=DOUBLE)
        weights = interpolate(
            "bspline" if name == "BSpline" else "composite_bezier", unit, x, t, 0, group=Group("R7")
        )
        axes[1, column].plot(t, weights.value)
        axes[1, column].set(title="weight of each control point", xlabel="knots")
    return save(figure, out / "figure_3.png")


def figure_4(out: Path) -> dict[str, float]:
    """Orientations of Table 1 on the sphere (w, x, y), and the norm of the angular velocity. Returns its
    largest jumps."""
    keys, times = table_1()
    t = torch.linspace(0, 5, 1001, dtype=DOUBLE)
    figure = Figure(figsize=(16, 8), layout="constrained")
    jumps = {}
    a, b = torch.linspace(0, torch.pi, 30), torch.linspace(0, torch.pi, 30)
    for i, name in enumerate(("SLERP", "SQUAD", "RQBez", "CuBsp")):
        state = interpolate(name, keys, times, t, 2)
        assert state.velocity is not None
        speed = state.velocity.norm(dim=-1)
        sphere = figure.add_subplot(2, 4, i + 1, projection="3d")
        q = state.value
        unit = (
            keys
            * torch.where((keys * interpolate(name, keys, times, times, 0).value).sum(-1) < 0, -1.0, 1.0)[
                :, None
            ]
        )
        rings = torch.cos(a)[:, None], torch.sin(a)[:, None]
        sphere.plot_wireframe(
            (rings[1] * torch.sin(b)).numpy(), (rings[0] * torch.ones_like(b)).numpy(), (rings[1] *
            torch.cos(b)).numpy(),
            color="0.9", linewidth=0.5,
        )  # fmt: skip
        sphere.plot(q[:, 1], q[:, 2], q[:, 0], color="black")
        sphere.scatter(unit[:, 1], unit[:, 2], unit[:, 0], c=range(6), cmap="tab10")
        sphere.set(title=name, xlabel="x", ylabel="y", zlabel="w")
        sphere.set_box_aspect((1, 1, 1))
        sphere.view_init(elev=60, azim=-70)
        ax = figure.add_subplot(2, 4, i + 5)
        ax.plot(t, speed)
        for key in times:
            ax.axvline(float(key), color="0.85")
        ax.set(xlabel="keys", ylabel="angular velocity [rad/s]" if i == 0 else "", ylim=(0, None))
        sides = [interpolate(name, keys, times, times[1:-1] + s * 1e-7, 1).velocity for s in (-1, 1)]
        assert sides[0] is not None
        assert sides[1] is not None
        jumps[name] = float((sides[0] - sides[1]).norm(dim=-1).max())
    save(figure, out / "figure_4.png")
    return jumps


def _positions(name: str, poses: Tensor, times: Tensor, t: Tensor) -> tuple[Tensor, State]:
    """Poses of the body and the state, whatever group the scheme is on."""
    dual = name in ("ScLERP", "DLB", "ScFus", "DLFus")
    keys = convert.pose_to_dual_quaternion(poses) if dual else poses
    state = interpolate(name, keys, times, t, 1)
    return convert.pose_from_dual_quaternion(state.value) if dual else state.value, state


def _path(ax: Any, poses: Tensor, colour: str, label: str, axes_every: int = 0, **style: Any) -> None:
    """Positions in the y-z plane; the body's z axis (a camera's direction) here and there."""
    ax.plot(poses[:, 1], poses[:, 2], color=colour, label=label, **style)
    if axes_every:
        shown = poses[::axes_every]
        z = SO3.act(shown[:, 3:], torch.tensor([0.0, 0.0, 1.0], dtype=DOUBLE))
        ax.quiver(
            shown[:, 1], shown[:, 2], z[:, 1], z[:, 2], color=colour, angles="xy", scale=14, width=0.004
        )


def figure_5_drawn(out: Path) -> dict[str, float]:
    """Two poses half a turn apart: deviations of joint from split interpolation, speeds. Returns what is measured."""
    poses, times = figure_5()
    t = torch.linspace(0, 1, 101, dtype=DOUBLE)
    figure = Figure(figsize=(12, 6), layout="constrained")
    ax, speed_ax = figure.subplots(1, 2)
    paths = {}
    for name, colour in (
        ("SPLIT", "tab:orange"),
        ("SE3Up", "tab:purple"),
        ("ScLERP", "tab:pink"),
        ("DLB", "tab:green"),
    ):
        paths[name], state = _positions(name, poses, times, t)
        assert state.velocity is not None
        speed = state.velocity[:, 3:].norm(dim=-1)
        _path(ax, paths[name], colour, name, axes_every=20, linestyle="--" if name == "DLB" else "-")
        speed_ax.plot(t, speed, color=colour, label=name, linestyle="--" if name == "ScLERP" else "-")
        if name == "DLB":
            bell = speed
    _path(ax, poses, "black", "keys", axes_every=1, linestyle="none", marker="o")
    ax.set(xlabel="y [m]", ylabel="z [m]", aspect="equal", title="half-circle of SE3Up, ScLERP and DLB")
    speed_ax.set(xlabel="u", ylabel="angular velocity [rad]", title="bell-shaped speed of DLB")
    ax.legend()
    speed_ax.legend()
    save(figure, out / "figure_5.png")
    radius = paths["SE3Up"][:, :3].norm(dim=-1)
    return {
        "largest_deviation_of_SE3Up_from_SPLIT_m": float(
            (paths["SE3Up"] - paths["SPLIT"])[:, :3].norm(dim=-1).max()
        ),
        "distance_of_SE3Up_from_the_half_circle_m": float((radius - 1).abs().max()),
        "distance_of_ScLERP_from_SE3Up_m": float((paths["ScLERP"] - paths["SE3Up"])[:, :3].abs().max()),
        "distance_of_DLB_from_the_half_circle_m": float((paths["DLB"][:, :3].norm(dim=-1) - 1).abs().max()),
        "speed_of_DLB_at_its_ends_rad": float(bell[0]),
        "speed_of_DLB_in_the_middle_rad": float(bell[50]),
        "speed_of_ScLERP_rad": float(torch.pi),
    }


def figure_6_drawn(out: Path) -> dict[str, float]:
    """Four poses: the coupling of translation and rotation, segment by segment. Returns largest deviations in m."""
    poses, times = figure_6()
    t = torch.linspace(0, 3, 301, dtype=DOUBLE)
    figure = Figure(figsize=(7, 8), layout="constrained")
    ax = figure.subplots()
    paths = {}
    for name, colour in (
        ("SPLIT", "tab:orange"), ("SE3Up", "tab:purple"), ("SPLIT CuBsp", "tab:green"), ("SpFus", "tab:cyan"),
        ("DLFus", "tab:olive"),
    ):  # fmt: skip
        paths[name], _ = _positions(name, poses, times, t)
        _path(ax, paths[name], colour, name, linestyle="--" if name == "DLFus" else "-")
    _path(ax, poses, "black", "keys", axes_every=1, linestyle="none", marker="o")
    ax.set(xlabel="y [m]", ylabel="z [m]", aspect="equal", title="joint and split trajectories")
    ax.legend()
    save(figure, out / "figure_6.png")
    turns = SO3.log(SO3.between(poses[:-1, 3:], poses[1:, 3:])).norm(dim=-1)

    def apart(a: str, b: str, part: slice) -> float:
        return float((paths[a] - paths[b])[part, :3].norm(dim=-1).max())

    result = {}
    for i, turn in enumerate(turns):
        part = slice(100 * i, 100 * i + 101)
        result[f"SE3Up from SPLIT, segment {i} (turn of {float(turn):.2f} rad)"] = apart(
            "SE3Up", "SPLIT", part
        )
    whole = slice(None)
    result["SpFus from SPLIT CuBsp"] = apart("SpFus", "SPLIT CuBsp", whole)
    scfus, _ = _positions("ScFus", poses, times, t)
    step = SE3.log(SE3.between(scfus, paths["SpFus"]))
    result["ScFus from SpFus"] = float(step.abs().max())
    result["DLFus from SpFus"] = apart("DLFus", "SpFus", whole)
    return result
