"""SO(2), rotations of the plane, as unit complex numbers [cos, sin] stored at any length; tangent = angle (1)."""

from torchspline.arithmetic import planar, series
from torchspline.arithmetic.group import AdjointSeriesGroup, Matrix
from torchspline.arithmetic.scalar import Scalar, sqrt
from torchspline.arithmetic.vector import Vector, add, dot, scale, zero


class SO2(AdjointSeriesGroup):
    name = "SO2"
    point_size = 2
    tangent_size = 1
    act_size = 2
    matrix_size = 2
    unit_blocks = ((0, 2),)

    def identity(self) -> tuple[float, ...]:
        return (1.0, 0.0)

    def normalize(self, stored: Vector) -> Vector:
        return planar.unit(stored)

    def compose(self, X: Vector, Y: Vector) -> Vector:
        return planar.multiply(X, Y)

    def inverse(self, X: Vector) -> Vector:
        return planar.conjugate(X)

    def exp(self, x: Vector, short: bool = False) -> Vector:
        c0, c1, _ = series.stumpff(x[0] * x[0], 0, 2, short)
        return (c0, c1 * x[0])

    def log(self, X: Vector) -> Vector:
        return (planar.angle(X),)

    def act(self, X: Vector, point: Vector) -> Vector:
        return planar.rotate(X, point)

    def act_reverse(self, X: Vector, point: Vector, g: Vector) -> tuple[Vector, Vector]:
        body = planar.unrotate(X, g)
        return (planar.wedge(point, body),), body

    def act_tangent(self, X: Vector, point: Vector, v: Vector, dpoint: Vector) -> Vector:
        return planar.rotate(X, add(scale(v[0], planar.perpendicular(point)), dpoint))

    def adjoint_inverse(self, X: Vector, v: Vector) -> Vector:
        return v

    def coadjoint_inverse(self, X: Vector, g: Vector) -> Vector:
        return g

    def bracket(self, a: Vector, b: Vector) -> Vector:
        return zero(1)

    def cobracket(self, a: Vector, g: Vector) -> Vector:
        return zero(1)

    def jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        return ()

    def inverse_jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        return ()

    def pull(self, X: Vector, stored_cotangent: Vector) -> Vector:
        return (planar.wedge(X, stored_cotangent),)

    def push(self, X: Vector, v: Vector) -> Vector:
        return scale(v[0], planar.perpendicular(X))

    def embed(self, stored: Vector, g: Vector) -> Vector:
        # By the length twice rather than by its square, whose derivative leaves the range of float32 early.
        reciprocal = 1.0 / sqrt(dot(stored, stored))
        return scale(reciprocal * g[0], planar.perpendicular(scale(reciprocal, stored)))

    def extract(self, stored: Vector, rate: Vector) -> Vector:
        reciprocal = 1.0 / sqrt(dot(stored, stored))
        return (reciprocal * planar.wedge(scale(reciprocal, stored), rate),)

    def to_matrix(self, X: Vector) -> Matrix:
        c, s = X
        return ((c, -s), (s, c))

    def from_matrix(self, rows: Matrix) -> Vector:
        (a, b), (c, d) = rows
        return planar.unit((a + d, c - b))
