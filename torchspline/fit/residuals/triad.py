"""What three axes on the body make of a vector: `S R^T x + b`, the error model that inertial sensors share."""

from torchspline.arithmetic.motion import turned, turned_reverse
from torchspline.arithmetic.vector import Vector, add, dot, scale, zero
from torchspline.fit.residual import ROTATION_IN_BODY, Cotangents, Given, Slot

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

#: b in the unit of what is measured; R, SO3, sensor to body; S, nine numbers row by row, the scale and misalignment
#: of the axes.
TRIAD = {
    "bias": Slot(3, None, zero(3)),
    "rotation": ROTATION_IN_BODY,
    "scaling": Slot(9, None, IDENTITY),
}


def reading(given: Given, x: Vector) -> Vector:
    """What the axes read of a vector x in the body frame."""
    return add(scaled(given["scaling"], turned(given["rotation"], x)), given["bias"])


def reading_reverse(given: Given, x: Vector, g: Vector) -> tuple[Vector, Cotangents]:
    """Cotangents of the vector and of the slots of `TRIAD`, from that of the reading."""
    seen = turned(given["rotation"], x)
    scaling_g, seen_g = scaled_reverse(given["scaling"], seen, g)
    rotation_g, x_g = turned_reverse(given["rotation"], seen, seen_g)
    return x_g, {"bias": g, "rotation": rotation_g, "scaling": scaling_g}


def scaled(matrix: Vector, v: Vector) -> Vector:
    """S v."""
    return tuple(dot(matrix[3 * i : 3 * i + 3], v) for i in range(3))


def scaled_reverse(matrix: Vector, v: Vector, g: Vector) -> tuple[Vector, Vector]:
    """Cotangents of the matrix and of v."""
    rows = [matrix[3 * i : 3 * i + 3] for i in range(3)]
    matrix_g = tuple(c for x in g for c in scale(x, v))
    return matrix_g, add(*(scale(x, row) for x, row in zip(g, rows, strict=True)))
