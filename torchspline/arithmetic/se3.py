"""SE(3), rigid motions: [x, y, z, qw, qx, qy, qz] maps body to world, tangent [v, omega] in the body frame."""

from torchspline.arithmetic import series, so3
from torchspline.arithmetic.group import AdjointSeriesGroup, Matrix
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, add, cross, dot, is_zero, negate, zero

_ROTATION = so3.SO3()


class SE3(AdjointSeriesGroup):
    name = "SE3"
    point_size = 7
    tangent_size = 6
    act_size = 3
    matrix_size = 4
    sign_blocks = ((3, 7),)

    def identity(self) -> tuple[float, ...]:
        return (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

    def normalize(self, stored: Vector) -> Vector:
        return (*stored[:3], *so3.unit(stored[3:]))

    def long_way(self, X: Vector) -> tuple[Scalar, ...]:
        return (so3.on_far_side(X[3:]),)

    def compose(self, X: Vector, Y: Vector) -> Vector:
        return (*add(X[:3], so3.rotate(X[3:], Y[:3])), *so3.multiply(X[3:], Y[3:]))

    def inverse(self, X: Vector) -> Vector:
        return (*negate(so3.unrotate(X[3:], X[:3])), *so3.conjugate(X[3:]))

    def exp(self, x: Vector, short: bool = False) -> Vector:
        v, w = x[:3], x[3:]
        return (*_ROTATION.left_jacobian(w, v, short), *so3.rotation_exp(w, short))

    def log(self, X: Vector) -> Vector:
        w = so3.rotation_log(X[3:])
        return (*_ROTATION.left_jacobian_inverse(w, X[:3], short=True), *w)

    def act(self, X: Vector, point: Vector) -> Vector:
        return add(X[:3], so3.rotate(X[3:], point))

    def act_reverse(self, X: Vector, point: Vector, g: Vector) -> tuple[Vector, Vector]:
        body = so3.unrotate(X[3:], g)
        return (*body, *cross(point, body)), body

    def act_tangent(self, X: Vector, point: Vector, v: Vector, dpoint: Vector) -> Vector:
        return so3.rotate(X[3:], add(v[:3], cross(v[3:], point), dpoint))

    def adjoint_inverse(self, X: Vector, v: Vector) -> Vector:
        if is_zero(v):
            return v
        linear = add(v[:3], cross(v[3:], X[:3]))
        return (*so3.unrotate(X[3:], linear), *so3.unrotate(X[3:], v[3:]))

    def coadjoint_inverse(self, X: Vector, g: Vector) -> Vector:
        if is_zero(g):
            return g
        linear = so3.rotate(X[3:], g[:3])
        return (*linear, *add(so3.rotate(X[3:], g[3:]), cross(X[:3], linear)))

    def bracket(self, a: Vector, b: Vector) -> Vector:
        if is_zero(a) or is_zero(b):
            return zero(6)
        linear = add(cross(a[3:], b[:3]), cross(a[:3], b[3:]))
        return (*linear, *cross(a[3:], b[3:]))

    def cobracket(self, a: Vector, g: Vector) -> Vector:
        if is_zero(a) or is_zero(g):
            return zero(6)
        angular = add(cross(g[:3], a[:3]), cross(g[3:], a[3:]))
        return (*cross(g[:3], a[3:]), *angular)

    def jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        """ad satisfies ad^5 + 2 theta^2 ad^3 + theta^4 ad = 0, so four powers are enough."""
        c1, c2, c3, c4, c5 = series.stumpff(dot(x[3:], x[3:]), 1, 5, short)
        return (
            2.0 * c2 - 0.5 * c1,
            2.5 * c3 - 0.5 * c2,
            0.5 * c3 - c4,
            0.5 * c4 - 1.5 * c5,
        )

    def inverse_jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        """z / (exp(z) - 1) has no odd term but -z/2; the even ones follow from its value and slope."""
        angle2 = dot(x[3:], x[3:])
        e, slope = series.bernoulli_factor(angle2, short)
        return (-0.5, e - angle2 * slope, 0.0, -slope)

    def pull(self, X: Vector, stored_cotangent: Vector) -> Vector:
        q = X[3:]
        return (*so3.unrotate(q, stored_cotangent[:3]), *_ROTATION.pull(q, stored_cotangent[3:]))

    def push(self, X: Vector, v: Vector) -> Vector:
        return (*so3.rotate(X[3:], v[:3]), *_ROTATION.push(X[3:], v[3:]))

    def embed(self, stored: Vector, g: Vector) -> Vector:
        q = stored[3:]
        return (*so3.rotate(so3.unit(q), g[:3]), *_ROTATION.embed(q, g[3:]))

    def extract(self, stored: Vector, rate: Vector) -> Vector:
        q = stored[3:]
        return (*so3.unrotate(so3.unit(q), rate[:3]), *_ROTATION.extract(q, rate[3:]))

    def to_matrix(self, X: Vector) -> Matrix:
        rows = _ROTATION.to_matrix(X[3:])
        return (*((*row, p) for row, p in zip(rows, X[:3], strict=True)), (0.0, 0.0, 0.0, 1.0))

    def from_matrix(self, rows: Matrix) -> Vector:
        rotation = _ROTATION.from_matrix(tuple(row[:3] for row in rows[:3]))
        return (*(row[3] for row in rows[:3]), *rotation)
