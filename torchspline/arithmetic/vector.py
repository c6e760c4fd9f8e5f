"""Vectors as tuples of components. The float `0.0` is a known zero: it costs nothing and stays one."""

from collections.abc import Iterable

from torchspline.arithmetic.scalar import Scalar

Vector = tuple[Scalar, ...]


def _known_zero(x: Scalar) -> bool:
    return isinstance(x, float) and x == 0.0


def zero(size: int) -> Vector:
    """A vector known to be zero."""
    return (0.0,) * size


def is_zero(v: Vector) -> bool:
    """Whether `v` is known to be zero, not merely equal to it."""
    return all(_known_zero(x) for x in v)


def plus(x: Scalar, y: Scalar) -> Scalar:
    if _known_zero(x):
        return y
    return x if _known_zero(y) else x + y


def times(x: Scalar, y: Scalar) -> Scalar:
    return 0.0 if _known_zero(x) or _known_zero(y) else x * y


def add(*vectors: Vector) -> Vector:
    """Sum, component by component."""
    total = vectors[0]
    for v in vectors[1:]:
        total = tuple(plus(x, y) for x, y in zip(total, v, strict=True))
    return total


def negate(v: Vector) -> Vector:
    return tuple(x if _known_zero(x) else -x for x in v)


def scale(factor: Scalar, v: Vector) -> Vector:
    return tuple(times(factor, x) for x in v)


def dot(a: Iterable[Scalar], b: Iterable[Scalar]) -> Scalar:
    total: Scalar = 0.0
    for x, y in zip(a, b, strict=True):
        total = plus(total, times(x, y))
    return total


def cross(a: Vector, b: Vector) -> Vector:
    """a x b in three dimensions."""
    if is_zero(a) or is_zero(b):
        return zero(3)
    a1, a2, a3 = a
    b1, b2, b3 = b
    return (a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1)
