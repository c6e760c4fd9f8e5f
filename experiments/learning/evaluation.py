"""Orientation from the gyroscope alone, against poses."""

import math
from typing import NamedTuple

import torch
from recordings.load import Recording, usable
from torch import Tensor

from learning.training import LAGS
from torchspline import SO3, imu
from torchspline.io import PoseRecord
from torchspline.units import SECOND

#: s, between the starts of compared windows.
STRIDE = 0.5
#: s: poses farther from where one is wanted are not used.
NEAR = 0.01


class Errors(NamedTuple):
    """RMS angles in rad: over each lag of `LAGS`, and over the whole run of the rotation and of the tilt alone."""

    lags: list[float]
    whole: float
    tilt: float
    # For figures: times (s) and angles of the whole run.
    time: Tensor
    angle: Tensor


def orientation_errors(recording: Recording, gyroscope: Tensor) -> Errors:
    """What integrating `gyroscope`, (N, 3) corrected readings at the recording's stamps, makes of the poses."""
    stamps, poses = recording.samples.time_ns, usable(recording.poses)
    rotation = imu.integrate_gyroscope(gyroscope, stamps)
    origin = int(stamps[0])
    at, true = _on_grid(poses, int(stamps[0]), int(stamps[-1]))
    made = _at(rotation, stamps, at)
    lags = []
    for lag in LAGS:
        steps = round(lag / STRIDE)
        # Pairs of poses that are there at both ends.
        keys = ((at - origin).to(torch.float64) / SECOND / STRIDE).round().to(torch.int64)
        there = torch.searchsorted(keys, keys + steps)
        inside = there < len(keys)
        i, j = torch.nonzero(inside).flatten(), there[inside]
        match = keys[j] == keys[i] + steps
        i, j = i[match], j[match]
        a, b = SO3.between(true[i], true[j]), SO3.between(made[i], made[j])
        lags.append(rms(SO3.log(SO3.between(a, b)).norm(dim=-1)))
    aligned = SO3.compose(SO3.compose(true[0], SO3.inverse(made[0])), made)
    angle = SO3.log(SO3.between(true, aligned)).norm(dim=-1)
    up = true.new_tensor([0.0, 0.0, 1.0])
    a, b = (SO3.act(SO3.inverse(x), up.expand(len(x), 3)) for x in (true, aligned))
    tilt = torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))
    return Errors(lags, rms(angle), rms(tilt), (at - origin).to(torch.float64) / SECOND, angle)


def bias_from_poses(recording: Recording) -> Tensor:
    """The median difference between the gyroscope and the mean rates of the poses."""
    stamps, poses = recording.samples.time_ns, usable(recording.poses)
    rotation = imu.integrate_gyroscope(recording.samples.gyroscope, stamps)
    at, true = _on_grid(poses, int(stamps[0]), int(stamps[-1]))
    made = _at(rotation, stamps, at)
    h = at.diff().to(torch.float64)[:, None] / SECOND
    near = (h < 1.5 * STRIDE).flatten()
    a, b = SO3.between(true[:-1], true[1:]), SO3.between(made[:-1], made[1:])
    error = SO3.log(SO3.between(a, b)) / h  # in the frame at the end of each step
    # A bias turns by the rotation of a step while it acts: half of it is a good mean.
    half = SO3.exp(0.5 * SO3.log(a))
    return SO3.act(half, error)[near].median(0).values


def stillest(recording: Recording, within: float = 20.0, length: float = 1.0) -> Tensor:
    """Mean of the gyroscope over the second in which it varies least, among the first `within` s."""
    count = round(length / recording.samples.seconds().diff().median().item())
    gyroscope = recording.samples.gyroscope
    pieces = gyroscope[: len(gyroscope) // count * count].unflatten(0, (-1, count))[: int(within / length)]
    return pieces.mean(1)[pieces.std(1).norm(dim=-1).argmin()]


def _on_grid(poses: PoseRecord, first: int, last: int) -> tuple[Tensor, Tensor]:
    """Stamps and rotations of the poses nearest to a grid of STRIDE from the first reading on."""
    time, order = torch.sort(poses.time_ns)
    inside = (time >= first) & (time <= last)
    time, rotation = time[inside], poses.rotation[order][inside]
    grid = torch.arange(first, last, round(STRIDE * SECOND))
    right = torch.searchsorted(time, grid).clamp(1, len(time) - 1)
    nearest = torch.where(grid - time[right - 1] < time[right] - grid, right - 1, right)
    near = (time[nearest] - grid).abs() < NEAR * SECOND
    return time[nearest][near], rotation[nearest][near]


def _at(rotation: Tensor, stamps: Tensor, at: Tensor) -> Tensor:
    """Rotations between stamps, by geodesics."""
    right = torch.searchsorted(stamps, at).clamp(1, len(stamps) - 1)
    share = (at - stamps[right - 1]).to(torch.float64) / (stamps[right] - stamps[right - 1])
    return SO3.interpolate(rotation[right - 1], rotation[right], share)


def rms(x: Tensor) -> float:
    return math.sqrt(x.square().mean().item())
