"""Measured rates of rotation: what a gyroscope on the body reads, and the derivative of that."""

from typing import ClassVar

from torchspline.arithmetic.motion import Motion
from torchspline.arithmetic.vector import Vector, add, negate
from torchspline.fit.residual import Cotangents, Given
from torchspline.fit.residuals.motion import MotionResidual
from torchspline.fit.residuals.triad import TRIAD, reading, reading_reverse


class _AngularRate(MotionResidual):
    """`S R^T x + b - measured` for a field x of the body's `Motion`."""

    rows, measured_size = 3, 3
    moves = False
    slots = TRIAD
    #: Name of the field.
    rate: ClassVar[str]

    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        return add(reading(given, getattr(motion, self.rate)), negate(measured))

    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        rate_g, cotangents = reading_reverse(given, getattr(motion, self.rate), g)
        return Motion(**{self.rate: rate_g}), cotangents


class Gyroscope(_AngularRate):
    """`S R^T w + b - measured`, rad/s, [S20] (69) with an error model.

    Arguments:
        bias: b, rad/s. rotation: R, SO3, sensor to body. scaling: S, nine numbers row by row, the scale and
            misalignment of the axes.
    """

    derivatives, rate = 1, "w"


class AngularAcceleration(_AngularRate):
    """`S R^T alpha + b - measured`, rad/s^2; alpha is the derivative of the angular velocity in the body frame.

    Arguments:
        bias: b, rad/s^2. rotation: R, SO3, sensor to body. scaling: S as in `Gyroscope`.
    """

    derivatives, rate = 2, "alpha"
