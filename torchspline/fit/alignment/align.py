"""Where an IMU sits on a moving body, and how its clock runs, from scratch."""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.fit.alignment import start as align_start
from torchspline.fit.alignment.joint import FEWEST, Joint, Readings, Solution
from torchspline.fit.losses import GemanMcClure, Loss
from torchspline.fit.residual import needs
from torchspline.fit.solving.model import with_points
from torchspline.groups.group import SO3
from torchspline.imu.synthesis import STANDARD_GRAVITY
from torchspline.splines.bspline import BSpline
from torchspline.units import NANOSECOND, nanoseconds, seconds_since

Array = NDArray[Any]
_MAGNITUDE = math.hypot(*STANDARD_GRAVITY)
#: Bins of the correlation of speeds that still fit into memory.
_MOST_BINS = 20_000_000
#: The least share of the gyroscope's variance that the trajectory has to explain.
_EXPLAINED = 0.4


@dataclass(frozen=True)
class Alignment:
    """Clock, mounting and biases of an IMU against a trajectory. What an accelerometer tells is None without one."""

    #: s: `t_imu = t_pose + time_offset + clock_skew (t_pose - t_mid)`, and s/s; 0 if it was not estimated.
    time_offset: float
    clock_skew: float
    #: Time of the trajectory, in its unit, at which the skew turns: the middle of the readings used.
    t_mid: float | int
    #: (4,) quaternion [w, x, y, z]: maps vectors of the body into the IMU's frame.
    rotation_imu_body: Tensor
    #: (3,) position of the IMU in the body, m.
    lever_arm: Tensor | None
    #: (3,) what the IMU reads too much, rad/s and m/s^2.
    gyro_bias: Tensor
    accel_bias: Tensor | None
    #: (3,) acceleration vector in the trajectory's world, m/s^2.
    gravity: Tensor | None
    #: Root mean square per axis of readings minus synthesised ones, rad/s and m/s^2, outliers included.
    gyro_rms: float
    accel_rms: float | None
    #: One standard deviation of each estimate by its name, (3,) or a number; that of the rotation in rad about the axes
    #: of the IMU. Infinite where the motion does not tell. Errors of readings count as independent: where the
    #: trajectory's own smooth errors rule, the truth lies farther off.
    std: dict[str, Tensor | float]
    #: Readings of gyroscope and accelerometer within the trajectory's domain that were used.
    used: tuple[int, int]
    #: s: by how much the accelerometer is later: its stamp of a moment is that of the gyroscope, to which `time_offset`
    #: belongs, plus this; 0 if it was not estimated.
    accel_delay: float = 0.0
    #: Things a careful user wants to know, in words.
    notes: list[str] = field(default_factory=list)
    #: First reading and start of the trajectory in their units, and the seconds that lie between them at `t_mid`.
    _clocks: tuple[float | int, float | int, float] = (0.0, 0.0, 0.0)

    def pose_time(self, t: Tensor, *, sensor: Literal["gyro", "accel"] = "gyro") -> Tensor:
        """Times of the trajectory, in its unit, at stamps `t` of the IMU's clock, in the unit they came in.

        Args:
            t: stamps, any shape.
            sensor: whose readings have these stamps; those of the two are `accel_delay` apart.
        Raises:
            TypeError: no tensor, or not the dtype of the stamps that were aligned.
            ValueError: no such sensor.
        """
        checks.choice("sensor", sensor, ("gyro", "accel"))
        first, origin, lag = self._clocks
        checks.instance("t", t, Tensor, "a torch.Tensor")
        expected = torch.int64 if isinstance(first, int) else torch.float64
        if t.dtype != expected:
            raise TypeError(f"t: expected {expected} as the stamps that were aligned, got {t.dtype}")
        s = seconds_since(t, first)
        mid = (self.t_mid - origin) * (NANOSECOND if isinstance(origin, int) else 1.0)
        late = self.accel_delay if sensor == "accel" else 0.0
        tau = mid + (s - lag - mid - late) / (1.0 + self.clock_skew)
        return origin + nanoseconds(tau) if isinstance(origin, int) else origin + tau

    @property
    def T_body_imu(self) -> Tensor:
        """(7,) SE3 pose of the IMU in the body, as `imu.measure` and `mounted` take it; at the body's origin if the
        lever arm is not known."""
        arm = torch.zeros(3, dtype=torch.float64) if self.lever_arm is None else self.lever_arm
        return torch.cat([arm, SO3.inverse(self.rotation_imu_body)])


def align_imu(
    trajectory: BSpline,
    t: Tensor,
    gyro: Tensor,
    accel: Tensor | None = None,
    *,
    max_offset: float | None = 5.0,
    estimate_skew: bool = True,
    estimate_delay: bool = True,
    gravity_magnitude: float | None = _MAGNITUDE,
    loss: Loss | None = GemanMcClure(5.0),  # noqa: B008  (never changed)
) -> Alignment:
    """Time offset, clock skew, rotation, lever arm, biases and gravity between a trajectory and an IMU, from scratch.

    The lag comes from the correlation of angular speeds, which no rotation changes; the rotation and gyroscope bias at
    the most likely lags from Wahba's problem, the best of which goes on; gravity, accelerometer bias and lever arm from
    linear least squares. Then all of them together, the trajectory held, by `Problem.solve`, readings weighted by what
    their residuals turn out to be. The lever arm comes from angular accelerations: it is the first to suffer where the
    trajectory follows noise or misses motion, or smooths positions more than rotations.

    Args:
        trajectory: of a rigid body (SE3 or R3xSO3; SO3 without `accel`), without a batch, on the CPU.
        t: (N,) stamps on the IMU's clock, float64 seconds or int64 nanoseconds, in any order; neither unit nor epoch
            need be the trajectory's.
        gyro, accel: (N, 3) rad/s and specific force m/s^2. Rows with NaN are left out, each sensor by itself.
        max_offset: how far the clocks may be apart, s; None for any distance at which the two overlap.
        estimate_skew: whether the clocks may run at different rates.
        estimate_delay: whether the accelerometer may be later than the gyroscope, or earlier: the filters on many chips
            differ by some tenths of a millisecond, and one clock for both would be right for neither.
        gravity_magnitude: m/s^2; None to estimate it, too.
        loss: how residuals far out count, in standard deviations; up to a fifth of the readings may be wrong. None for
            plain least squares.
    Returns:
        Alignment. Its `notes` say what the motion leaves open.
    Raises:
        TypeError, ValueError: a wrong type, shape or value; too few readings; clocks that do not overlap; a motion
        that hardly turns; readings that have nothing in common with the trajectory.
    """
    _check(trajectory, t, gyro, accel)
    checks.instance("estimate_skew", estimate_skew, bool, "True or False")
    checks.instance("estimate_delay", estimate_delay, bool, "True or False")
    for name, x in (("max_offset", max_offset), ("gravity_magnitude", gravity_magnitude)):
        if x is not None:
            checks.positive(name, x)
    if loss is not None:
        checks.instance("loss", loss, Loss, "a robust loss such as torchspline.fit.Huber(1.0), or None")
    # A copy: solving writes the numbers back.
    body = with_points(trajectory, trajectory.control_points.detach().to(torch.float64))
    stamps = _Stamps(t, body)
    sensors = [_clean("gyro", stamps.s, gyro)] + ([] if accel is None else [_clean("accel", stamps.s, accel)])
    start = _start(body, stamps, sensors[0], max_offset, alone=accel is None)
    joint = Joint(body, stamps.epoch, sensors, start, estimate_skew, estimate_delay, gravity_magnitude, loss)
    return _alignment(body, stamps, joint.run())


def _alignment(trajectory: BSpline, stamps: "_Stamps", found: Solution) -> Alignment:
    values, accel = found.values, len(found.used) > 1
    skew, delay = values.get("clock_skew"), values.get("accel_delay")
    return Alignment(
        time_offset=stamps.epoch + found.lag,
        clock_skew=0.0 if skew is None else float(skew[0]),
        accel_delay=0.0 if delay is None else float(delay[0]),
        t_mid=align_start.times_of(trajectory, np.array([found.mid]))[0].item(),
        rotation_imu_body=SO3.inverse(values["rotation_imu_body"]),
        lever_arm=values.get("lever_arm"),
        gyro_bias=values["gyro_bias"],
        accel_bias=values.get("accel_bias"),
        gravity=values.get("gravity"),
        gyro_rms=found.rms[0],
        accel_rms=found.rms[1] if accel else None,
        std={
            n: float(x[0]) if n in ("time_offset", "clock_skew", "accel_delay") else x
            for n, x in found.std.items()
        },
        used=(found.used[0], found.used[1] if accel else 0),
        notes=found.notes,
        _clocks=(stamps.first, stamps.origin, found.lag),
    )


class _Stamps:
    """Stamps in seconds from the first of them, and how the two clocks' origins lie to each other."""

    def __init__(self, t: Tensor, trajectory: BSpline):
        finite = ~t.isnan() if t.dtype != torch.int64 else torch.ones_like(t, dtype=torch.bool)
        if not bool(finite.any()):
            raise ValueError(f"t: expected at least {FEWEST} stamps, got 0 that are not NaN")
        t = t.detach().cpu()
        self.first: float | int = t[finite].min().item()
        self.origin = trajectory.domain[0]
        self.s = seconds_since(t, self.first).numpy()
        if isinstance(self.first, int) and isinstance(self.origin, int):
            self.epoch = (self.first - self.origin) * NANOSECOND
        else:
            self.epoch = _seconds(self.first) - _seconds(self.origin)


def _seconds(t: float | int) -> float:
    return t * NANOSECOND if isinstance(t, int) else t


def _check(trajectory: BSpline, t: Tensor, gyro: Tensor, accel: Tensor | None) -> None:
    checks.instance("trajectory", trajectory, BSpline, "a BSpline such as fit_poses(...).trajectory")
    needs("trajectory", trajectory.group, rotates=True, moves=accel is not None)
    if trajectory.control_points.ndim != 2:
        raise ValueError(
            f"trajectory: expected one without a batch, got control points of shape "
            f"{tuple(trajectory.control_points.shape)}"
        )
    device = trajectory.control_points.device
    if device.type != "cpu":
        raise ValueError(f"trajectory: expected one on the CPU, got {device}; move it with .to('cpu')")
    if not isinstance(t, Tensor):
        raise TypeError(
            f"t: expected a torch.Tensor, got {type(t).__name__}; convert it with torch.as_tensor"
        )
    if t.dtype not in (torch.float64, torch.int64):
        raise TypeError(f"t: expected float64 seconds or int64 nanoseconds, got {t.dtype}")
    if t.ndim != 1:
        raise ValueError(f"t: expected shape (N,), got {tuple(t.shape)}")
    for name, x in (("gyro", gyro), ("accel", accel)):
        if x is None and name == "accel":
            continue
        checks.is_floating_tensor(name, x)
        assert x is not None
        if x.shape != (len(t), 3):
            raise ValueError(f"{name}: expected shape ({len(t)}, 3), one row a stamp, got {tuple(x.shape)}")
    for name, y in (("t", t), ("gyro", gyro), ("accel", accel)):
        if y is None:
            continue
        if y.device.type != "cpu":
            raise ValueError(
                f"{name}: on device {y.device}, but the trajectory is on cpu; move it with .to('cpu')"
            )
        if y.dtype != torch.int64:
            checks.finite(name, y.masked_fill(y.isnan(), 0.0))


def _clean(name: str, s: Array, x: Tensor) -> Readings:
    values = x.detach().to("cpu", torch.float64).numpy()
    rows = np.flatnonzero(~np.isnan(s) & ~np.isnan(values).any(axis=1))
    rows = rows[np.argsort(s[rows], kind="stable")]
    if len(np.unique(s[rows])) < FEWEST:
        raise ValueError(
            f"{name}: expected at least {FEWEST} readings at different times without NaN, "
            f"got {len(np.unique(s[rows]))}"
        )
    return Readings(s[rows], values[rows])


# ---------------------------------------------------------------------- a start from nothing


def _start(
    trajectory: BSpline, stamps: _Stamps, gyro: Readings, max_offset: float | None, alone: bool
) -> align_start.Start:
    length = align_start.length_of(trajectory)
    lags = (-length, float(gyro.s[-1]))
    if max_offset is not None:
        lags = max(lags[0], -max_offset - stamps.epoch), min(lags[1], max_offset - stamps.epoch)
        near = (gyro.s >= lags[0]) & (gyro.s <= length + lags[1])
        gyro = Readings(gyro.s[near], gyro.x[near])
    spans = (
        f"the trajectory lasts {length:.6g} s, the stamps {stamps.s[~np.isnan(stamps.s)].max():.6g} s and begin "
        f"{stamps.epoch:.6g} s after it"
    )
    reach = "" if max_offset is None else f", with clocks at most max_offset = {max_offset:g} s apart"
    apart = ValueError(
        f"t: expected stamps that overlap with the trajectory{reach}, but {spans}; are they the same recording? "
        "max_offset=None allows any distance of the clocks"
    )
    if len(gyro.s) < FEWEST or lags[0] > lags[1]:
        raise apart
    if (gyro.s[-1] - gyro.s[0] + length) / align_start.STEP > _MOST_BINS:
        raise ValueError(
            f"t: expected recordings of less than {_MOST_BINS * align_start.STEP:g} s, but {spans}"
        )
    # From the first that may overlap: one stamp may be far before the others.
    first = float(gyro.s[0])
    found = align_start.start(trajectory, gyro.s - first, gyro.x, (lags[0] - first, lags[1] - first))
    if found is None:
        raise apart
    rival = found.rival and (found.rival[0] + first, found.rival[1])
    found = found._replace(lag=found.lag + first, rival=rival)
    if found.turning < 0.01:
        raise ValueError(
            f"trajectory: its angular speed varies by {found.turning:.2g} rad/s only: with so little turning neither "
            "time offset nor rotation can be found"
        )
    if found.explained < _EXPLAINED:
        raise ValueError(
            f"gyro: expected readings of the trajectory's motion, but at the best lag of "
            f"{found.lag + stamps.epoch:.4g} s it explains {max(found.explained, 0.0):.0%} of their variance; is this "
            "the same recording, is max_offset large enough, do the knots follow the motion, are the readings in "
            f"rad/s? Here {spans}"
        )
    if found.open_angle > 0.2 and alone:
        axis = ", ".join(f"{x:.2f}" for x in found.open_axis)
        raise ValueError(
            f"gyro: the motion turns about one axis, [{axis}] in the IMU, which leaves the rotation about it open; "
            "pass accel as well"
        )
    return found
