"""An inertial measurement unit with everything that is wrong with it, as a layer."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchspline import checks
from torchspline.groups.group import SE3, SO3
from torchspline.imu import stamps
from torchspline.imu.base import Sensor
from torchspline.imu.calibration import lower_triangular, sensor_matrix
from torchspline.imu.filters import LowPass
from torchspline.imu.ideal import Scene, exposure
from torchspline.imu.increments import Increments, compensate, sampled_increments
from torchspline.imu.noise import (
    Generators,
    flicker_noise,
    gauss_markov,
    random_walk,
    white_noise,
)
from torchspline.imu.parameters import ImuNoise
from torchspline.imu.parts import (
    Given,
    above_zero,
    along_time,
    bias_of,
    drawing_device,
    keep,
    sample_rate,
    tensor_of,
    times_of,
)
from torchspline.imu.quantise import quantise, saturate
from torchspline.imu.sampling import Sampling, excursion, in_order
from torchspline.imu.synthesis import STANDARD_GRAVITY, ImuReading
from torchspline.kernels.mode import plain
from torchspline.splines.trajectory import MECHANICS, Trajectory

BIASES = ("gyroscope_bias", "accelerometer_bias")


class Readings(NamedTuple):
    """What an IMU reports, and the truth about it.

    `gyroscope` (..., N, 3) rad/s, `accelerometer` (..., N, 3) m/s^2, zero where the sample was lost; `valid` (..., N)
    whether it arrived; `gyroscope_bias`, `accelerometer_bias` (..., N, 3) the biases in it, walks included; `t` (N,) or
    (*batch, N) its stamps as they were asked for, `instants` the times of the trajectory at which it was taken.
    """

    gyroscope: Tensor
    accelerometer: Tensor
    t: Tensor
    valid: Tensor
    gyroscope_bias: Tensor
    accelerometer_bias: Tensor
    instants: Tensor


class Imu(Sensor):
    """An IMU: trajectory and stamps in, readings out. Every part is optional; without any it is `measure`.

    Effects in their order, each differentiable in its parameters unless it says otherwise:

    1. *Sampling* at `t = stamp - offset - ...`, with jitter, see `Sampling`.
    2. *Exposure*: angular rate and specific force at the IMU, [S20] (69)-(70): `T_body_imu` with its lever arm, a lever
       arm for each axis of the accelerometer, gravity, the rotation of the earth (with Coriolis' force).
    3. *Bandwidth*: mean over the sample interval that ends with the instant; then low-pass filters.
    4. *Calibration*, Kalibr's: `M_g C w + S C f` and `M_a f`, see `sensor_matrix`.
    5. *Bias*, constant or a trajectory, and its random processes; *white noise*.
    6. *Range*, then *resolution* (gradient straight through); then samples get lost.

    Parameters are numbers, sequences or tensors, (n,) or (*batch, n) where every trajectory of a batch has its own.
    A tensor that requires grad, or a `Parameter`, is used as given, any other as a copy. They are converted to the
    dtype of the trajectory where they meet it.

    Args:
        noise: densities and random biases; None: no noise.
        rate: Hz, samples per second that the sensor takes; None: from the mean interval of the stamps, of each row.
        gyroscope_bias, accelerometer_bias: (3,) rad/s and m/s^2, or a trajectory in R3, read at the instants.
        gyroscope_scale, accelerometer_scale: (3,) factors, 1 is perfect; above zero.
        gyroscope_misalignment, accelerometer_misalignment: (3,) entries yx, zx, zy of lower triangular matrices.
        gyroscope_rotation: quaternion (4,), gyroscope to IMU frame (Kalibr's `C_gyro_i` transposed).
        g_sensitivity: (3, 3), rad/s per m/s^2.
        T_body_imu: SE3 pose (7,) of the IMU in the body.
        accelerometer_arms: (3, 3), where the x, y and z axis of the accelerometer sit in the IMU's frame, m.
        gravity: (3,) m/s^2, acceleration in the world. earth_rate: (3,) rad/s, rotation of the world, in the world.
        averaging: 0, or how many Gauss-Legendre points the mean over a sample interval takes: 2 are exact for motion
            that is cubic within the interval.
        gyroscope_filter, accelerometer_filter: low-pass filters.
        time_offset, time_skew, jitter, drop_probability: see `Sampling`.
        gyroscope_range, accelerometer_range: (3,) or a number, largest magnitude, rad/s and m/s^2.
        gyroscope_resolution, accelerometer_resolution: (3,) or a number, the step of the converter.
        dtype: of the readings; None: that of the trajectory.
    Raises:
        TypeError, ValueError: a wrong type, shape or value.
    """

    gyroscope_bias: Tensor | Trajectory | None
    accelerometer_bias: Tensor | Trajectory | None
    gyroscope_filter: LowPass | None
    accelerometer_filter: LowPass | None
    gyroscope_scale: Tensor | None
    accelerometer_scale: Tensor | None
    gyroscope_misalignment: Tensor | None
    accelerometer_misalignment: Tensor | None
    gyroscope_rotation: Tensor | None
    g_sensitivity: Tensor | None
    T_body_imu: Tensor | None
    accelerometer_arms: Tensor | None
    gravity: Tensor
    earth_rate: Tensor | None
    matrices = ("g_sensitivity", "accelerometer_arms")

    def __init__(
        self,
        *,
        noise: ImuNoise | None = None,
        rate: float | None = None,
        gyroscope_bias: Given | Trajectory = None,
        accelerometer_bias: Given | Trajectory = None,
        gyroscope_scale: Given = None,
        accelerometer_scale: Given = None,
        gyroscope_misalignment: Given = None,
        accelerometer_misalignment: Given = None,
        gyroscope_rotation: Given = None,
        g_sensitivity: Tensor | Sequence[Sequence[float]] | None = None,
        T_body_imu: Given = None,
        accelerometer_arms: Tensor | Sequence[Sequence[float]] | None = None,
        gravity: Given = STANDARD_GRAVITY,
        earth_rate: Given = None,
        averaging: int = 0,
        gyroscope_filter: LowPass | None = None,
        accelerometer_filter: LowPass | None = None,
        time_offset: Tensor | float = 0.0,
        time_skew: Tensor | float = 0.0,
        jitter: Tensor | float = 0.0,
        drop_probability: Tensor | float = 0.0,
        gyroscope_range: Given = None,
        accelerometer_range: Given = None,
        gyroscope_resolution: Given = None,
        accelerometer_resolution: Given = None,
        dtype: torch.dtype | None = None,
    ):
        super().__init__(rate, dtype)
        if noise is not None:
            checks.instance("noise", noise, ImuNoise, "a torchspline.imu.ImuNoise")
        checks.whole("averaging", averaging, 0)
        self.averaging = averaging
        self.noisy = noise is not None
        for field in fields(ImuNoise):  # tensors move, and are learnt, with the module
            x = 0.0 if noise is None else getattr(noise, field.name)
            if isinstance(x, Tensor):
                keep(self, field.name, x)
            else:
                setattr(self, field.name, x)

        def take(name: str, x: Any, shape: tuple[int, ...], meaning: str) -> Tensor | None:
            taken = tensor_of(name, x, shape, meaning)
            keep(self, name, taken)
            return taken

        for name, bias, unit in (
            ("gyroscope_bias", gyroscope_bias, "rad/s"),
            ("accelerometer_bias", accelerometer_bias, "m/s^2"),
        ):
            taken = bias_of(name, bias, 3, unit)
            if isinstance(taken, Trajectory):
                setattr(self, name, taken)
            else:
                keep(self, name, taken)
        for name, x in (
            ("gyroscope_scale", gyroscope_scale),
            ("accelerometer_scale", accelerometer_scale),
            ("gyroscope_range", gyroscope_range),
            ("accelerometer_range", accelerometer_range),
            ("gyroscope_resolution", gyroscope_resolution),
            ("accelerometer_resolution", accelerometer_resolution),
        ):
            above_zero(name, take(name, x, (3,), "one for each axis"))
        take("gyroscope_misalignment", gyroscope_misalignment, (3,), "yx, zx, zy")
        take("accelerometer_misalignment", accelerometer_misalignment, (3,), "yx, zx, zy")
        take("g_sensitivity", g_sensitivity, (3, 3), "rad/s per m/s^2")
        take("accelerometer_arms", accelerometer_arms, (3, 3), "a position for each axis")
        take("earth_rate", earth_rate, (3,), "x, y, z")
        if gravity is None:
            raise TypeError("gravity: expected a tensor or three numbers, got None; (0, 0, 0) means none")
        take("gravity", gravity, (3,), "x, y, z")
        rotation = take("gyroscope_rotation", gyroscope_rotation, (4,), "a quaternion [w, x, y, z]")
        if rotation is not None:
            checks.quaternions("gyroscope_rotation", rotation, [(0, 4)])
        mount = take("T_body_imu", T_body_imu, (7,), "an SE3 pose")
        if mount is not None:
            checks.quaternions("T_body_imu", mount, SE3.arithmetic.unit_blocks)
        for name, low_pass in (
            ("gyroscope_filter", gyroscope_filter),
            ("accelerometer_filter", accelerometer_filter),
        ):
            if low_pass is not None:
                checks.instance(name, low_pass, LowPass, "a torchspline.imu.LowPass")
            setattr(self, name, low_pass)
        self.sampling = Sampling(time_offset, time_skew, jitter, drop_probability)
        checks.broadcast(**self._batches())

    @property
    def noise(self) -> ImuNoise | None:
        """Its densities and random biases, those that are learnt included."""
        if not self.noisy:
            return None
        return ImuNoise(**{field.name: getattr(self, field.name) for field in fields(ImuNoise)})

    def forward(self, trajectory: Trajectory, t: Tensor, generator: Generators = None) -> Readings:
        """Readings with the stamps `t`.

        Args:
            trajectory: of a rigid body with rotation and position.
            t: stamps, seconds or int64 nanoseconds as the trajectory takes them, (N,) or (*batch, N), increasing; a
                scalar drops N.
            generator: of the random numbers; or one for each trajectory of a batch (its first dimension), so that an
                item is the same in whichever batch it is drawn: `[item_generator(seed, i) for i in items]`.
        Returns:
            Readings: in `dtype`, on the trajectory's device.
        Differentiable in the trajectory, float `t` and all parameters but rate and resolution. Where no gradient is
        wanted of the motion and of where the IMU sits (`learnable=False`, or `torch.no_grad()`), it is far faster.
        Raises:
            TypeError, ValueError: a wrong type, shape or value, times outside the domain, or a trajectory without
                rotation or position.
        """
        times_of(t, trajectory)
        if trajectory.group.name not in MECHANICS or trajectory.group.name in ("SO3", "R3"):
            raise ValueError(
                f"trajectory: expected one with rotation and position, such as SE3 or R3xSO3, got {trajectory.group}"
            )
        at = t.reshape(1) if t.ndim == 0 else t
        biases = {n: x for n in BIASES if isinstance(x := getattr(self, n), Trajectory)}
        instants, valid = self._instants(trajectory, at, generator, biases)
        signal = self._filtered(self._exposure(trajectory, at, instants), instants)
        checks.broadcast(trajectory=signal.shape[:-2], **self._batches())
        if self.dtype is not None:
            signal = signal.to(self.dtype)
        matrix = self._matrix(signal)
        if matrix is not None:
            signal = signal @ matrix.mT
        bias, white = self._disturbances(signal, at, instants, generator)
        batch = torch.broadcast_shapes(signal.shape[:-2], bias.shape[:-2], valid.shape[:-1])
        signal = _plus(signal, bias)
        if white is not None:
            signal = _plus(signal, white)
        signal = self._converted(signal)
        lead = (*batch, at.shape[-1])
        bias, valid = bias.expand(*lead, 6), valid.expand(lead)
        if self.sampling.drop_probability is not None:
            signal = signal.masked_fill(~valid.unsqueeze(-1), 0.0)
        if t.ndim == 0:
            signal, bias, valid, instants = (
                signal[..., 0, :],
                bias[..., 0, :],
                valid[..., 0],
                instants[..., 0],
            )
        return Readings(signal[..., :3], signal[..., 3:], t, valid, bias[..., :3], bias[..., 3:], instants)

    def correct(
        self,
        readings: Readings | ImuReading,
        gyroscope_bias: Tensor | None = None,
        accelerometer_bias: Tensor | None = None,
    ) -> ImuReading:
        """Undoes bias, scale, misalignment, rotation and g-sensitivity: angular rate and specific force at the IMU.

        Args:
            readings: anything with `gyroscope` and `accelerometer`, (..., N, 3); of a batch where parameters have one.
            gyroscope_bias, accelerometer_bias: what to take off, broadcasting with the readings, such as the true ones
                of `Readings`. None: the constant ones of this IMU (none where there are none).
        Raises:
            TypeError, ValueError: a wrong type, shape or dtype; a bias that is a trajectory and is not given here.
        """
        _check_readings(readings)
        if isinstance(readings, Readings) and readings.t.ndim == 0:  # as a row of one
            row = ImuReading(readings.gyroscope.unsqueeze(-2), readings.accelerometer.unsqueeze(-2))
            biases = (x if x is None else x.unsqueeze(-2) for x in (gyroscope_bias, accelerometer_bias))
            return ImuReading(*(x.squeeze(-2) for x in self.correct(row, *biases)))
        parts = []
        for name, x, given in (
            ("gyroscope_bias", readings.gyroscope, gyroscope_bias),
            ("accelerometer_bias", readings.accelerometer, accelerometer_bias),
        ):
            own = getattr(self, name)
            if given is None and isinstance(own, Trajectory):
                raise ValueError(
                    f"{name}: this IMU's is a trajectory; expected its values, got None; pass those of the readings"
                )
            if given is not None:
                checks.is_floating_tensor(name, given)
                checks.has_last(name, given, 3, "x, y, z")
                checks.broadcast(**{name: given.shape, "readings": x.shape})
            elif own is not None:
                checks.broadcast(**{name: own.shape[:-1], "readings": x.shape[:-2]})
                given = along_time(own, x, "readings")
            parts.append(x if given is None else x - given.to(x.dtype))
        both = _joined(*parts)
        checks.broadcast(readings=both.shape[:-2], **self._batches())
        matrix = self._matrix(both)
        if matrix is not None:
            both = both @ torch.linalg.inv(matrix).mT
        return ImuReading(both[..., :3], both[..., 3:])

    def increments(self, readings: Readings | ImuReading, t: Tensor) -> Increments:
        """Delta-angles and delta-velocities between the samples of readings, with coning and sculling.

        Of an IMU that averages, readings times intervals are integrals, which `compensate` completes; of one that does
        not, they are samples of a rate that changes evenly in between, `sampled_increments`.

        Args:
            readings: (*batch, N + 1, 3) of this IMU. t: their stamps, increasing, (N + 1,) or (*batch, N + 1).
        Returns:
            Increments: (*batch, N, 3).
        Differentiable in readings and t.
        Raises:
            TypeError, ValueError: a wrong type, shape or value, or samples that were lost.
        """
        _check_readings(readings)
        w, f = readings.gyroscope, readings.accelerometer
        valid = getattr(readings, "valid", None)
        if valid is not None and checks.values_visible(valid) and checks.seen_true(valid.all()) is False:
            raise ValueError(
                f"readings: expected samples that all arrived, got {int((~valid).sum())} lost ones, which read zero; "
                "fill them in, or leave them out with their stamps"
            )
        if not self.averaging:
            return sampled_increments(ImuReading(w, f), t)
        h = stamps.intervals(t, w.shape[:-1], w.dtype, device=w.device).unsqueeze(-1)
        return compensate(Increments(w[..., 1:, :] * h, f[..., 1:, :] * h), t)

    # ------------------------------------------------------------------ parts of the chain

    def _exposure(self, trajectory: Trajectory, at: Tensor, instants: Tensor) -> Tensor:
        mount = self.T_body_imu
        if mount is not None:
            mount = torch.cat([mount[..., :3], SO3.normalize(mount[..., 3:])], dim=-1)
        arms = None if self.accelerometer_arms is None else self.accelerometer_arms.flatten(-2)
        scene = Scene(self.gravity, mount, arms, self.earth_rate)
        if not self.averaging:
            return exposure(trajectory, instants, scene)
        nodes, weights = np.polynomial.legendre.leggauss(self.averaging)
        interval = 1.0 / sample_rate(at, self.rate)
        interval = interval if interval.ndim == 0 else interval.unsqueeze(-1)
        total: Tensor | None = None
        for node, weight in zip(nodes, weights, strict=True):
            part = exposure(trajectory, excursion(trajectory, instants, 0.5 * (node - 1.0) * interval), scene)
            total = part * (0.5 * weight) if total is None else torch.add(total, part, alpha=0.5 * weight)
        assert total is not None
        return total

    def _filtered(self, signal: Tensor, t: Tensor) -> Tensor:
        first, second = self.gyroscope_filter, self.accelerometer_filter
        if first is None and second is None:
            return signal
        if self.sampling.jitter is not None:
            in_order(t)
        if first is second and first is not None:
            return first(signal, t)
        gyroscope, accelerometer = signal[..., :3], signal[..., 3:]
        if first is not None:
            gyroscope = first(gyroscope, t)
        if second is not None:
            accelerometer = second(accelerometer, t)
        return torch.cat(torch.broadcast_tensors(gyroscope, accelerometer), dim=-1)

    def _matrix(self, like: Tensor) -> Tensor | None:
        """6 x 6, made to broadcast along time; None: the identity."""
        gyroscope = (self.gyroscope_scale, self.gyroscope_misalignment)
        accelerometer = (self.accelerometer_scale, self.accelerometer_misalignment)
        rest = (self.gyroscope_rotation, self.g_sensitivity)
        if all(x is None for x in (*gyroscope, *accelerometer, *rest)):
            return None

        def triad(scale: Tensor | None, misalignment: Tensor | None) -> Tensor:
            scale = like.new_ones(3) if scale is None else scale.to(like)
            return lower_triangular(scale, None if misalignment is None else misalignment.to(like))

        rotation, leak = (None if x is None else x.to(like) for x in rest)
        return sensor_matrix(triad(*gyroscope), triad(*accelerometer), rotation, leak)

    def _disturbances(
        self, signal: Tensor, at: Tensor, instants: Tensor, generator: Generators
    ) -> tuple[Tensor, Tensor | None]:
        """Bias (..., 1 or N, 6) and white noise (..., N, 6)."""
        parts = []
        for bias in (getattr(self, name) for name in BIASES):
            if isinstance(bias, Trajectory):
                parts.append(bias(instants).to(signal))
            elif bias is None:
                parts.append(signal.new_zeros(1, 3))
            else:
                assert isinstance(bias, Tensor)
                constant = along_time(bias, signal)
                parts.append(constant if constant.ndim > 1 else constant.unsqueeze(0))
        bias = _joined(*parts)
        if not self.noisy:
            return bias, None

        def density(name: str) -> Tensor | None:
            """Of both sensors, (6,) or (*batch, 1, 6); None where there is none."""
            both = [getattr(self, f"{sensor}_{name}") for sensor in ("gyroscope", "accelerometer")]
            if not any(isinstance(x, Tensor) or x for x in both):
                return None
            both = [x if isinstance(x, Tensor) else signal.new_full((3,), x) for x in both]
            both = [along_time(x.expand(3) if x.ndim == 0 else x, signal) for x in both]
            return _joined(*both).to(home)

        home = drawing_device(generator, signal.device)
        t = at.to(home)
        densities = {
            name: density(name)
            for name in ("noise_density", "random_walk", "bias_sigma", "bias_time", "bias_instability")
        }
        known = [x.shape[:-2] for x in densities.values() if x is not None]
        batch = torch.broadcast_shapes(signal.shape[:-2], bias.shape[:-2], *known)
        if isinstance(generator, Sequence) and not batch:
            batch = torch.Size([len(generator)])
        shape = (*batch, at.shape[-1], 6)
        walks = []
        if (walk := densities["random_walk"]) is not None:
            walks.append(random_walk(shape, walk, t, generator, signal.dtype))
        if (sigma := densities["bias_sigma"]) is not None and (time := densities["bias_time"]) is not None:
            driving = sigma * (2.0 / time).sqrt()
            walks.append(gauss_markov(shape, driving, time, t, generator, signal.dtype))
        if (level := densities["bias_instability"]) is not None:
            walks.append(flicker_noise(shape, level, t, generator, signal.dtype))
        for x in walks:
            bias = _plus(x.to(signal.device), bias)
        own = densities["noise_density"]
        if own is None:
            return bias, None
        rate = sample_rate(t, self.rate)
        rate = rate if rate.ndim == 0 else rate[..., None, None]
        white = white_noise(shape, own, rate, generator, signal.dtype)
        return bias, white.to(signal.device)

    def _converted(self, signal: Tensor) -> Tensor:
        limit = self._pair("range", signal, torch.inf)
        if limit is not None:
            signal = saturate(signal, limit)
        step = self._pair("resolution", signal, 0.0)
        if step is not None:
            fine = step == 0.0  # one sensor has a resolution, the other has none
            rounded = quantise(signal, torch.where(fine, 1.0, step))
            whole = self.gyroscope_resolution is not None and self.accelerometer_resolution is not None
            signal = rounded if whole else torch.where(fine, signal, rounded)
        return signal

    def _pair(self, name: str, like: Tensor, missing: float) -> Tensor | None:
        """A property of both sensors, broadcasting with (..., N, 6)."""
        both = [getattr(self, f"{sensor}_{name}") for sensor in ("gyroscope", "accelerometer")]
        if all(x is None for x in both):
            return None
        return _joined(*(like.new_full((3,), missing) if x is None else along_time(x, like) for x in both))


def _check_readings(readings: Any) -> None:
    for name in ("gyroscope", "accelerometer"):
        x = getattr(readings, name, None)
        if x is None:
            raise TypeError(f"readings: expected gyroscope and accelerometer, got {type(readings).__name__}")
        checks.is_floating_tensor(name, x)
        checks.has_last(name, x, 3, "x, y, z")
    checks.same_kind(gyroscope=readings.gyroscope, accelerometer=readings.accelerometer)


def _plus(own: Tensor, other: Tensor) -> Tensor:
    """The sum; in place of the first, which nobody else has seen, where autograd does not mind."""
    tracked = torch.is_grad_enabled() and (own.requires_grad or other.requires_grad)
    fits = own.shape == torch.broadcast_shapes(own.shape, other.shape)
    return own.add_(other) if fits and not tracked and plain(own, other) else own + other


def _joined(a: Tensor, b: Tensor) -> Tensor:
    """Of the gyroscope and of the accelerometer, side by side."""
    if a.shape[:-1] != b.shape[:-1]:
        lead = torch.broadcast_shapes(a.shape[:-1], b.shape[:-1])
        a, b = a.expand(*lead, 3), b.expand(*lead, 3)
    return torch.cat([a, b], dim=-1)
