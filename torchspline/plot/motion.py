"""Figures of trajectories: where they go, how fast, and how sure that is."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups import SO3
from torchspline.plot.figure import (
    AXES,
    AXIS_COLORS,
    Array,
    Motion,
    equal_axes,
    motion_of,
    named,
    new_figure,
    numbers,
)  # fmt: skip
from torchspline.splines import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: What `rates` can show, with units.
QUANTITIES = {
    "velocity": "m/s",
    "acceleration": "m/s²",
    "angular_velocity": "rad/s",
    "angular_acceleration": "rad/s²",
}
#: Groups of which the covariance of a position can be told, and whether it is in the body frame.
_POSITION_IN_BODY = {"R3": False, "R3xSO3": False, "SE3": True, "DualQuaternion": True}
_AROUND = 24


def trajectory(
    trajectories: Trajectory | Mapping[str, Trajectory],
    t: Tensor | None = None,
    *,
    frames: int = 10,
    title: str = "",
) -> "Figure":
    """Paths in space with body frames along them (x red, y green, z blue).

    A trajectory of SO3 has no positions: the paths of its body axes on the unit sphere are drawn.

    Args:
        trajectories: one, or several by name.
        t: (N,) times to draw, within the domains of all of them; by default each from end to end.
        frames: how many along each.
    Raises:
        TypeError, ValueError: a wrong type or value, a batch of trajectories, a group that does not move a body.
    """
    checks.whole("frames", frames, least=0)
    drawn = {name: motion_of(x, t) for name, x in named(trajectories).items()}
    figure = new_figure(8, 7)
    axes: Any = figure.add_subplot(projection="3d")
    paths: list[Array] = []
    for i, (name, motion) in enumerate(drawn.items()):
        if motion.kinematics.position is None:
            paths += _axes_on_sphere(axes, name, motion, f"C{i}")
        else:
            paths.append(numbers(motion.kinematics.position))
            axes.plot(*paths[-1].T, color=f"C{i}", linewidth=1.4, label=name or None)
    everything = np.concatenate(paths)
    equal_axes(axes, everything)
    length = 0.08 * max(float(np.ptp(everything, axis=0).max()), 1e-3)
    for motion in drawn.values():
        if motion.kinematics.position is not None and motion.kinematics.rotation is not None and frames:
            _draw_frames(axes, motion, frames, length)
    turning = [motion.kinematics.position is None for motion in drawn.values()]
    if all(turning):
        for axis in AXES:
            getattr(axes, f"set_{axis}label")(axis)
    if any(drawn) or any(turning):
        axes.legend(fontsize=8)
    axes.set_title(title)
    return figure


def rates(
    trajectories: Trajectory | Mapping[str, Trajectory],
    t: Tensor | None = None,
    *,
    quantities: Sequence[str] = ("velocity", "angular_velocity"),
    title: str = "",
) -> "Figure":
    """Lengths of velocities and accelerations over time, one panel for each.

    Args:
        trajectories: one, or several by name.
        t: (N,) times to draw, within the domains of all of them; by default each from end to end.
        quantities: "velocity", "acceleration" (of the body's origin), "angular_velocity", "angular_acceleration".
            What a trajectory does not have (an angular velocity in R3) is left out.
    Raises:
        TypeError, ValueError: a wrong type or value, or a batch of trajectories.
    """
    if isinstance(quantities, str) or not isinstance(quantities, Sequence) or not quantities:
        raise TypeError(f"quantities: expected a sequence of names, got {quantities!r}")
    for quantity in quantities:
        checks.choice("quantities", quantity, tuple(QUANTITIES))
    drawn = {name: motion_of(x, t) for name, x in named(trajectories).items()}
    figure = new_figure(9, 0.6 + 2.2 * len(quantities))
    panels = figure.subplots(len(quantities), 1, sharex=True, squeeze=False)[:, 0]
    for axes, quantity in zip(panels, quantities, strict=True):
        for i, (name, motion) in enumerate(drawn.items()):
            x = getattr(motion.kinematics, quantity)
            if x is not None:
                axes.plot(motion.seconds, numbers(x.norm(dim=-1)), color=f"C{i}", label=name or None)
        axes.set_ylabel(f"{quantity.replace('_', ' ')} [{QUANTITIES[quantity]}]")
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
    panels[-1].set_xlabel(next(iter(drawn.values())).label)
    if any(drawn):
        lines = {
            line.get_label(): line for axes in panels for line in axes.lines
        }  # some have no line in the first
        panels[0].legend(lines.values(), lines.keys(), fontsize=8)
    panels[0].set_title(title)
    return figure


def covariance_tube(
    trajectory: Trajectory,
    t: Tensor,
    covariance: Tensor,
    *,
    sigmas: float = 3.0,
    title: str = "",
) -> "Figure":
    """The path inside the tube that its position keeps to, and standard deviations along the axes of the world.

    Across the path the tube is the ellipse of `sigmas` standard deviations.

    Args:
        t: (N,) times, two or more.
        covariance: (N, D, D) of the value's tangent, as `Result.trajectory_covariance(t)` gives it: of the body
            frame on SE3 and DualQuaternion. Parts beyond the position may be there.
        sigmas: standard deviations from the path to the surface.
    Raises:
        TypeError, ValueError: a wrong type, shape or value, or a group without positions.
    """
    checks.instance("trajectory", trajectory, Trajectory, "a torchspline.Trajectory")
    checks.is_floating_tensor("covariance", covariance)
    checks.positive("sigmas", sigmas)
    name = trajectory.group.name
    if name not in _POSITION_IN_BODY:
        raise ValueError(
            f"trajectory: expected one with positions, of {', '.join(_POSITION_IN_BODY)}, got {name}"
        )
    motion = motion_of(trajectory, t)
    count = len(motion.seconds)
    if count < 2:
        raise ValueError(f"t: expected two times or more, got {count}")
    if covariance.ndim != 3 or covariance.shape[0] != count or min(covariance.shape[1:]) < 3:
        raise ValueError(
            f"covariance: expected shape ({count}, D, D), D at least 3, got {tuple(covariance.shape)}"
        )
    checks.finite("covariance", covariance)
    block = covariance[:, :3, :3].detach().to("cpu", torch.float64)
    if _POSITION_IN_BODY[name]:
        assert motion.kinematics.rotation is not None
        R = SO3.to_matrix(motion.kinematics.rotation.to("cpu", torch.float64))
        block = R @ block @ R.mT
    assert motion.kinematics.position is not None
    path = numbers(motion.kinematics.position)
    figure = new_figure(12, 6)
    axes: Any = figure.add_subplot(1, 2, 1, projection="3d")
    surface = path[:, None] + sigmas * _ellipses(path, numbers(block))
    axes.plot_surface(
        *np.moveaxis(surface, -1, 0), color="C0", alpha=0.25, linewidth=0, rcount=200, ccount=24
    )
    axes.plot(*path.T, color="C0", linewidth=1.2)
    equal_axes(axes, surface.reshape(-1, 3))
    axes.set_title(title or f"{sigmas:g} standard deviations")
    below: Any = figure.add_subplot(1, 2, 2)
    deviations = numbers(block.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt())
    for axis, color, x in zip(AXES, AXIS_COLORS, deviations.T, strict=True):
        below.plot(motion.seconds, 1e3 * x, color=color, label=axis)
    below.set_xlabel(motion.label)
    below.set_ylabel("standard deviation of the position [mm]")
    below.set_ylim(bottom=0.0)
    below.grid(alpha=0.3)
    below.legend(fontsize=8)
    return figure


def _ellipses(path: Array, covariance: Array) -> Array:
    """(N, A, 3): the ellipse of one standard deviation across the path at each of its points."""
    tangent = np.gradient(path, axis=0)
    length = np.linalg.norm(tangent, axis=-1, keepdims=True)
    tangent = np.where(length > 0, tangent / np.where(length > 0, length, 1.0), [1.0, 0.0, 0.0])
    # One direction for all points, or the surface would be twisted where it changes: that of many, spread over the
    # sphere, that the path keeps off most.
    directions = _spread(200)
    aside = directions[np.abs(directions @ tangent.T).max(axis=1).argmin()]
    first = np.cross(tangent, aside)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(tangent, first)
    plane = np.stack([first, second], axis=-1)  # (N, 3, 2)
    across = plane.swapaxes(-1, -2) @ covariance @ plane
    values, vectors = np.linalg.eigh(across)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :] @ vectors.swapaxes(-1, -2)
    angle = np.linspace(0.0, 2 * np.pi, _AROUND)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return (plane @ root @ circle).swapaxes(-1, -2)


def _spread(count: int) -> Array:
    """Directions evenly over the sphere, on a spiral of golden angles: (count, 3)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)


def _draw_frames(axes: Any, motion: Motion, frames: int, length: float) -> None:
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    assert motion.kinematics.rotation is not None
    assert motion.kinematics.position is not None
    rows = np.unique(np.linspace(0, len(motion.seconds) - 1, frames).round().astype(int))
    origin = numbers(motion.kinematics.position)[rows]
    R = numbers(SO3.to_matrix(motion.kinematics.rotation))[rows]
    for i, color in enumerate(AXIS_COLORS):
        tips = origin + length * R[:, :, i]
        axes.add_collection3d(
            Line3DCollection(np.stack([origin, tips], axis=1), colors=color, linewidths=1.2)
        )


def _axes_on_sphere(axes: Any, name: str, motion: Motion, color: str) -> list[Array]:
    assert motion.kinematics.rotation is not None
    R = numbers(SO3.to_matrix(motion.kinematics.rotation))
    for i, (axis, style) in enumerate(zip(AXES, ("-", "--", ":"), strict=True)):
        axes.plot(*R[:, :, i].T, style, color=color, linewidth=1.2, label=f"{name} body {axis}".strip())
    return [R[:, :, i] for i in range(3)]
