"""Sensors of what surrounds a body: magnetometer and barometer."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups.group import SO3
from torchspline.imu.base import Sensor
from torchspline.imu.earth import standard_pressure
from torchspline.imu.filters import LowPass
from torchspline.imu.noise import Generators, random_walk, white_noise
from torchspline.imu.parts import (
    Given,
    above_zero,
    along_time,
    drawing_device,
    keep,
    sample_rate,
    tensor_of,
    times_of,
)
from torchspline.imu.quantise import quantise, saturate
from torchspline.imu.sampling import Sampling, in_order
from torchspline.splines.trajectory import Kinematics, Trajectory


class AmbientReadings(NamedTuple):
    """What a sensor reports, and the truth about it.

    `value` (..., N, 3) or (..., N), zero where the sample was lost; `valid` (..., N) whether it arrived; `bias`, like
    `value`, what was added besides white noise; `t` its stamps as they were asked for, `instants` the times of the
    trajectory at which it was taken.
    """

    value: Tensor
    t: Tensor
    valid: Tensor
    bias: Tensor
    instants: Tensor


class _Ambient(Sensor):
    """Sampling, bandwidth, noise and converter, which these sensors share; values have `channels` components."""

    channels: int
    bias: Tensor | None
    noise_density: Tensor | None
    random_walk: Tensor | None
    range: Tensor | None
    resolution: Tensor | None

    def __init__(
        self,
        bias: Given,
        noise_density: Given,
        random_walk: Given,
        rate: float | None,
        low_pass: LowPass | None,
        range: Given,
        resolution: Given,
        sampling: Sampling,
        dtype: torch.dtype | None,
    ):
        super().__init__(rate, dtype)
        if low_pass is not None:
            checks.instance("low_pass", low_pass, LowPass, "a torchspline.imu.LowPass")
        self.low_pass = low_pass
        self._take("bias", bias, self.channels)
        for name, x, zero_too in (
            ("noise_density", noise_density, True),
            ("random_walk", random_walk, True),
            ("range", range, False),
            ("resolution", resolution, False),
        ):
            above_zero(name, self._take(name, x, self.channels), zero_too)
        self.sampling = sampling

    def _take(self, name: str, x: Any, *shape: int) -> Tensor | None:
        one = shape == (1,) and isinstance(x, Tensor)  # of a single channel, a batch is (*batch,)
        taken = tensor_of(name, x, () if one else shape, "x, y, z" if shape[0] == 3 else "a number")
        if one and taken is not None:
            taken = taken.unsqueeze(-1)
        keep(self, name, taken)
        return taken

    def _signal(self, motion: Kinematics) -> Tensor:
        """The noiseless values (*batch, N, channels)."""
        raise NotImplementedError

    def _sensed(self, trajectory: Trajectory, t: Tensor, generator: Generators) -> AmbientReadings:
        times_of(t, trajectory)
        at = t.reshape(1) if t.ndim == 0 else t
        instants, valid = self._instants(trajectory, at, generator)
        motion = trajectory.kinematics(instants)
        moving = motion.rotation if motion.rotation is not None else motion.position
        assert moving is not None
        checks.broadcast(trajectory=moving.shape[:-2], **self._batches())
        signal = self._signal(motion)
        if self.low_pass is not None:
            if self.sampling.jitter is not None:
                in_order(instants)
            signal = self.low_pass(signal, instants)
        if self.dtype is not None:
            signal = signal.to(self.dtype)
        bias = signal.new_zeros(1, self.channels) if self.bias is None else along_time(self.bias, signal)
        bias = bias if bias.ndim > 1 else bias.unsqueeze(0)
        densities = [
            None if x is None else along_time(x, signal) for x in (self.noise_density, self.random_walk)
        ]
        batches = [x.shape[:-2] for x in (signal, bias, *densities) if x is not None]
        batch = torch.broadcast_shapes(*batches, valid.shape[:-1])
        if isinstance(generator, Sequence) and not batch:
            batch = torch.Size([len(generator)])
        shape = (*batch, at.shape[-1], self.channels)
        white, walk = densities
        home = drawing_device(generator, signal.device)
        if white is not None:
            rate = sample_rate(at.to(home), self.rate)
            rate = rate if rate.ndim == 0 else rate[..., None, None]
            drawn = white_noise(shape, white.to(home), rate, generator, signal.dtype)
            signal = signal + drawn.to(signal.device)
        if walk is not None:
            drawn = random_walk(shape, walk.to(home), at.to(home), generator, signal.dtype)
            bias = bias + drawn.to(signal.device)
        signal = signal + bias
        if self.range is not None:
            signal = saturate(signal, along_time(self.range, signal))
        if self.resolution is not None:
            signal = quantise(signal, along_time(self.resolution, signal))
        bias, valid = bias.expand(shape), valid.expand(shape[:-1])
        if self.sampling.drop_probability is not None:
            signal = signal.masked_fill(~valid.unsqueeze(-1), 0.0)
        if t.ndim == 0:
            signal, bias, valid, instants = (
                signal[..., 0, :],
                bias[..., 0, :],
                valid[..., 0],
                instants[..., 0],
            )
        if self.channels == 1:
            signal, bias = signal.squeeze(-1), bias.squeeze(-1)
        return AmbientReadings(signal, t, valid, bias, instants)


class Magnetometer(_Ambient):
    """A magnetometer on a rotating body: `S R_sensor^T R^T field + bias`, in the unit of the field.

    Sampling, low-pass filter, bias walk, white noise, range and resolution as in `Imu`. Parameters are numbers,
    sequences or tensors, (n,) or (*batch, n).

    Args:
        field: (3,) in the world, such as `earth.dipole_field(latitude, longitude)` in microtesla.
        rotation: quaternion (4,), sensor to body. soft_iron: S, (3, 3). bias: hard iron and offset, (3,).
        noise_density: unit/sqrt(Hz). random_walk: of the bias, unit/s/sqrt(Hz).
        rate: Hz, samples that the sensor takes; None: from the mean interval of the stamps.
        low_pass: a filter. range: largest magnitude. resolution: step of the converter.
        time_offset, time_skew, jitter, drop_probability: see `Imu`. dtype: of the readings.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """

    channels = 3
    field: Tensor
    rotation: Tensor | None
    soft_iron: Tensor | None
    matrices = ("soft_iron",)

    def __init__(
        self,
        field: Tensor | Sequence[float],
        *,
        rotation: Given = None,
        soft_iron: Tensor | Sequence[Sequence[float]] | None = None,
        bias: Given = None,
        noise_density: Given = None,
        random_walk: Given = None,
        rate: float | None = None,
        low_pass: LowPass | None = None,
        range: Given = None,
        resolution: Given = None,
        time_offset: Tensor | float = 0.0,
        time_skew: Tensor | float = 0.0,
        jitter: Tensor | float = 0.0,
        drop_probability: Tensor | float = 0.0,
        dtype: torch.dtype | None = None,
    ):
        sampling = Sampling(time_offset, time_skew, jitter, drop_probability)
        super().__init__(bias, noise_density, random_walk, rate, low_pass, range, resolution, sampling, dtype)
        if field is None:
            raise TypeError("field: expected a tensor or three numbers, got None")
        self._take("field", field, 3)
        keep(self, "soft_iron", tensor_of("soft_iron", soft_iron, (3, 3), "a matrix"))
        turn = tensor_of("rotation", rotation, (4,), "a quaternion [w, x, y, z]")
        if turn is not None:
            checks.quaternions("rotation", turn, [(0, 4)])
        keep(self, "rotation", turn)
        checks.broadcast(**self._batches())

    def forward(self, trajectory: Trajectory, t: Tensor, generator: Generators = None) -> AmbientReadings:
        """Readings with the stamps `t`, (N,) or (*batch, N); see `Imu.forward`.

        Returns:
            AmbientReadings: `value` (*batch, N, 3), in the frame of the sensor and the unit of the field.
        Raises:
            TypeError, ValueError: a wrong type, shape or value, times outside the domain, or a trajectory without
                rotation.
        """
        return self._sensed(trajectory, t, generator)

    def _signal(self, motion: Kinematics) -> Tensor:
        q = motion.rotation
        if q is None:
            raise ValueError("trajectory: expected one with rotation, such as SO3 or R3xSO3, got one without")
        field = along_time(self.field, q)
        if self.rotation is not None:
            q = SO3.compose(q, along_time(self.rotation, q), validate=False)
        seen = SO3.act(SO3.inverse(q, validate=False), field, validate=False)
        return seen if self.soft_iron is None else seen @ self.soft_iron.to(seen).mT


class Barometer(_Ambient):
    """A barometer on a moving body: standard pressure at its height, Pa.

    Sampling, low-pass filter, bias walk (weather), white noise, range and resolution as in `Imu`. Parameters are
    numbers, sequences or tensors, (*batch,) or (*batch, 3).

    Args:
        ground_height: m above mean sea level, of the origin of the world. up: (3,), the vertical in the world.
        lever_arm: (3,), position of the sensor in the body, m.
        bias: Pa. noise_density: Pa/sqrt(Hz). random_walk: of the bias, Pa/s/sqrt(Hz).
        rate: Hz, samples that the sensor takes; None: from the mean interval of the stamps.
        low_pass: a filter. range: largest pressure. resolution: step of the converter, Pa.
        time_offset, time_skew, jitter, drop_probability: see `Imu`. dtype: of the readings.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """

    channels = 1
    ground_height: Tensor
    up: Tensor
    lever_arm: Tensor | None

    def __init__(
        self,
        *,
        ground_height: Tensor | float = 0.0,
        up: Tensor | Sequence[float] = (0.0, 0.0, 1.0),
        lever_arm: Given = None,
        bias: Given = None,
        noise_density: Given = None,
        random_walk: Given = None,
        rate: float | None = None,
        low_pass: LowPass | None = None,
        range: Given = None,
        resolution: Given = None,
        time_offset: Tensor | float = 0.0,
        time_skew: Tensor | float = 0.0,
        jitter: Tensor | float = 0.0,
        drop_probability: Tensor | float = 0.0,
        dtype: torch.dtype | None = None,
    ):
        sampling = Sampling(time_offset, time_skew, jitter, drop_probability)
        super().__init__(bias, noise_density, random_walk, rate, low_pass, range, resolution, sampling, dtype)
        for name, x in (("ground_height", ground_height), ("up", up)):
            if x is None:
                raise TypeError(f"{name}: expected a tensor or numbers, got None")
        self._take("ground_height", ground_height, 1)
        vertical = self._take("up", up, 3)
        assert vertical is not None
        checks.unit_length("up", vertical, 1e-6)
        self._take("lever_arm", lever_arm, 3)
        checks.broadcast(**self._batches())

    def forward(self, trajectory: Trajectory, t: Tensor, generator: Generators = None) -> AmbientReadings:
        """Readings with the stamps `t`, (N,) or (*batch, N); see `Imu.forward`.

        Returns:
            AmbientReadings: `value` (*batch, N), Pa.
        Raises:
            TypeError, ValueError: a wrong type, shape or value, times outside the domain, or a trajectory without
                position, or without the rotation that a lever arm needs.
        """
        return self._sensed(trajectory, t, generator)

    def _signal(self, motion: Kinematics) -> Tensor:
        p = motion.position
        if p is None:
            raise ValueError("trajectory: expected one with position, such as R3 or R3xSO3, got one without")
        if self.lever_arm is not None:
            if motion.rotation is None:
                raise ValueError(
                    "trajectory: expected one with rotation, which lever_arm needs, got one without"
                )
            p = p + SO3.act(motion.rotation, along_time(self.lever_arm, p), validate=False)
        height = (p * along_time(self.up, p)).sum(-1, keepdim=True) + along_time(self.ground_height, p)
        return standard_pressure(height)
