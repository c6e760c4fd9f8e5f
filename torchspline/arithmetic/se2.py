"""SE(2), rigid motions of the plane: [x, y, cos, sin] maps body to world, tangent [vx, vy, omega] in the body frame."""

from torchspline.arithmetic import planar, series
from torchspline.arithmetic.group import AdjointSeriesGroup, Matrix
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.so2 import SO2
from torchspline.arithmetic.vector import Vector, add, is_zero, negate, scale, zero

_ROTATION = SO2()


class SE2(AdjointSeriesGroup):
    name = "SE2"
    point_size = 4
    tangent_size = 3
    act_size = 2
    matrix_size = 3
    unit_blocks = ((2, 4),)

    def identity(self) -> tuple[float, ...]:
        return (0.0, 0.0, 1.0, 0.0)

    def normalize(self, stored: Vector) -> Vector:
        return (*stored[:2], *planar.unit(stored[2:]))

    def compose(self, X: Vector, Y: Vector) -> Vector:
        return (*add(X[:2], planar.rotate(X[2:], Y[:2])), *planar.multiply(X[2:], Y[2:]))

    def inverse(self, X: Vector) -> Vector:
        return (*negate(planar.unrotate(X[2:], X[:2])), *planar.conjugate(X[2:]))

    def exp(self, x: Vector, short: bool = False) -> Vector:
        """The translation is the complex product of sin(w)/w + i (1 - cos w)/w and v."""
        w = x[2]
        c0, c1, c2 = series.stumpff(w * w, 0, 2, short)
        return (*planar.multiply((c1, c2 * w), x[:2]), c0, c1 * w)

    def log(self, X: Vector) -> Vector:
        w = planar.angle(X[2:])
        x = w * w
        e, _ = series.bernoulli_factor(x, short=True)
        return (*planar.multiply((1.0 - x * e, -0.5 * w), X[:2]), w)

    def act(self, X: Vector, point: Vector) -> Vector:
        return add(X[:2], planar.rotate(X[2:], point))

    def act_reverse(self, X: Vector, point: Vector, g: Vector) -> tuple[Vector, Vector]:
        body = planar.unrotate(X[2:], g)
        return (*body, planar.wedge(point, body)), body

    def act_tangent(self, X: Vector, point: Vector, v: Vector, dpoint: Vector) -> Vector:
        return planar.rotate(X[2:], add(v[:2], scale(v[2], planar.perpendicular(point)), dpoint))

    def adjoint_inverse(self, X: Vector, v: Vector) -> Vector:
        if is_zero(v):
            return v
        linear = add(v[:2], scale(v[2], planar.perpendicular(X[:2])))
        return (*planar.unrotate(X[2:], linear), v[2])

    def coadjoint_inverse(self, X: Vector, g: Vector) -> Vector:
        if is_zero(g):
            return g
        linear = planar.rotate(X[2:], g[:2])
        return (*linear, g[2] + planar.wedge(X[:2], linear))

    def bracket(self, a: Vector, b: Vector) -> Vector:
        if is_zero(a) or is_zero(b):
            return zero(3)
        turned = add(scale(a[2], b[:2]), scale(-b[2], a[:2]))
        return (*planar.perpendicular(turned), 0.0)

    def cobracket(self, a: Vector, g: Vector) -> Vector:
        if is_zero(a) or is_zero(g):
            return zero(3)
        return (*scale(-a[2], planar.perpendicular(g[:2])), -planar.wedge(a[:2], g[:2]))

    def jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        """ad^3 = -omega^2 ad, as in SO(3)."""
        return series.stumpff(x[2] * x[2], 2, 3, short)

    def inverse_jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        return (-0.5, series.bernoulli_factor(x[2] * x[2], short)[0])

    def pull(self, X: Vector, stored_cotangent: Vector) -> Vector:
        z = X[2:]
        return (*planar.unrotate(z, stored_cotangent[:2]), *_ROTATION.pull(z, stored_cotangent[2:]))

    def push(self, X: Vector, v: Vector) -> Vector:
        return (*planar.rotate(X[2:], v[:2]), *_ROTATION.push(X[2:], v[2:]))

    def embed(self, stored: Vector, g: Vector) -> Vector:
        z = stored[2:]
        return (*planar.rotate(planar.unit(z), g[:2]), *_ROTATION.embed(z, g[2:]))

    def extract(self, stored: Vector, rate: Vector) -> Vector:
        z = stored[2:]
        return (*planar.unrotate(planar.unit(z), rate[:2]), *_ROTATION.extract(z, rate[2:]))

    def to_matrix(self, X: Vector) -> Matrix:
        x, y, c, s = X
        return ((c, -s, x), (s, c, y), (0.0, 0.0, 1.0))

    def from_matrix(self, rows: Matrix) -> Vector:
        rotation = _ROTATION.from_matrix(tuple(row[:2] for row in rows[:2]))
        return (rows[0][2], rows[1][2], *rotation)
