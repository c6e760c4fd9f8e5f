"""SE(3), rigid motions: [x, y, z, qw, qx, qy, qz] maps body to world, tangent [v, omega] in the body frame."""

from torchspline.arithmetic import so3
from torchspline.arithmetic.group import Matrix
from torchspline.arithmetic.rigid import ROTATION, RigidMotion
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, add, negate


class SE3(RigidMotion):
    name = "SE3"
    point_size = 7
    sign_blocks = unit_blocks = ((3, 7),)

    def rotation(self, X: Vector) -> Vector:
        return X[3:]

    def translation(self, X: Vector) -> Vector:
        return X[:3]

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
        return (*ROTATION.left_jacobian(w, v, short), *so3.rotation_exp(w, short))

    def log(self, X: Vector) -> Vector:
        w = so3.rotation_log(X[3:])
        return (*ROTATION.left_jacobian_inverse(w, X[:3], short=True), *w)

    def pull(self, X: Vector, stored_cotangent: Vector) -> Vector:
        q = X[3:]
        return (*so3.unrotate(q, stored_cotangent[:3]), *ROTATION.pull(q, stored_cotangent[3:]))

    def push(self, X: Vector, v: Vector) -> Vector:
        return (*so3.rotate(X[3:], v[:3]), *ROTATION.push(X[3:], v[3:]))

    def embed(self, stored: Vector, g: Vector) -> Vector:
        q = stored[3:]
        return (*so3.rotate(so3.unit(q), g[:3]), *ROTATION.embed(q, g[3:]))

    def extract(self, stored: Vector, rate: Vector) -> Vector:
        q = stored[3:]
        return (*so3.unrotate(so3.unit(q), rate[:3]), *ROTATION.extract(q, rate[3:]))

    def from_matrix(self, rows: Matrix) -> Vector:
        rotation = ROTATION.from_matrix(tuple(row[:3] for row in rows[:3]))
        return (*(row[3] for row in rows[:3]), *rotation)
