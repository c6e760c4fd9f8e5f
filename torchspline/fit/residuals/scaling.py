"""Scale and misalignment of three axes: a matrix as nine numbers, row by row."""

from torchspline.arithmetic.vector import Vector, add, dot, scale

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def scaled(matrix: Vector, v: Vector) -> Vector:
    """S v."""
    return tuple(dot(matrix[3 * i : 3 * i + 3], v) for i in range(3))


def scaled_reverse(matrix: Vector, v: Vector, g: Vector) -> tuple[Vector, Vector]:
    """Cotangents of the matrix and of v."""
    rows = [matrix[3 * i : 3 * i + 3] for i in range(3)]
    matrix_g = tuple(c for x in g for c in scale(x, v))
    return matrix_g, add(*(scale(x, row) for x, row in zip(g, rows, strict=True)))
