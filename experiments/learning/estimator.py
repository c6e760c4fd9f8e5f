"""A network that calibrates an IMU while it moves: what the accelerometer says about gravity shows gyroscope errors.

Readings, turned by the integrated gyroscope into a frame that does not rotate, are gravity plus the acceleration of the
motion. Errors of the gyroscope turn gravity away with time; the acceleration of the motion does not, since velocity
stays bounded. So the velocity that is integrated in this frame is, within a stretch of time,

    v(t) = v0 + u t - [u]x int(Phi_b db + Phi_s ds) + int(R dc + R diag(a) da) + (velocity of the motion)

with u opposite to gravity, Phi_b = int R, Phi_s = int R diag(w), corrections db, ds to bias and scale of the gyroscope
and dc, da to those of the accelerometer; and while the body rests, the gyroscope reads its bias. This is linear least
squares, repeated with the readings that it corrects. What the network learns is how motions behave (a whitening filter
for their velocity, how much to trust an instant, what is a rest) and what sensors are like (the widths of priors).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchspline import SO3, imu
from torchspline.imu.scan import rotation_products

#: Readings that are averaged before anything else: 10 Hz from 200 Hz.
GROUP = 20
GRAVITY = 9.80665
#: Unknowns that are a stretch's own (u and v0), and all sensor parameters (biases and scales of both).
LOCAL, SHARED = 6, 12
#: What a step changes at most, rad/s and m/s^2: so that a stretch that was misjudged does not lose the way.
STEPS = (0.2, 0.05, 1.0, 0.05)
#: Of an instant, for the network.
FEATURES = 5
#: Instants in a second, odd.
NEIGHBOURS = 11
#: Of the network's output, so that it learns in few steps what spans orders of magnitude.
GAIN = 4.0


class Calibration(NamedTuple):
    """Of each recording: biases (B, 3) rad/s and m/s^2, scales (B, 3), 1 is perfect."""

    gyroscope_bias: Tensor
    gyroscope_scale: Tensor
    accelerometer_bias: Tensor
    accelerometer_scale: Tensor

    @classmethod
    def perfect(cls, like: Tensor) -> "Calibration":
        zero, one = like.new_zeros(len(like), 3), like.new_ones(len(like), 3)
        return cls(zero, one, zero, one)

    def plus(self, step: Tensor) -> "Calibration":
        """With the corrections db, ds, dc, da, (B, 12), of which no step takes more than STEPS."""
        db, ds, dc, da = (
            most * torch.tanh(x / most) for x, most in zip(step.split(3, -1), STEPS, strict=True)
        )
        return Calibration(
            self.gyroscope_bias + db, self.gyroscope_scale + ds,
            self.accelerometer_bias + dc, self.accelerometer_scale + da,
        )  # fmt: skip

    def correct(self, gyroscope: Tensor, accelerometer: Tensor) -> imu.ImuReading:
        """Through the sensor model, backwards."""
        return imu.Imu(**self._asdict()).correct(imu.ImuReading(gyroscope, accelerometer))


class Calibrator(nn.Module):
    """Readings of one or more stretches of a recording in, the sensor's calibration out.

    Args:
        width: channels of the network that says how much to trust an instant; 0: there is none, all instants are alike,
            nothing is whitened, and rest is not recognised.
        taps: of the whitening filter, odd, at 10 Hz.
    """

    def __init__(self, width: int = 16, taps: int = 21):
        super().__init__()
        self.trust: nn.Module | None = None
        if width:
            layers: list[nn.Module] = []
            for i, dilation in enumerate((1, 3, 9)):
                layers += [
                    nn.Conv1d(width if i else FEATURES, width, 3, dilation=dilation, padding=dilation),
                    nn.GELU(),
                ]
            last = nn.Conv1d(width, 2, 1)
            nn.init.zeros_(last.weight)
            assert last.bias is not None
            nn.init.zeros_(last.bias)
            self.trust = nn.Sequential(*layers, last)
            whitening = torch.zeros(taps)
            whitening[taps // 2] = 1.0
            self.whitening = nn.Parameter(whitening)
        # Logarithm of the standard deviation of a motion's velocity [m/s] at an instant.
        self.log_velocity = nn.Parameter(torch.tensor(0.0))
        # Body rates [rad/s] are of the order of their changes within a second: the less change, the nearer to rest.
        self.log_rate = nn.Parameter(torch.tensor([5.0, 2.72]).log())
        # Those of biases and scales of sensors (gyroscope, then accelerometer).
        self.log_priors = nn.Parameter(torch.tensor([0.05, 0.003, 0.05, 0.003]).log())
        # A gyroscope that is good about two axes is good about the third: the prior of later steps.
        self.log_good = nn.Parameter(torch.tensor(0.002).log())
        self.log_alike = nn.Parameter(torch.tensor(0.0))
        # Of the filter that takes noise off the readings.
        self.smoothing = nn.Parameter(torch.zeros(8))

    def forward(
        self, gyroscope: Tensor, accelerometer: Tensor, dt: float, lengths: Sequence[float]
    ) -> Calibration:
        """The calibration after one Gauss-Newton step for each entry of `lengths`.

        Args:
            gyroscope, accelerometer: (B, N, 3) float64, N a multiple of GROUP.
            dt: s, between readings.
            lengths: s, of the stretches into which the recording is cut at each step; first short ones, in which even a
                large bias turns gravity little.
        """
        weights = None if self.trust is None else self._weights(gyroscope, accelerometer)
        calibration = Calibration.perfect(gyroscope)
        for i, length in enumerate(lengths):
            step = self._step(gyroscope, accelerometer, dt, length, calibration, weights, first=i == 0)
            calibration = calibration.plus(step)
        return calibration

    def denoised(self, x: Tensor) -> Tensor:
        """(B, N, 3), filtered by a symmetric kernel whose weights sum to one."""
        half = torch.softmax(torch.cat([self.smoothing.new_zeros(1), self.smoothing]), 0).to(x)
        kernel = torch.cat([half[1:].flip(0) / 2, half[:1], half[1:] / 2])
        reach = len(self.smoothing)
        padded = F.pad(x.mT, (reach, reach), mode="replicate").mT
        shifted = [padded[:, i : i + x.shape[1]] for i in range(2 * reach + 1)]
        return sum((k * y for k, y in zip(kernel, shifted, strict=True)), torch.zeros_like(x))

    def _step(
        self,
        gyroscope: Tensor,
        accelerometer: Tensor,
        dt: float,
        length: float,
        now: Calibration,
        weights: Tensor | None,
        first: bool,
    ) -> Tensor:
        h = GROUP * dt
        corrected = now.correct(gyroscope, accelerometer)
        rate, force = (grouped(x) for x in corrected)
        # At the full rate, because small vibrations about several axes add up to rotations.
        t = dt * torch.arange(gyroscope.shape[1], dtype=torch.float64)
        rotation = imu.integrate_gyroscope(corrected.gyroscope, t)
        turned = grouped(SO3.act(rotation, corrected.accelerometer, validate=False))
        middle = rotation[:, GROUP // 2 :: GROUP]
        size = min(round(length / h), rate.shape[1])
        stretched = [stretches(x, size) for x in (rate, force, turned, middle)]
        H, right = self._velocity(*stretched, h=h, weights=weights)
        # Bodies turn to and fro, and some of the time they rest.
        if weights is None:
            still = torch.ones_like(rate[..., :1])
        else:
            still = weights[..., 1:].exp()
        H = H + torch.diag_embed(F.pad(still.sum(1).expand(-1, 3), (0, SHARED - 3)))
        right = right + F.pad((still * rate).sum(1), (0, SHARED - 3))
        # Priors hold for the whole calibration rather than for this step.
        information = (-2.0 * self.log_priors).exp().to(H).expand(len(H), -1)
        if not first:
            # Mean square of the bias in the directions that the data tell something about.
            bias, known = now.gyroscope_bias, H[:, :3, :3]
            size_of_bias = (bias * (known @ bias[..., None])[..., 0]).sum(-1) / known.diagonal(
                dim1=-2, dim2=-1
            ).sum(-1)
            good = (2.0 * self.log_good).exp() + self.log_alike.exp() * size_of_bias
            information = torch.cat([1.0 / good[:, None], information[:, 1:]], -1)
        information = information.repeat_interleave(3, -1)
        so_far = torch.cat(
            [
                now.gyroscope_bias,
                now.gyroscope_scale - 1,
                now.accelerometer_bias,
                now.accelerometer_scale - 1,
            ],
            -1,
        )
        return torch.linalg.solve(H + torch.diag_embed(information), right - information * so_far)

    def _velocity(
        self,
        rate: Tensor,
        force: Tensor,
        turned: Tensor,
        rotation: Tensor,
        h: float,
        weights: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Normal equations of the sensor's parameters, (B, 12, 12) and (B, 12), from stretches (B, S, K, 3 or 4).

        Args:
            turned: the readings `force` in the frame of `rotation`; here all turn into that of a stretch's middle.
        """
        back = SO3.inverse(rotation[:, :, rotation.shape[2] // 2, None], validate=False)
        R = SO3.to_matrix(SO3.compose(back, rotation, validate=False), validate=False)
        turned = SO3.act(back, turned, validate=False)[..., None]
        u = GRAVITY * F.normalize(turned.mean(2, keepdim=True), dim=-2)
        cross = skew(u[..., 0])

        def integral(x: Tensor) -> Tensor:
            return h * (x.cumsum(2) - 0.5 * x)

        identity = torch.eye(3, dtype=R.dtype).expand_as(R)
        parts = [
            integral(identity), identity,
            -integral(cross @ integral(R)), -integral(cross @ integral(R * rate[..., None, :])),
            integral(R), integral(R * force[..., None, :]), integral(turned),
        ]  # fmt: skip
        rows = torch.cat(parts, -1)  # (B, S, K, 3, 19)
        if weights is not None:
            rows = self._whitened(rows)
            trust = stretches(weights[..., :1], R.shape[2])
            cut = (R.shape[2] - rows.shape[2]) // 2
            rows = rows * (0.5 * trust[:, :, cut : cut + rows.shape[2], :, None]).exp()
        rows = (rows * (-self.log_velocity).exp()).flatten(2, 3)
        normal = rows.mT @ rows
        own, mixed = normal[..., :LOCAL, :LOCAL], normal[..., LOCAL:, :LOCAL]
        # The length of u is known: along its direction it is GRAVITY, within a mm/s^2.
        e = F.normalize(u[..., 0, :, 0], dim=-1)
        tight = F.pad(1e6 * e[..., :, None] * e[..., None, :], (0, LOCAL - 3, 0, LOCAL - 3))
        faint = 1e-6 * torch.eye(LOCAL, dtype=R.dtype)
        pull = F.pad(1e6 * GRAVITY * e, (0, LOCAL - 3))
        rest = mixed.mT.clone()
        rest[..., -1] = rest[..., -1] + pull
        solved = torch.linalg.solve(own + tight + faint, rest)
        reduced = (normal[..., LOCAL:, LOCAL:] - mixed @ solved).sum(1)
        return reduced[..., :-1, :-1], reduced[..., :-1, -1]

    def _whitened(self, rows: Tensor) -> Tensor:
        """Filtered along time, (B, S, K, ...); only where the whole filter fits."""
        length, taps = rows.shape[2], len(self.whitening)
        # A matrix, because convolutions in double precision are slow.
        tap = torch.arange(length) - torch.arange(length - taps + 1)[:, None]
        inside = (tap >= 0) & (tap < taps)
        matrix = self.whitening.to(rows)[tap.clamp(0, taps - 1)] * inside
        return (matrix @ rows.flatten(3)).unflatten(3, rows.shape[3:])

    def _weights(self, gyroscope: Tensor, accelerometer: Tensor) -> Tensor:
        """Logarithms of weights, (B, K, 2), from what depends neither on bias nor on how the sensor is mounted."""
        assert self.trust is not None
        w, f = grouped(gyroscope), grouped(accelerometer)
        w_spread, f_spread = (
            x.unflatten(1, (-1, GROUP)).std(2).norm(dim=-1) for x in (gyroscope, accelerometer)
        )
        w_change, f_change = (F.pad(x.diff(dim=1).norm(dim=-1), (1, 0)) for x in (w, f))
        excess = (f.norm(dim=-1) - GRAVITY).abs()
        features = torch.stack(
            [
                (w_spread + 1e-3).log() + 3, (f_spread + 1e-2).log() + 1,
                (w_change + 1e-3).log() + 3, (f_change + 1e-2).log() + 1, (excess + 1e-2).log() + 1,
            ],
            1,
        )  # fmt: skip
        change = F.max_pool1d(w_change[:, None], NEIGHBOURS, 1, NEIGHBOURS // 2).to(self.log_rate)
        log_rate = self.log_rate[0] + self.log_rate[1] * (change + 1e-3).log()
        found = GAIN * self.trust(features.to(self.log_rate.dtype))
        return (found - torch.cat([torch.zeros_like(log_rate), 2.0 * log_rate], 1)).mT.to(gyroscope)


def grouped(x: Tensor) -> Tensor:
    """(B, N, 3) to means of GROUP readings, (B, N / GROUP, 3)."""
    return x.unflatten(1, (-1, GROUP)).mean(2)


def stretches(x: Tensor, size: int) -> Tensor:
    """(B, K, C) cut into (B, S, size, C); what is left over at the end is dropped."""
    count = x.shape[1] // size
    return x[:, : count * size].unflatten(1, (count, size))


def running(steps: Tensor) -> Tensor:
    """Products of rotations (..., K, 4) from the first to each."""
    start = SO3.identity(*steps.shape[:-2], dtype=steps.dtype)
    return rotation_products(start, steps)[..., 1:, :]


def skew(x: Tensor) -> Tensor:
    """Matrices (..., 3, 3) of the cross product with x (..., 3)."""
    a, b, c = x.unbind(-1)
    zero = torch.zeros_like(a)
    return torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], -1).unflatten(-1, (3, 3))
