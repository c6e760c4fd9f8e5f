"""Rigid motions in space, however they are stored: what their groups share, tangent [v, omega] in the body frame."""

from abc import abstractmethod

from torchspline.arithmetic import series, so3
from torchspline.arithmetic.group import AdjointSeriesGroup, Matrix
from torchspline.arithmetic.scalar import Scalar, where
from torchspline.arithmetic.vector import Vector, add, cross, dot, is_zero, scale, zero

ROTATION = so3.SO3()


class RigidMotion(AdjointSeriesGroup):
    """A group isomorphic to SE(3), up to the sign of its numbers."""

    tangent_size = 6
    act_size = 3
    matrix_size = 4

    @abstractmethod
    def rotation(self, X: Vector) -> Vector:
        """Unit quaternion, body to world."""

    @abstractmethod
    def translation(self, X: Vector) -> Vector:
        """Position of the body in the world."""

    def signed_log(self, X: Vector) -> Vector:
        """A full turn back about the same screw: its pitch stays, its axis and moment have turned the other way."""
        x, far = self.log(X), so3.on_far_side(self.rotation(X))
        v, w = x[:3], x[3:]
        back = so3.full_turn_back(w, far)
        size2 = dot(w, w)
        along = dot(v, w) / where(far & (-size2 < 0.0), size2, 1.0)
        return (*add(v, scale(back, add(v, scale(-along, w)))), *add(w, scale(back, w)))

    def act(self, X: Vector, point: Vector) -> Vector:
        return add(self.translation(X), so3.rotate(self.rotation(X), point))

    def act_reverse(self, X: Vector, point: Vector, g: Vector) -> tuple[Vector, Vector]:
        body = so3.unrotate(self.rotation(X), g)
        return (*body, *cross(point, body)), body

    def act_tangent(self, X: Vector, point: Vector, v: Vector, dpoint: Vector) -> Vector:
        return so3.rotate(self.rotation(X), add(v[:3], cross(v[3:], point), dpoint))

    def adjoint_inverse(self, X: Vector, v: Vector) -> Vector:
        if is_zero(v):
            return v
        q = self.rotation(X)
        linear = add(v[:3], cross(v[3:], self.translation(X)))
        return (*so3.unrotate(q, linear), *so3.unrotate(q, v[3:]))

    def coadjoint_inverse(self, X: Vector, g: Vector) -> Vector:
        if is_zero(g):
            return g
        q = self.rotation(X)
        linear = so3.rotate(q, g[:3])
        return (*linear, *add(so3.rotate(q, g[3:]), cross(self.translation(X), linear)))

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

    def to_matrix(self, X: Vector) -> Matrix:
        rows = ROTATION.to_matrix(self.rotation(X))
        return (
            *((*row, p) for row, p in zip(rows, self.translation(X), strict=True)),
            (0.0, 0.0, 0.0, 1.0),
        )
