"""Figures 1 to 6 of [H18], redrawn."""

from collections.abc import Sequence
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
SEGMENTS = ("tab:red", "tab:orange", "tab:olive", "tab:green", "tab:blue", "tab:purple")
#: Colours of the frames between two keys, as in the paper's Figure 5.
BETWEEN = ("tab:red", "tab:green", "tab:blue", "gold")


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
            basis_ax.plot(0.75, weight[75], "o", color=COLOURS[i])
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
        ax.set(title=f"degree {degree}", xlabel="knots", ylabel="basis functions" if degree == 1 else "")
        ax.set(xlim=(-3.2, 4.2), ylim=(0, 1.05), xticks=range(-3, 5))
    return save(figure, out / "figure_2.png")


def figure_3(out: Path) -> Path:
    """Seven control points: a composite cubic Bezier curve and a cubic B-spline, what one moved point does (dashed),
    and what each point weighs in each segment, shaded in the colour of its piece of the curve."""
    x = torch.arange(7, dtype=DOUBLE)
    points = torch.stack([x, torch.tensor([0.0, 1.0, 0.2, 1.2, 0.1, 0.9, 0.3], dtype=DOUBLE)], dim=-1)
    moved = points.clone()
    moved[3, 1] += 0.8
    figure = Figure(figsize=(12, 7), layout="constrained")
    axes = figure.subplots(2, 2, sharey="row")
    for column, (name, title) in enumerate(
        (
            ("CompositeBezier", "composite cubic Bezier: interpolates, global"),
            ("BSpline", "cubic B-spline: local, approximates"),
        )
    ):
        top, bottom = axes[:, column]
        t = torch.linspace(0, 6, 601, dtype=DOUBLE)
        _lines(top, interpolate(name, moved, x, t, 0).value, color="0.5", linestyle="--")
        for i, colour in enumerate(SEGMENTS):
            part = t[100 * i : 100 * i + 101]
            _lines(top, interpolate(name, points, x, part, 0).value, color=colour, linewidth=2.5)
            bottom.axvspan(i, i + 1, color=colour, alpha=0.15, linewidth=0)
        top.plot(moved[3, 0], moved[3, 1], "o", color="white", markeredgecolor="black")
        top.plot(points[:, 0], points[:, 1], "o", color="black")
        top.set(title=title)
        unit = torch.eye(7, dtype=DOUBLE)
        scheme = "bspline" if name == "BSpline" else "composite_bezier"
        bottom.plot(
            t, interpolate(scheme, unit, x, t, 0, group=Group("R7")).value, color="black", linewidth=1
        )
        bottom.set(title="weight of each control point", xlabel="knots")
    return save(figure, out / "figure_3.png")


def _on_the_sphere(ax: Any, q: Tensor, keys: Tensor, title: str) -> None:
    """The hemisphere w > 0 seen from above; what is drawn last lies on top."""
    ax.computed_zorder = False
    turn, down = torch.meshgrid(
        torch.linspace(0, 2 * torch.pi, 37), torch.linspace(0, torch.pi / 2, 10), indexing="ij"
    )
    sphere = torch.sin(down) * torch.cos(turn), torch.sin(down) * torch.sin(turn), torch.cos(down)
    ax.plot_wireframe(*(x.numpy() for x in sphere), color="0.85", linewidth=0.5)
    ax.plot(q[:, 1], q[:, 2], q[:, 0], color="black")
    for i, key in enumerate(keys):
        ax.scatter(key[1], key[2], key[0], color=f"C{i}", s=40, depthshade=False)
        ax.text(key[1] + 0.1, key[2] + 0.08, key[0], str(i), color=f"C{i}")
    ax.set(title=title, xlabel="x", ylabel="y", xticks=(-1, 0, 1), yticks=(-1, 0, 1), zticks=())
    ax.set_box_aspect((1, 1, 0.5), zoom=1.2)
    ax.set_proj_type("ortho")
    ax.view_init(elev=70, azim=-90)


def figure_4(out: Path) -> dict[str, float]:
    """Orientations of Table 1 on the sphere (w, x, y), and the norm of the angular velocity. Returns its
    largest jumps."""
    keys, times = table_1()
    t = torch.linspace(0, 5, 1001, dtype=DOUBLE)
    figure = Figure(figsize=(16, 8), layout="constrained")
    jumps = {}
    jumps, speeds = {}, []
    for i, name in enumerate(("SLERP", "SQUAD", "RQBez", "CuBsp")):
        state = interpolate(name, keys, times, t, 2)
        assert state.velocity is not None
        side = torch.where((keys * interpolate(name, keys, times, times, 0).value).sum(-1) < 0, -1.0, 1.0)
        _on_the_sphere(
            figure.add_subplot(2, 4, i + 1, projection="3d"), state.value, keys * side[:, None], name
        )
        ax = figure.add_subplot(2, 4, i + 5, sharey=speeds[0] if speeds else None)
        speeds.append(ax)
        ax.plot(t, state.velocity.norm(dim=-1))
        for key in times:
            ax.axvline(float(key), color="0.85")
        ax.set(xlabel="keys", ylabel="angular velocity [rad/s]" if i == 0 else "", ylim=(0, 4.2))
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


def _frames(ax: Any, poses: Tensor, colours: Sequence[str], length: float, **style: Any) -> None:
    """Positions in the y-z plane and the body's y and z axes (a camera looks along z)."""
    for pose, colour in zip(poses, colours, strict=True):
        ax.plot(pose[1], pose[2], color=colour, linestyle="none", **style)
        for axis, width in (((0.0, 0.0, 1.0), 2.0), ((0.0, 1.0, 0.0), 1.0)):
            tip = pose[:3] + length * SO3.act(pose[3:], torch.tensor(axis, dtype=DOUBLE))
            ax.plot([pose[1], tip[1]], [pose[2], tip[2]], color=colour, linewidth=width)


def figure_5_drawn(out: Path) -> dict[str, float]:
    """Two poses half a turn apart: deviations of joint from split interpolation, speeds. Returns what is measured."""
    poses, times = figure_5()
    t = torch.linspace(0, 1, 101, dtype=DOUBLE)
    figure = Figure(figsize=(12, 6), layout="constrained")
    ax, speed_ax = figure.subplots(1, 2)
    paths = {}
    for name, colour, style, marker in (
        ("SPLIT", "tab:orange", "-", "o"),
        ("SE3Up", "tab:purple", "-", "o"),
        ("ScLERP", "tab:pink", "--", ""),
        ("DLB", "tab:green", ":", "s"),
    ):
        paths[name], state = _positions(name, poses, times, t)
        assert state.velocity is not None
        speed = state.velocity[:, 3:].norm(dim=-1)
        ax.plot(paths[name][:, 1], paths[name][:, 2], color=colour, label=name, linestyle=style)
        if marker:
            small = {"marker": marker, "markersize": 4 if name == "DLB" else 8}
            _frames(ax, paths[name][20:81:20], BETWEEN, 0.08 if name == "DLB" else 0.16, **small)
        speed_ax.plot(t, speed, color=colour, label=name, linestyle="-" if name == "DLB" else style)
        if name == "DLB":
            bell = speed
    _frames(ax, poses, ("black", "black"), 0.16, marker="o", label="keys")
    ax.set(xlabel="y [m]", ylabel="z [m]", aspect="equal", xlim=(-0.5, 1.3), ylim=(-1.25, 1.25))
    ax.set(title="frames at u = 0.2 ... 0.8, those of DLB small")
    speed_ax.set(xlabel="u", ylabel="angular velocity [rad per unit of u]", title="bell-shaped speed of DLB")
    handles = dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    ax.legend(handles.values(), handles.keys(), loc="center", bbox_to_anchor=(0.5, 0.5))
    speed_ax.legend()
    save(figure, out / "figure_5.png")

    def angle(pose: Tensor) -> Tensor:
        return torch.atan2(pose[1], -pose[2])

    radius = paths["SE3Up"][:, :3].norm(dim=-1)
    return {
        "largest_deviation_of_SE3Up_from_SPLIT_m": float(
            (paths["SE3Up"] - paths["SPLIT"])[:, :3].norm(dim=-1).max()
        ),
        "distance_of_SE3Up_from_the_half_circle_m": float((radius - 1).abs().max()),
        "distance_of_ScLERP_from_SE3Up_m": float((paths["ScLERP"] - paths["SE3Up"])[:, :3].abs().max()),
        "distance_of_DLB_from_the_half_circle_m": float((paths["DLB"][:, :3].norm(dim=-1) - 1).abs().max()),
        **{
            f"angle_of_DLB_ahead_of_SE3Up_at_{u / 100}_rad": float(
                angle(paths["DLB"][u]) - angle(paths["SE3Up"][u])
            )
            for u in (20, 40, 60, 80)
        },
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
        style = (
            {"linestyle": "--"}
            if name in ("DLFus", "SE3Up")
            else {"linewidth": 2.5 if name == "SPLIT" else 1.5}
        )
        ax.plot(paths[name][:, 1], paths[name][:, 2], color=colour, label=name, **style)
    _frames(ax, poses, ("black",) * 4, 0.1, marker="o")
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
