"""Unit complex numbers [cos, sin], rotations of the plane: what SO(2) and SE(2) share."""

from torchspline.arithmetic import series
from torchspline.arithmetic.scalar import Scalar, sqrt, where
from torchspline.arithmetic.vector import Vector, dot, scale

_QUARTER_TURN = 1.5707963267948966


def multiply(a: Vector, b: Vector) -> Vector:
    return (a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0])


def conjugate(z: Vector) -> Vector:
    return (z[0], -z[1])


def rotate(z: Vector, v: Vector) -> Vector:
    return multiply(z, v)


def unrotate(z: Vector, v: Vector) -> Vector:
    return multiply(conjugate(z), v)


def perpendicular(v: Vector) -> Vector:
    """A quarter turn."""
    return (-v[1], v[0])


def wedge(a: Vector, b: Vector) -> Scalar:
    """a_x b_y - a_y b_x."""
    return a[0] * b[1] - a[1] * b[0]


def unit(z: Vector) -> Vector:
    return scale(1.0 / sqrt(dot(z, z)), z)


def angle(z: Vector) -> Scalar:
    """Angle in (-pi, pi] of a unit complex number; exactly pi for a half-turn.

    Numbers on the far half are first turned back by a quarter, so that tan(angle/2) never exceeds one.
    """
    c, s = z
    far, below = c < 0, s < 0
    cosine = where(far, where(below, -s, s), c)
    sine = where(far, where(below, c, -c), s)
    t = sine / (1.0 + cosine)
    near = 2.0 * t * series.arctan_factor(t * t)
    return where(far, where(below, near - _QUARTER_TURN, near + _QUARTER_TURN), near)
