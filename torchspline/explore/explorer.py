"""What is explored, without a window: keyframes, the methods chosen, and the curves they make."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups import R3, SE3, SO3, Group
from torchspline.groups.convert import pose_to_dual_quaternion
from torchspline.io import PoseRecord, load_trajectory, read_poses
from torchspline.plot import basis_functions
from torchspline.plot.figure import equal_axes, new_figure, numbers, times_of
from torchspline.splines import KeyframeSpline
from torchspline.splines.interpolation.registry import SCHEMES, SURVEY
from torchspline.units import SECOND

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_GROUPS = ("R3xSO3", "SE3", "DualQuaternion")
_ON = " on "
#: Everything that can be chosen: the names of [H18], and every scheme on every group of poses.
METHODS: tuple[str, ...] = (*SURVEY, *(f"{scheme}{_ON}{group}" for scheme in SCHEMES for group in _GROUPS))
#: Lengths over time that are shown, with units.
LENGTHS = {
    "velocity": "m/s", "acceleration": "m/s²", "angular_velocity": "rad/s", "angular_acceleration": "rad/s²",
}  # fmt: skip


@dataclass(frozen=True)
class Curve:
    """What a method makes of the keyframes."""

    method: str
    #: (N,) s.
    t: Tensor
    #: (N, 3) m; of a method for rotations, straight lines between the keys.
    position: Tensor
    #: (N, 4) quaternions [w, x, y, z], body to world; None of a method for positions.
    rotation: Tensor | None
    #: By the names of `LENGTHS`: (N,); what the method says nothing about is not there.
    lengths: dict[str, Tensor]


class Explorer:
    """Keyframes that can be moved, and the curves of any methods through or near them.

    Args:
        keyframes: (M, 7) poses [x, y, z, qw, qx, qy, qz], M at least 2; by default a small motion.
        times: (M,) s, increasing; by default a second apart.
        methods: names out of `METHODS`.
    Raises:
        TypeError, ValueError: a wrong type, shape or value, or an unknown method.
    """

    def __init__(
        self,
        keyframes: Tensor | None = None,
        times: Tensor | None = None,
        methods: Sequence[str] = ("SPLIT", "SPLIT SQUAD", "SPLIT CuBsp"),
    ):
        if keyframes is None:
            keyframes = _example()
        checks.points("keyframes", keyframes, SE3, least=2)
        if keyframes.ndim != 2:
            raise ValueError(f"keyframes: expected shape (M, 7), got {tuple(keyframes.shape)}")
        if times is None:
            times = torch.arange(len(keyframes), dtype=torch.float64)
        checks.is_floating_tensor("times", times)
        if times.shape != keyframes.shape[:1]:
            raise ValueError(f"times: expected shape ({len(keyframes)},), got {tuple(times.shape)}")
        checks.finite("times", times)
        if bool((times.diff() <= 0).any()):
            raise ValueError(f"times: expected increasing times, got {times.tolist()}")
        self.keyframes = keyframes.detach().to("cpu", torch.float64).clone()
        self.times = times.detach().to("cpu", torch.float64).clone()
        self.methods: list[str] = []
        self.choose(methods)

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        count: int = 8,
        methods: Sequence[str] = ("SPLIT", "SPLIT SQUAD", "SPLIT CuBsp"),
        format: str | None = None,
        times: str | PathLike[str] | None = None,
    ) -> "Explorer":
        """Keyframes out of a file: `count` poses, as evenly spaced in time as there are any.

        Args:
            path: a file of poses, or one of `torchspline.io.save_trajectory` (.npz).
            format, times: as in `torchspline.io.read_poses`.
        Raises:
            FileNotFoundError: no such file. ValueError: one that cannot be read, or with fewer than two poses.
        """
        checks.whole("count", count, least=2)
        path = Path(path)
        if path.suffix == ".npz":
            trajectory = load_trajectory(path)
            t = times_of(trajectory, count)
            with torch.no_grad():
                motion = trajectory.kinematics(t)
            if motion.position is None or motion.rotation is None or motion.position.ndim != 2:
                raise ValueError(f"{path}: expected one trajectory of poses, got {trajectory.group}")
            poses = torch.cat([motion.position, motion.rotation], -1)
            seconds = (t - t[0]).double() / (SECOND if t.dtype == torch.int64 else 1.0)
        else:
            seconds, poses = _some_of(read_poses(path, format, times), count)
        return cls(poses, seconds, methods)

    def choose(self, methods: Sequence[str]) -> None:
        """Show these methods.

        Raises:
            ValueError: an unknown one.
        """
        if isinstance(methods, str):
            raise TypeError("methods: expected a sequence of names, got str")
        for method in methods:
            checks.choice("methods", method, METHODS)
        self.methods = list(dict.fromkeys(methods))

    def move(self, index: int, position: Sequence[float], rotation: Sequence[float]) -> None:
        """Put a keyframe somewhere else: position (3) in m, quaternion (4) [w, x, y, z]."""
        if not 0 <= index < len(self.keyframes):
            raise ValueError(f"index: expected one of the {len(self.keyframes)} keyframes, got {index}")
        pose = torch.tensor([*map(float, position), *map(float, rotation)], dtype=torch.float64)
        checks.point("position, rotation", pose, SE3, "x, y, z, qw, qx, qy, qz")
        self.keyframes[index] = pose

    def add(self) -> None:
        """One keyframe more at the end, as far from the last as that from the one before it."""
        last, before = self.keyframes[-1], self.keyframes[-2]
        new = SE3.compose(last, SE3.between(before, last))
        self.keyframes = torch.cat([self.keyframes, new[None]])
        self.times = torch.cat([self.times, 2 * self.times[-1:] - self.times[-2:-1]])

    def remove(self) -> None:
        """Take the last keyframe away; two stay."""
        if len(self.keyframes) > 2:
            self.keyframes, self.times = self.keyframes[:-1], self.times[:-1]

    def curve(self, method: str, samples: int = 300) -> Curve:
        """The curve of one method.

        Raises:
            ValueError: an unknown method, or too few keyframes for it.
        """
        checks.choice("method", method, METHODS)
        checks.whole("samples", samples, least=2)
        scheme, group = resolve(method)
        keys = {"R3": self.keyframes[:, :3], "SO3": self.keyframes[:, 3:]}.get(group, self.keyframes)
        if group == "DualQuaternion":
            keys = pose_to_dual_quaternion(keys)
        spline = KeyframeSpline(scheme, keys, self.times, group=Group(group), learnable=False)
        shares = torch.linspace(0.0, 1.0, samples, dtype=torch.float64)
        first, last = spline.domain
        t = (first + (last - first) * shares).clamp(first, last)
        with torch.no_grad():
            motion = spline.kinematics(t)
            position = motion.position
            if position is None:
                lines = KeyframeSpline(
                    "geodesic", self.keyframes[:, :3], self.times, group=R3, learnable=False
                )
                position = lines(t)
        lengths = {name: x.norm(dim=-1) for name in LENGTHS if (x := getattr(motion, name)) is not None}
        return Curve(method, t, position, motion.rotation, lengths)

    def curves(self, samples: int = 300) -> tuple[list[Curve], dict[str, str]]:
        """The curves of the methods chosen, and what was wrong with those that made none."""
        checks.whole("samples", samples, least=2)
        found, wrong = [], {}
        for method in self.methods:
            try:
                found.append(self.curve(method, samples))
            except ValueError as error:
                wrong[method] = str(error)
        return found, wrong

    def weights(self, method: str, samples: int = 300) -> tuple[Tensor, Tensor]:
        """Times (N,) and basis functions (N, M) of a method, see `plot.basis`."""
        checks.choice("method", method, METHODS)
        checks.whole("samples", samples, least=2)
        t = torch.linspace(float(self.times[0]), float(self.times[-1]), samples, dtype=torch.float64)
        t = t.clamp(float(self.times[0]), float(self.times[-1]))
        return t, basis_functions(resolve(method)[0], self.times, t)

    def figure(self) -> "Figure":
        """Curves with frames, lengths of velocities and accelerations, and the first method's basis functions."""
        found, _ = self.curves()
        if not found:
            raise ValueError("methods: expected at least one that makes a curve of the keyframes, got none")
        figure = new_figure(15, 9)
        halves: Any = figure.subfigures(1, 2, width_ratios=[1.1, 1.0])
        left, right = halves
        axes: Any = left.add_subplot(projection="3d")
        keys = numbers(self.keyframes[:, :3])
        axes.plot(*keys.T, "o", color="black", markersize=4, label="keys")
        size = 0.06 * float((keys.max(0) - keys.min(0)).max() or 1.0)
        for i, curve in enumerate(found):
            axes.plot(*numbers(curve.position).T, color=f"C{i}", linewidth=1.5, label=curve.method)
            if curve.rotation is None:
                continue
            rows = torch.linspace(0, len(curve.t) - 1, 12).round().long()
            R = SO3.to_matrix(curve.rotation[rows])
            for axis, color in enumerate(("C3", "C2", "C0")):
                ends = torch.stack([curve.position[rows], curve.position[rows] + size * R[..., axis]], 1)
                for line in numbers(ends):
                    axes.plot(*line.T, color=color, linewidth=0.8)
        equal_axes(axes, numbers(torch.cat([curve.position for curve in found])))
        axes.legend(fontsize=8)
        panels = right.subplots(len(LENGTHS) + 1, 1, sharex=True)
        for panel, (name, unit) in zip(panels, LENGTHS.items(), strict=False):
            for i, curve in enumerate(found):
                if name in curve.lengths:
                    panel.plot(numbers(curve.t), numbers(curve.lengths[name]), color=f"C{i}")
            panel.set_ylabel(f"{name.replace('_', ' ')}\n[{unit}]", fontsize=8)
            panel.grid(alpha=0.3)
        panels[-1].plot(*map(numbers, self.weights(found[0].method)))
        panels[-1].set_ylabel(f"basis functions\n{found[0].method}", fontsize=8)
        panels[-1].set_xlabel("time [s]")
        panels[-1].grid(alpha=0.3)
        return figure


def resolve(method: str) -> tuple[str, str]:
    """The scheme of a name out of `METHODS`, and the group of poses, positions or rotations that it works in."""
    if method in SURVEY:
        scheme, group = SURVEY[method]
        return scheme, "R3" if group == "Rn" else group
    scheme, group = method.split(_ON)
    return scheme, group


def _example() -> Tensor:
    """Four keys: around a corner and up, with turns about all axes."""
    turns = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.4], [0.9, 0.3, 1.2], [0.2, -0.8, 2.4], [0.0, 0.0, 3.0]]
    places = [[0.0, 0.0, 0.0], [2.0, 0.3, 0.2], [2.5, 2.0, 1.0], [0.8, 2.6, 1.6], [-0.5, 1.2, 0.8]]
    rotation = SO3.exp(torch.tensor(turns, dtype=torch.float64))
    return torch.cat([torch.tensor(places, dtype=torch.float64), rotation], -1)


def _some_of(record: PoseRecord, count: int) -> tuple[Tensor, Tensor]:
    """Seconds (M,) and poses (M, 7) of at most `count` rows that are usable and at distinct times."""
    good = record.position.isfinite().all(-1) & record.rotation.isfinite().all(-1)
    good &= record.rotation.norm(dim=-1) > 0
    rows = torch.nonzero(good).flatten()
    rows = rows[torch.argsort(record.time_ns[rows], stable=True)]
    stamps = record.time_ns[rows]
    fresh = torch.ones(len(rows), dtype=torch.bool)
    fresh[1:] = stamps.diff() > 0
    rows, stamps = rows[fresh], stamps[fresh]
    if len(rows) < 2:
        raise ValueError(f"{record.source}: expected two usable poses at distinct times, got {len(rows)}")
    shares = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
    wanted = stamps[0] + ((stamps[-1] - stamps[0]) * shares).round().to(torch.int64)
    at = torch.searchsorted(stamps, wanted).clamp(max=len(stamps) - 1)
    at -= ((at > 0) & (wanted - stamps[(at - 1).clamp(0)] < stamps[at] - wanted)).long()
    at = at.unique()
    chosen = rows[at]
    poses = torch.cat([record.position[chosen], record.rotation[chosen]], -1)
    return (stamps[at] - stamps[0]).double() / SECOND, poses
