"""Unit dual quaternions, rigid motions as [real(4), dual(4)], [H18] (23); tangent [v, omega] as that of SE(3).

Q = q + e q' with the dual unit e, e e = 0. It is a unit if `|q| = 1` and `q . q' = 0`; then q is the rotation and
`2 q' conj(q)` the translation, body to world. -Q is the same motion.

Stored numbers are any Q whose q is not zero: `normalize` divides by the dual number `|Q| = |q| + e (q . q')/|q|`,
so neither a common length nor a part of q' along q matters, and gradients are orthogonal to both.
"""

from torchspline.arithmetic import series, so3
from torchspline.arithmetic.group import Matrix
from torchspline.arithmetic.rigid import ROTATION, RigidMotion
from torchspline.arithmetic.scalar import Scalar, sqrt, where
from torchspline.arithmetic.vector import Vector, add, dot, negate, scale


def multiply(P: Vector, Q: Vector) -> Vector:
    """Product of dual quaternions, unit or not."""
    p, p_dual, q, q_dual = P[:4], P[4:], Q[:4], Q[4:]
    return (*so3.multiply(p, q), *add(so3.multiply(p, q_dual), so3.multiply(p_dual, q)))


def conjugate(Q: Vector) -> Vector:
    """Both quaternions conjugated: the inverse of a unit; `conjugate(P Q) = conjugate(Q) conjugate(P)`."""
    return (*so3.conjugate(Q[:4]), *so3.conjugate(Q[4:]))


def dual_conjugate(Q: Vector) -> Vector:
    """q - e q', of dual numbers: `dual_conjugate(P Q) = dual_conjugate(P) dual_conjugate(Q)`."""
    return (*Q[:4], *negate(Q[4:]))


def point_conjugate(Q: Vector) -> Vector:
    """Both together: a unit moves the point p as `Q (1 + e p) point_conjugate(Q)`."""
    return dual_conjugate(conjugate(Q))


def from_pose(pose: Vector) -> Vector:
    """From [x, y, z, qw, qx, qy, qz] with a unit quaternion: q + e t q / 2, [H18] (23) without its spurious q'."""
    q = pose[3:]
    return (*q, *conjugated_pure(scale(0.5, pose[:3]), q))


def conjugated_pure(v: Vector, q: Vector) -> Vector:
    """(0, v) q = conj(conj(q) (0, -v))."""
    return so3.conjugate(so3.multiply_pure(so3.conjugate(q), negate(v)))


class DualQuaternion(RigidMotion):
    name = "DualQuaternion"
    point_size = 8
    sign_blocks = ((0, 8),)
    unit_blocks = ((0, 4),)

    def rotation(self, X: Vector) -> Vector:
        return X[:4]

    def translation(self, X: Vector) -> Vector:
        return scale(2.0, so3.multiply(X[4:], so3.conjugate(X[:4]))[1:])

    def identity(self) -> tuple[float, ...]:
        return (1.0, *(0.0,) * 7)

    def normalize(self, stored: Vector) -> Vector:
        unit, dual, _ = self._over_length(stored)
        return (*unit, *add(dual, scale(-dot(unit, dual), unit)))

    def sample(self, normals: Vector) -> Vector:
        """The part of q' across q has three standard normal components, and the translation twice its length."""
        return self.normalize((*so3.unit(normals[:4]), *scale(0.5, normals[4:])))

    @staticmethod
    def _over_length(stored: Vector) -> tuple[Vector, Vector, Scalar]:
        """Both parts by the length of the real one, and the reciprocal of that."""
        reciprocal = 1.0 / sqrt(dot(stored[:4], stored[:4]))
        return scale(reciprocal, stored[:4]), scale(reciprocal, stored[4:]), reciprocal

    def long_way(self, X: Vector) -> tuple[Scalar, ...]:
        return (so3.on_far_side(X[:4]),)

    def compose(self, X: Vector, Y: Vector) -> Vector:
        return multiply(X, Y)

    def inverse(self, X: Vector) -> Vector:
        return conjugate(X)

    def exp(self, x: Vector, short: bool = False) -> Vector:
        """cos(a/2) + L sin(a/2) with the dual angle a = angle + e pitch and axis L = axis + e moment of the screw.

        omega = angle axis and v = angle moment + pitch axis, [H18] (24). With s = sin(angle/2)/angle the dual part is
        (-s (v . omega)/2, s v + 2 ds/dx (v . omega) omega), in x = angle^2: smooth where the screw has no axis.
        """
        v, w = x[:3], x[3:]
        quarter = 0.25 * dot(w, w)
        c0, c1, c2, c3 = series.stumpff(quarter, 0, 3, short)
        half_sine, along = 0.5 * c1, dot(v, w)
        slope = 0.125 * (c3 - c2)
        return (
            c0,
            *scale(half_sine, w),
            -0.5 * half_sine * along,
            *add(scale(half_sine, v), scale(slope * along, w)),
        )

    def log(self, X: Vector) -> Vector:
        """Screw parameters read backwards: pitch = -2 q'_0 / sin(angle/2), then the moment from the vector of q'."""
        far = so3.on_far_side(X[:4])
        near = tuple(where(far, -c, c) for c in X)
        factor = so3.log_factor(near[:4])
        w = scale(factor, near[1:4])
        e, _ = series.bernoulli_factor(dot(w, w), short=True)
        return (*scale(factor, add(near[5:], scale(-2.0 * near[4] * e, w))), *w)

    def pull(self, X: Vector, stored_cotangent: Vector) -> Vector:
        q, dual = so3.conjugate(X[:4]), so3.conjugate(X[4:])
        g, g_dual = stored_cotangent[:4], stored_cotangent[4:]
        angular = add(so3.multiply(q, g), so3.multiply(dual, g_dual))
        return (*scale(0.5, so3.multiply(q, g_dual)[1:]), *scale(0.5, angular[1:]))

    def push(self, X: Vector, v: Vector) -> Vector:
        """Q (omega + e v) / 2."""
        linear, angular = scale(0.5, v[:3]), scale(0.5, v[3:])
        dual = add(so3.multiply_pure(X[4:], angular), so3.multiply_pure(X[:4], linear))
        return (*so3.multiply_pure(X[:4], angular), *dual)

    def embed(self, stored: Vector, g: Vector) -> Vector:
        unit, dual, reciprocal = self._over_length(stored)
        along = dot(unit, dual)
        linear, angular = scale(2.0 * reciprocal, g[:3]), scale(2.0 * reciprocal, g[3:])
        # Twice: the unit's dual part has lost its part along q, and 1/|Q| = (1 - e along)/|q| brings in another one.
        across = add(dual, scale(-2.0 * along, unit))
        real = add(so3.multiply_pure(unit, angular), so3.multiply_pure(across, linear))
        return (*real, *so3.multiply_pure(unit, linear))

    def extract(self, stored: Vector, rate: Vector) -> Vector:
        unit, dual, reciprocal = self._over_length(stored)
        along = dot(unit, dual)
        across = so3.conjugate(add(dual, scale(-2.0 * along, unit)))
        q = so3.conjugate(unit)
        linear = add(so3.multiply(q, rate[4:]), so3.multiply(across, rate[:4]))
        angular = so3.multiply(q, rate[:4])
        return (*scale(2.0 * reciprocal, linear[1:]), *scale(2.0 * reciprocal, angular[1:]))

    def from_matrix(self, rows: Matrix) -> Vector:
        q = ROTATION.from_matrix(tuple(row[:3] for row in rows[:3]))
        return from_pose((*(row[3] for row in rows[:3]), *q))
