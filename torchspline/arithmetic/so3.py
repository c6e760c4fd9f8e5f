"""SO(3), rotations, as unit quaternions [w, x, y, z] (Hamilton), tangent = rotation vector in the body frame."""

from torchspline.arithmetic import series
from torchspline.arithmetic.group import AdjointSeriesGroup, Matrix
from torchspline.arithmetic.scalar import Scalar, sqrt, where
from torchspline.arithmetic.vector import Vector, add, cross, dot, is_zero, negate, scale


def multiply(p: Vector, q: Vector) -> Vector:
    """Hamilton product, [H18] (7)."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def conjugate(q: Vector) -> Vector:
    return (q[0], *negate(q[1:]))


def multiply_pure(q: Vector, v: Vector) -> Vector:
    """q (0, v)."""
    w, x, y, z = q
    a, b, c = v
    return (
        -(x * a + y * b + z * c),
        w * a + y * c - z * b,
        w * b + z * a - x * c,
        w * c + x * b - y * a,
    )


def rotate(q: Vector, v: Vector) -> Vector:
    """R(q) v for a unit quaternion."""
    if is_zero(v):
        return v
    u = q[1:]
    t = scale(2.0, cross(u, v))
    return add(v, scale(q[0], t), cross(u, t))


def unrotate(q: Vector, v: Vector) -> Vector:
    """R(q)^T v for a unit quaternion."""
    if is_zero(v):
        return v
    u = q[1:]
    t = scale(2.0, cross(v, u))
    return add(v, scale(q[0], t), cross(t, u))


def on_far_side(q: Vector) -> Scalar:
    """Whether -q is the short way to the same rotation; a tie at exactly pi goes to the first non-zero component."""
    w, x, y, z = q
    tie = (x < 0) | ((x == 0) & ((y < 0) | ((y == 0) & (z < 0))))
    return (w < 0) | ((w == 0) & tie)


def rotation_log(q: Vector) -> Vector:
    """Rotation vector of a unit quaternion, the short way round, [H18] (13).

    With tan(theta/4) = |v| / (1 + w) the angle is a smooth function of tan^2, which never exceeds one: no branch
    near zero and no square root whose derivative could be infinite.
    """
    far = on_far_side(q)
    near = tuple(where(far, -c, c) for c in q)
    return scale(log_factor(near), near[1:])


def log_factor(q: Vector) -> Scalar:
    """theta / sin(theta/2), the ratio of rotation vector and vector part, of a unit quaternion on the near side."""
    reciprocal = 1.0 / (1.0 + q[0])
    return 4.0 * reciprocal * series.arctan_factor(dot(q[1:], q[1:]) * (reciprocal * reciprocal))


def rotation_exp(x: Vector, short: bool) -> Vector:
    """Unit quaternion of a rotation vector, [H18] (12)."""
    angle2 = dot(x, x)
    return (series.cos_half(angle2, short), *scale(series.sin_half(angle2, short), x))


def unit(q: Vector) -> Vector:
    return scale(1.0 / sqrt(dot(q, q)), q)


def full_turn_back(x: Vector, far: Scalar) -> Scalar:
    """-2 pi / |x| on the far side, else 0; 0 too at minus the identity, which turns about no axis."""
    size2 = dot(x, x)
    turning = far & (-size2 < 0.0)  # `>` would be a far path to the tracer
    return where(turning, -6.283185307179586 / sqrt(where(turning, size2, 1.0)), 0.0)


class SO3(AdjointSeriesGroup):
    name = "SO3"
    point_size = 4
    tangent_size = 3
    act_size = 3
    matrix_size = 3
    sign_blocks = unit_blocks = ((0, 4),)

    def identity(self) -> tuple[float, ...]:
        return (1.0, 0.0, 0.0, 0.0)

    def normalize(self, stored: Vector) -> Vector:
        return unit(stored)

    def long_way(self, X: Vector) -> tuple[Scalar, ...]:
        return (on_far_side(X),)

    def compose(self, X: Vector, Y: Vector) -> Vector:
        return multiply(X, Y)

    def inverse(self, X: Vector) -> Vector:
        return conjugate(X)

    def exp(self, x: Vector, short: bool = False) -> Vector:
        return rotation_exp(x, short)

    def log(self, X: Vector) -> Vector:
        return rotation_log(X)

    def signed_log(self, X: Vector) -> Vector:
        x, far = rotation_log(X), on_far_side(X)
        return add(x, scale(full_turn_back(x, far), x))

    def act(self, X: Vector, point: Vector) -> Vector:
        return rotate(X, point)

    def act_reverse(self, X: Vector, point: Vector, g: Vector) -> tuple[Vector, Vector]:
        body = unrotate(X, g)
        return cross(point, body), body

    def act_tangent(self, X: Vector, point: Vector, v: Vector, dpoint: Vector) -> Vector:
        return rotate(X, add(cross(v, point), dpoint))

    def adjoint_inverse(self, X: Vector, v: Vector) -> Vector:
        return unrotate(X, v)

    def coadjoint_inverse(self, X: Vector, g: Vector) -> Vector:
        return rotate(X, g)

    def bracket(self, a: Vector, b: Vector) -> Vector:
        return cross(a, b)

    def cobracket(self, a: Vector, g: Vector) -> Vector:
        return cross(g, a)

    def jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        """[S20] (72), left instead of right."""
        return series.stumpff(dot(x, x), 2, 3, short)

    def inverse_jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        """[S20] (73), left instead of right."""
        return (-0.5, series.bernoulli_factor(dot(x, x), short)[0])

    def pull(self, X: Vector, stored_cotangent: Vector) -> Vector:
        return scale(0.5, multiply(conjugate(X), stored_cotangent)[1:])

    def push(self, X: Vector, v: Vector) -> Vector:
        return multiply_pure(X, scale(0.5, v))

    def embed(self, stored: Vector, g: Vector) -> Vector:
        # By the length twice rather than by its square, whose derivative leaves the range of float32 early.
        reciprocal = 1.0 / sqrt(dot(stored, stored))
        return multiply_pure(scale(reciprocal, stored), scale(2.0 * reciprocal, g))

    def extract(self, stored: Vector, rate: Vector) -> Vector:
        reciprocal = 1.0 / sqrt(dot(stored, stored))
        return scale(2.0 * reciprocal, multiply(conjugate(scale(reciprocal, stored)), rate)[1:])

    def to_matrix(self, X: Vector) -> Matrix:
        w, x, y, z = X
        xx, yy, zz = x * x, y * y, z * z
        xy, xz, yz = x * y, x * z, y * z
        wx, wy, wz = w * x, w * y, w * z
        return (
            (1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)),
            (2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)),
            (2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)),
        )

    def from_matrix(self, rows: Matrix) -> Vector:
        """Every row of `4 q q^T` is q up to scale; the one with the largest diagonal element is well away from zero."""
        (a, b, c), (d, e, f), (g, h, i) = rows
        candidates = (
            (1.0 + a + e + i, h - f, c - g, d - b),
            (h - f, 1.0 + a - e - i, b + d, c + g),
            (c - g, b + d, 1.0 - a + e - i, f + h),
            (d - b, c + g, f + h, 1.0 - a - e + i),
        )
        best, largest = candidates[0], candidates[0][0]
        for k in (1, 2, 3):
            better = candidates[k][k] > largest
            best = tuple(where(better, new, old) for new, old in zip(candidates[k], best, strict=True))
            largest = where(better, candidates[k][k], largest)
        return unit(best)
