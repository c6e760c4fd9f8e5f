"""R^n under addition: points and tangents are the same n numbers, everything commutes."""

from torchspline.arithmetic.group import AdjointSeriesGroup, Matrix
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, add, negate, zero


class Rn(AdjointSeriesGroup):
    def __init__(self, size: int):
        self.name = f"R{size}"
        self.point_size = self.tangent_size = self.act_size = size
        self.matrix_size = size + 1

    def identity(self) -> tuple[float, ...]:
        return (0.0,) * self.point_size

    def normalize(self, stored: Vector) -> Vector:
        return stored

    def compose(self, X: Vector, Y: Vector) -> Vector:
        return add(X, Y)

    def inverse(self, X: Vector) -> Vector:
        return negate(X)

    def exp(self, x: Vector, short: bool = False) -> Vector:
        return x

    def log(self, X: Vector) -> Vector:
        return X

    def act(self, X: Vector, point: Vector) -> Vector:
        return add(X, point)

    def act_reverse(self, X: Vector, point: Vector, g: Vector) -> tuple[Vector, Vector]:
        return g, g

    def act_tangent(self, X: Vector, point: Vector, v: Vector, dpoint: Vector) -> Vector:
        return add(v, dpoint)

    def adjoint_inverse(self, X: Vector, v: Vector) -> Vector:
        return v

    def coadjoint_inverse(self, X: Vector, g: Vector) -> Vector:
        return g

    def bracket(self, a: Vector, b: Vector) -> Vector:
        return zero(self.tangent_size)

    def cobracket(self, a: Vector, g: Vector) -> Vector:
        return zero(self.tangent_size)

    def jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        return ()

    def inverse_jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        return ()

    def pull(self, X: Vector, stored_cotangent: Vector) -> Vector:
        return stored_cotangent

    def push(self, X: Vector, v: Vector) -> Vector:
        return v

    def embed(self, stored: Vector, g: Vector) -> Vector:
        return g

    def extract(self, stored: Vector, rate: Vector) -> Vector:
        return rate

    def to_matrix(self, X: Vector) -> Matrix:
        size = self.point_size
        rows = tuple((*(1.0 if i == j else 0.0 for j in range(size)), X[i]) for i in range(size))
        return (*rows, (*zero(size), 1.0))

    def from_matrix(self, rows: Matrix) -> Vector:
        return tuple(row[-1] for row in rows[:-1])
