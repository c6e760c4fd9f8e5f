"""Calibration of cameras and IMUs by least squares over a continuous trajectory, [S20] 6.2."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.calibrate.problem import (
    CHOICES,
    GROUPS,
    Layout,
    Options,
    build,
)
from torchspline.calibrate.recording import Recording
from torchspline.calibrate.start import Start, find_start, with_known_offsets
from torchspline.calibrate.weights import noise_factors, rescale, sigma_of
from torchspline.fit.losses import Huber, Loss
from torchspline.fit.residual import Residual
from torchspline.fit.result import OpenDirection, Result
from torchspline.fit.solving.model import spacing_of
from torchspline.fit.solving.solver import Options as Solver
from torchspline.fit.variables import Variable
from torchspline.groups import SE3
from torchspline.splines.bspline import BSpline

#: The first solution, whose residuals say how noisy sensors are, need not be exact.
_ROUGH = 1e-2
#: Accelerometers hold fast motion so much tighter than slow that more damping, a share of the diagonal, slows down.
_FIRST_DAMPING, _DAMPING = 1e-8, 1e-12
#: A sensor that is so much quieter than stated had too little weight for its own residuals to tell how quiet it is:
#: they are looked at again with the new weights, at most so often.
_QUIETER, _ROUNDS = 0.2, 6
#: What is quieter than this share of what was stated has no noise at all, and rounding is no measure of weights.
_LEAST = 1e-4
_LOSS = Huber(3.0)
#: Median of the length of a normal number, and by how much noise is above what was stated that is worth a word where a
#: solution failed: vibration makes it some ten times.
_MEDIAN, _QUIET = 0.6745, 50.0


@dataclass(frozen=True, eq=False)
class SensorResiduals:
    """Of one sensor at the solution.

    Attributes:
        name: of the sensor, such as "cam0" or "imu0 gyroscope". unit: "px", "rad/s" or "m/s^2".
        values: (N, R), predicted minus measured, in the order of the recording, of the rows `used`.
        used: which corners or readings of the recording took part, bool.
        sigma: standard deviation of a number that the solution was weighted with, in `unit`.
        stated: what it was said to be beforehand.
    """

    name: str
    unit: str
    values: Tensor
    used: Tensor
    sigma: float
    stated: float

    @property
    def rms(self) -> Tensor:
        """(R,) root mean square of each axis."""
        return self.values.square().mean(0).sqrt()

    @property
    def mean(self) -> Tensor:
        """(R,)."""
        return self.values.mean(0)

    @property
    def median_length(self) -> float:
        """Median length of a residual: of pixels, the median reprojection error."""
        return float(self.values.norm(dim=1).median())


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """Of one camera. Names ending in `_sigma` are standard deviations; None where something was not estimated.

    Attributes:
        T_imu_cam: (7,) SE3, maps points of the camera into the frame of the first IMU. Its deviations (6,) are of a
            body tangent, in the frame of the camera: m, then rad.
        time_offset: s, `t_imu = t_cam + time_offset`, with the clock of the first IMU.
        intrinsics: (8,) fu, fv, pu, pv and the coefficients of the distortion.
        line_delay: s from one line to the next below it; stamps are then those of the middle line.
        images: (F,) bool, which images took part.
    """

    name: str
    T_imu_cam: Tensor
    T_imu_cam_sigma: Tensor
    time_offset: float
    time_offset_sigma: float | None
    intrinsics: Tensor
    intrinsics_sigma: Tensor | None
    line_delay: float | None
    line_delay_sigma: float | None
    images: Tensor
    residuals: SensorResiduals


@dataclass(frozen=True, eq=False)
class CalibratedImu:
    """Of one IMU. Names ending in `_sigma` are standard deviations; None where something was not estimated.

    Attributes:
        gyro_bias, accel_bias: (3,), or (M, 3) control points of a spline of order 4 (`gyro_bias_spline`, ...).
        T_imu0_imu: (7,) SE3, maps its points into the frame of the first IMU. Its deviations (6,) are of the position
            in the first IMU, m, and of a body tangent of the rotation, rad.
        time_offset: s, `t_imu_i = t_imu0 + time_offset`.
        gyro_scaling, accel_scaling: (3, 3) scale and misalignment; that of an accelerometer is lower triangular,
            which says how the frame of its IMU lies.
    """

    name: str
    gyro_bias: Tensor
    gyro_bias_sigma: Tensor
    accel_bias: Tensor
    accel_bias_sigma: Tensor
    gyroscope: SensorResiduals
    accelerometer: SensorResiduals
    T_imu0_imu: Tensor
    T_imu0_imu_sigma: Tensor | None = None
    time_offset: float = 0.0
    time_offset_sigma: float | None = None
    gyro_scaling: Tensor | None = None
    gyro_scaling_sigma: Tensor | None = None
    accel_scaling: Tensor | None = None
    accel_scaling_sigma: Tensor | None = None
    gyro_bias_spline: BSpline | None = None
    accel_bias_spline: BSpline | None = None


@dataclass(frozen=True, eq=False)
class Calibration:
    """What `calibrate` found.

    Attributes:
        cameras, imus: in the order of the recording.
        gravity: (3,) acceleration in the frame of the board, m/s^2. gravity_sigma: (2,) of its direction, rad.
        trajectory: of the first IMU in the frame of the board, by int64 nanoseconds of that IMU's clock.
        result: of the solver: cost, iterations, covariances, `observability`.
        recording, start: what it was made from.
        seconds: wall time by phase: start, build, solve, weights, report, and the total.
        notes: what a careful user wants to know, in words.
    """

    cameras: tuple[CalibratedCamera, ...]
    imus: tuple[CalibratedImu, ...]
    gravity: Tensor
    gravity_sigma: Tensor
    trajectory: BSpline
    result: Result
    recording: Recording
    start: Start
    seconds: dict[str, float]
    notes: list[str] = field(default_factory=list)

    @property
    def observability(self) -> list[OpenDirection]:
        """Combinations of unknowns that the recording leaves open; empty is good."""
        return self.result.observability

    def T_cam_cam(self, to: int, of: int) -> Tensor:
        """(7,) SE3: maps points of camera `of` into the frame of camera `to`."""
        a, b = (self.cameras[i].T_imu_cam for i in (to, of))
        return SE3.compose(SE3.inverse(a), b)


def calibrate(
    recording: Recording,
    start: Start | None = None,
    *,
    order: int = 5,
    spacing: float = 0.01,
    representation: str = "split",
    estimate: Collection[str] = ("time_offset",),
    bias_spacing: float | None = None,
    pixel_sigma: float = 0.5,
    loss: Loss | None = _LOSS,
    imu_loss: Loss | None = None,
    reweigh: bool = True,
    stretch: float | None = 2.0,
    max_iterations: int = 50,
    cost_tolerance: float = 1e-8,
    progress: bool = False,
) -> Calibration:
    """Extrinsics of cameras, gravity, biases and clocks, with the trajectory, from one recording.

    Minimises [S20] (71): reprojection errors (67) of the corners of a board that stands still, gyroscope (69) and
    accelerometer (70) residuals, on one B-spline of the motion of the first IMU. All corners of an image count as one
    measurement of its pose, see `ImageBlock`. Cost is linear in the length of the recording.

    Args:
        start: where to begin; by default `find_start(recording)`, with time offsets that the recording knows where they
            are not estimated.
        order, spacing [s]: of the trajectory's spline. Knots farther apart smooth what IMU readings say of fast motion.
        representation: "split" (R3 x SO3) or "joint" (SE3); results are the same.
        estimate: besides trajectory, extrinsics, gravity and biases: "time_offset" of every camera, "intrinsics" of
            every camera, "line_delay" of rolling shutters (slower: corners of an image are no block then),
            "imu_scaling": scale and misalignment of the axes.
        bias_spacing: knot spacing [s] of biases that change over time as splines of order 4; None for constant ones.
        pixel_sigma: standard deviation of a coordinate of a corner, px.
        loss: of every corner, in standard deviations. imu_loss: of every reading of a gyroscope or accelerometer; a
            robust one makes the solution slower to converge where the motion is rougher than the spline.
        reweigh: replace the standard deviations of corners, gyroscopes and accelerometers by what their residuals say
            after a first solution, one factor a sensor, so that those of the results are realistic: densities of data
            sheets know nothing of vibration, splines that are too smooth, or boards that are not flat. With False,
            what was stated. A sensor much quieter than stated is looked at again.
        stretch: s. Standard deviations hold when errors are alike over stretches of this length, see
            `Result.standard_deviation`: biases that wander, a distortion that is not quite the lens's, corners that are
            all seen too far inside. On real recordings those are ten times what independent errors (None) would give.
            For biases that are splines no longer than `bias_spacing`.
        max_iterations, cost_tolerance: of the solver, see `fit.Problem.solve`.
        progress: show a progress bar on a terminal.
    Returns:
        Calibration.
    Raises:
        TypeError, ValueError: a wrong type or value; sensors that share no time; gaps in the IMU's readings; unknowns
        that the recording does not determine (the message says which).
    """
    begin = perf_counter()
    checks.instance("recording", recording, Recording, "a torchspline.calibrate.Recording")
    options = _checked(order, spacing, representation, estimate, bias_spacing, pixel_sigma, loss, imu_loss)
    Solver.checked(max_iterations, cost_tolerance, 0.0, 1.0)
    if not isinstance(reweigh, bool):
        raise TypeError(f"reweigh: expected True or False, got {type(reweigh).__name__}")
    if stretch is not None:
        checks.positive("stretch", stretch)
    if not recording.imus:
        raise ValueError("recording: expected at least one IMU, got none")
    seconds = {}
    if start is None:
        start = find_start(recording)
        if "time_offset" not in options.estimate:
            start = with_known_offsets(start, recording)
    else:
        _check_start(start, recording)
    seconds["start"] = perf_counter() - begin
    now = perf_counter()
    layout = build(recording, start, options)
    seconds["build"] = perf_counter() - now
    stated = {residual.name: sigma_of(residual) for residual in layout.residuals}
    now, seconds["weights"] = perf_counter(), 0.0
    solve = partial(layout.problem.solve, max_iterations=max_iterations, progress=progress)
    for _ in range(_ROUNDS if reweigh else 0):
        first = solve(cost_tolerance=max(_ROUGH, cost_tolerance), damping=_FIRST_DAMPING)
        before = perf_counter()
        factors = _factors(first, layout, start, options)
        for residual in layout.residuals:
            least = _LEAST * stated[residual.name] / sigma_of(residual)
            factors[residual.name] = max(factors.get(residual.name, 1.0), least)
            rescale(residual, factors[residual.name])
        seconds["weights"] += perf_counter() - before
        if min(factors.values()) > _QUIETER:
            break
    result = solve(cost_tolerance=cost_tolerance, damping=_DAMPING if reweigh else _FIRST_DAMPING)
    seconds["solve"] = perf_counter() - now - seconds["weights"]
    now = perf_counter()
    notes = _notes(result, start)
    found = _Found(layout, result, stretch, stated, layout.frozen)
    cameras = tuple(_camera(recording, found, i) for i in range(len(recording.cameras)))
    imus = tuple(_imu(found, i) for i in range(len(recording.imus)))
    # Steps of a direction on the sphere are angles.
    gravity_sigma = found.sigma(layout.gravity)
    seconds["report"] = perf_counter() - now
    seconds["total"] = perf_counter() - begin
    return Calibration(
        cameras, imus, layout.gravity.value, gravity_sigma, layout.trajectory, result, recording, start,
        seconds, notes,
    )  # fmt: skip


def _factors(first: Result, layout: Layout, start: Start, options: Options) -> dict[str, float]:
    """What to multiply standard deviations by; where that fails, what may be wrong."""
    try:
        return noise_factors(first, layout.residuals)
    except ValueError as error:
        noted = f"; noted before: {'; '.join(start.notes)}" if start.notes else ""
        raise ValueError(
            f"{_far_too_quiet(layout)}{error}. Have knots {options.spacing:g} s apart enough readings, are the noise "
            f"densities and pixel_sigma = {options.pixel_sigma:g} of the right size to each other, is the board in m?"
            f"{noted}"
        ) from None


def _far_too_quiet(layout: Layout) -> str:
    """In words, sensors of IMUs whose readings scatter by far more from one to the next than their noise was stated."""
    found = []
    for i, imu in enumerate(layout.imus):
        for name, residual in (("gyroscope", imu.gyroscope), ("accelerometer", imu.accelerometer)):
            # Third differences of a motion are small, those of white noise have 20 times its variance.
            jumps = residual.measured.diff(n=3, dim=0).abs()
            if not len(jumps):
                continue
            scatter, stated = float(jumps.median()) / (_MEDIAN * math.sqrt(20.0)), sigma_of(residual)
            if scatter > _QUIET * stated:
                found.append(
                    f"{name} of imu{i} {scatter / stated:.0f} times as much as its noise density says"
                )
    if not found:
        return ""
    return f"noise: readings scatter from one to the next far more than was stated, {', '.join(found)}; "


def _checked(
    order: int,
    spacing: float,
    representation: str,
    estimate: Collection[str],
    bias_spacing: float | None,
    pixel_sigma: float,
    loss: Loss | None,
    imu_loss: Loss | None,
) -> Options:
    checks.whole("order", order, least=4)
    checks.positive("spacing", spacing)
    checks.choice("representation", representation, tuple(GROUPS))
    if isinstance(estimate, str) or not isinstance(estimate, Collection):
        raise TypeError(f"estimate: expected a set of names such as {{'time_offset'}}, got {estimate!r}")
    for name in estimate:
        checks.choice("estimate", name, CHOICES)
    if bias_spacing is not None:
        checks.positive("bias_spacing", bias_spacing)
    checks.positive("pixel_sigma", pixel_sigma)
    for name, x in (("loss", loss), ("imu_loss", imu_loss)):
        if x is not None:
            checks.instance(name, x, Loss, "a robust loss such as torchspline.fit.Huber(3.0)")
    return Options(
        order, spacing, representation, frozenset(estimate), bias_spacing, pixel_sigma, loss, imu_loss
    )


def _check_start(start: Start, recording: Recording) -> None:
    checks.instance("start", start, Start, "a torchspline.calibrate.Start")
    for name, x, count in (
        ("T_imu_cam", start.T_imu_cam, len(recording.cameras)),
        ("time_offset", start.time_offset, len(recording.cameras)),
        ("boards", start.boards, len(recording.cameras)),
        ("T_imu0_imu", start.T_imu0_imu, len(recording.imus)),
        ("imu_time_offset", start.imu_time_offset, len(recording.imus)),
        ("gyro_bias", start.gyro_bias, len(recording.imus)),
        ("accel_bias", start.accel_bias, len(recording.imus)),
    ):
        if len(x) != count:
            raise ValueError(
                f"start: expected {count} rows of {name}, one a sensor of the recording, got {len(x)}"
            )
        if isinstance(x, Tensor):
            checks.finite(f"start: {name}", x)
    if not float(start.gravity.norm()) > 0:
        raise ValueError(f"start: gravity: expected a direction, got {start.gravity.tolist()}")


# ---------------------------------------------------------------------- what was found


class _Found(NamedTuple):
    """What the estimates are made of."""

    layout: Layout
    result: Result
    stretch: float | None
    stated: dict[str, float]
    frozen: list[Variable]

    def sigma(self, variable: Variable | BSpline) -> Tensor:
        stretch = self.stretch
        if stretch is not None and isinstance(variable, BSpline):
            stretch = min(stretch, spacing_of(variable))
        return self.result.standard_deviation(variable, stretch)

    def sigma_if(self, variable: Variable | None) -> Tensor | None:
        """None if it was not estimated."""
        if variable is None or variable in self.frozen:
            return None
        return self.sigma(variable)

    def residuals(self, residual: Residual, name: str, unit: str, used: Tensor) -> SensorResiduals:
        values = self.result.residuals[residual.name]
        return SensorResiduals(name, unit, values, used, sigma_of(residual), self.stated[residual.name])


def _number(x: Tensor | None) -> float | None:
    return None if x is None else float(x)


def _camera(recording: Recording, found: _Found, i: int) -> CalibratedCamera:
    unknowns, name = found.layout.cameras[i], recording.cameras[i].name
    delay = unknowns.line_delay
    return CalibratedCamera(
        name=name,
        T_imu_cam=unknowns.extrinsics.value,
        T_imu_cam_sigma=found.sigma(unknowns.extrinsics),
        time_offset=-float(unknowns.ahead.value),
        time_offset_sigma=_number(found.sigma_if(unknowns.ahead)),
        intrinsics=unknowns.intrinsics.value,
        intrinsics_sigma=found.sigma_if(unknowns.intrinsics),
        line_delay=None if delay is None else float(delay.value),
        line_delay_sigma=_number(found.sigma_if(delay)),
        images=unknowns.images,
        residuals=found.residuals(unknowns.residual, name, "px", unknowns.corners),
    )


def _imu(found: _Found, i: int) -> CalibratedImu:
    unknowns, name = found.layout.imus[i], f"imu{i}"
    fields: dict[str, Any] = {}
    for kind, x in (("gyro_bias", unknowns.gyro_bias), ("accel_bias", unknowns.accel_bias)):
        if isinstance(x, Variable):
            fields |= {kind: x.value, f"{kind}_sigma": found.sigma(x)}
        else:
            fields |= {kind: x.control_points.detach(), f"{kind}_spline": x, f"{kind}_sigma": found.sigma(x)}
    for kind, y in (("gyro_scaling", unknowns.gyro_scaling), ("accel_scaling", unknowns.accel_scaling)):
        if y is not None:
            fields |= {kind: y.value.reshape(3, 3), f"{kind}_sigma": found.sigma(y).reshape(3, 3)}
    T = SE3.identity(dtype=torch.float64)
    if unknowns.rotation is not None and unknowns.lever_arm is not None and unknowns.ahead is not None:
        T = torch.cat([unknowns.lever_arm.value, unknowns.rotation.value])
        sigmas = found.sigma(unknowns.lever_arm), found.sigma(unknowns.rotation)
        fields |= {
            "T_imu0_imu_sigma": torch.cat(sigmas),
            "time_offset": float(unknowns.ahead.value),
            "time_offset_sigma": float(found.sigma(unknowns.ahead)),
        }
    gyroscope, accelerometer = (
        found.residuals(residual, f"{name} {what}", unit, unknowns.samples)
        for residual, what, unit in (
            (unknowns.gyroscope, "gyroscope", "rad/s"),
            (unknowns.accelerometer, "accelerometer", "m/s^2"),
        )
    )
    return CalibratedImu(name=name, gyroscope=gyroscope, accelerometer=accelerometer, T_imu0_imu=T, **fields)


def _notes(result: Result, start: Start) -> list[str]:
    notes = list(start.notes)
    if not result.converged:
        notes.append(
            f"the solution did not converge: {result.reason}; try more iterations or a larger spacing"
        )
    if result.outside:
        notes.append(f"{result.outside} images or readings lie outside the trajectory and had no weight")
    return notes
