"""What a Lie group has to know: the primitives from which everything else in the library is derived.

A group is written once, as arithmetic on tuples of components (`scalar.py`), and then runs on tensors, on
symbols that become compiled kernels, and on multi-precision numbers. Adding a group means implementing this
class in one module and naming it in `registry.py`.

Notation: X, Y points; x, v tangents in the body frame (left-trivialised, `hat(v) = X^-1 dX`); g, the
cotangent paired with such a v, so that a small step `X Exp(v)` changes a loss by `g . v`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable

from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, add, negate, scale, zero

Matrix = tuple[Vector, ...]


class GroupArithmetic(ABC):
    """A matrix Lie group in components.

    Points passed in are unit (`normalize` has been applied) unless a parameter is called `stored`: that one is
    the numbers as the user keeps them, quaternions of any length.
    """

    #: The name under which the registry finds the group, e.g. "SE3".
    name: str
    #: Numbers that store a point, and dimension of the tangent space.
    point_size: int
    tangent_size: int
    #: Dimension of the space the group acts on, and rows of its matrices.
    act_size: int
    matrix_size: int
    #: Component ranges [start, stop) whose common sign is free (unit quaternions cover rotations twice).
    sign_blocks: tuple[tuple[int, int], ...] = ()
    #: Ranges that hold a unit vector and are stored at any length, which `normalize` takes away. A sign block around
    #: one (that of dual quaternions is wider) is stored at its length as a whole.
    unit_blocks: tuple[tuple[int, int], ...] = ()

    @abstractmethod
    def identity(self) -> tuple[float, ...]:
        """The neutral element."""

    @abstractmethod
    def normalize(self, stored: Vector) -> Vector:
        """The unit representative of stored numbers."""

    def sample(self, normals: Vector) -> Vector:
        """A random point from as many standard normal numbers: rotations uniform, translations standard normal."""
        return self.normalize(normals)

    def long_way(self, X: Vector) -> tuple[Scalar, ...]:
        """For each sign block, whether X lies on the far side, so that its sign has to flip before a logarithm."""
        return ()

    @abstractmethod
    def compose(self, X: Vector, Y: Vector) -> Vector:
        """X Y."""

    @abstractmethod
    def inverse(self, X: Vector) -> Vector:
        """X^-1."""

    @abstractmethod
    def exp(self, x: Vector, short: bool = False) -> Vector:
        """Exp(x); `short` promises a rotation angle of at most pi and saves the range reduction."""

    @abstractmethod
    def log(self, X: Vector) -> Vector:
        """The shortest x with Exp(x) = X; at exactly pi its first non-zero rotation component is positive."""

    def signed_log(self, X: Vector) -> Vector:
        """The x with Exp(x) = X, signs of numbers included: beyond pi, up to 2 pi, where they lie on the far side.

        On the double cover, as on SU(2) in [H18] (11)-(13). At minus the identity, where no axis is nearer
        than another, that of the identity; it jumps there.
        """
        return self.log(X)

    @abstractmethod
    def act(self, X: Vector, point: Vector) -> Vector:
        """X applied to a point of the space it acts on."""

    @abstractmethod
    def act_reverse(self, X: Vector, point: Vector, g: Vector) -> tuple[Vector, Vector]:
        """Cotangents of X (body frame) and of the point, given that of `act`."""

    @abstractmethod
    def act_tangent(self, X: Vector, point: Vector, v: Vector, dpoint: Vector) -> Vector:
        """Rate of `act` when X moves with body tangent v and the point with dpoint."""

    @abstractmethod
    def adjoint_inverse(self, X: Vector, v: Vector) -> Vector:
        """Ad_{X^-1} v."""

    @abstractmethod
    def coadjoint_inverse(self, X: Vector, g: Vector) -> Vector:
        """Transpose of `adjoint_inverse`, applied to a cotangent."""

    def adjoint(self, X: Vector, v: Vector) -> Vector:
        """Ad_X v, [S20] (3)."""
        return self.adjoint_inverse(self.inverse(X), v)

    @abstractmethod
    def bracket(self, a: Vector, b: Vector) -> Vector:
        """[a, b] = ad_a b. Corrects [S20] (6), which should read V W - W V."""

    @abstractmethod
    def cobracket(self, a: Vector, g: Vector) -> Vector:
        """Transpose of ad_a, applied to a cotangent."""

    @abstractmethod
    def left_jacobian(self, x: Vector, v: Vector, short: bool = False) -> Vector:
        """J_l(x) v: `Exp(x + v) = Exp(J_l(x) v) Exp(x)` to first order."""

    @abstractmethod
    def left_jacobian_transpose(self, x: Vector, g: Vector, short: bool = False) -> Vector:
        """Transpose of `left_jacobian`, applied to a cotangent."""

    @abstractmethod
    def left_jacobian_inverse(self, x: Vector, v: Vector, short: bool = False) -> Vector:
        """J_l(x)^-1 v; singular where the rotation angle is a multiple of 2 pi other than 0."""

    @abstractmethod
    def left_jacobian_inverse_transpose(self, x: Vector, g: Vector, short: bool = False) -> Vector:
        """Transpose of `left_jacobian_inverse`, applied to a cotangent."""

    @abstractmethod
    def pull(self, X: Vector, stored_cotangent: Vector) -> Vector:
        """The body cotangent that a cotangent of the numbers of X amounts to: transpose of `push`."""

    @abstractmethod
    def push(self, X: Vector, v: Vector) -> Vector:
        """Rate of the numbers of X when X moves with body tangent v."""

    @abstractmethod
    def embed(self, stored: Vector, g: Vector) -> Vector:
        """The Euclidean gradient, with respect to stored numbers, of a loss with body cotangent g."""

    @abstractmethod
    def extract(self, stored: Vector, rate: Vector) -> Vector:
        """The body tangent of a rate of stored numbers: transpose of `embed`."""

    @abstractmethod
    def to_matrix(self, X: Vector) -> Matrix:
        """Rows of the (homogeneous) matrix of X."""

    @abstractmethod
    def from_matrix(self, rows: Matrix) -> Vector:
        """The point whose matrix this is; differentiable everywhere, the half-turns included."""

    # ------------------------------------------------------------------ derived, never overridden

    def between(self, X: Vector, Y: Vector) -> Vector:
        """X^-1 Y."""
        return self.compose(self.inverse(X), Y)

    def right_jacobian(self, x: Vector, v: Vector, short: bool = False) -> Vector:
        """J_r(x) v, [S20] (8): `Exp(x + v) = Exp(x) Exp(J_r(x) v)` to first order; J_r(x) = J_l(-x)."""
        return self.left_jacobian(negate(x), v, short)

    def right_jacobian_transpose(self, x: Vector, g: Vector, short: bool = False) -> Vector:
        return self.left_jacobian_transpose(negate(x), g, short)

    def right_jacobian_inverse(self, x: Vector, v: Vector, short: bool = False) -> Vector:
        """J_r(x)^-1 v."""
        return self.left_jacobian_inverse(negate(x), v, short)

    def right_jacobian_inverse_transpose(self, x: Vector, g: Vector, short: bool = False) -> Vector:
        return self.left_jacobian_inverse_transpose(negate(x), g, short)


class AdjointSeriesGroup(GroupArithmetic):
    """A group whose Jacobians are short polynomials in ad_x, which its minimal polynomial always allows."""

    @abstractmethod
    def jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        """c_1, c_2, ... of the left Jacobian `J_l(x) = 1 + c_1 ad_x + c_2 ad_x^2 + ...`."""

    @abstractmethod
    def inverse_jacobian_series(self, x: Vector, short: bool = False) -> tuple[Scalar, ...]:
        """The same for the inverse of the left Jacobian."""

    def left_jacobian(self, x: Vector, v: Vector, short: bool = False) -> Vector:
        return _horner(self.jacobian_series(x, short), self.bracket, x, v)

    def left_jacobian_transpose(self, x: Vector, g: Vector, short: bool = False) -> Vector:
        return _horner(self.jacobian_series(x, short), self.cobracket, x, g)

    def left_jacobian_inverse(self, x: Vector, v: Vector, short: bool = False) -> Vector:
        return _horner(self.inverse_jacobian_series(x, short), self.bracket, x, v)

    def left_jacobian_inverse_transpose(self, x: Vector, g: Vector, short: bool = False) -> Vector:
        return _horner(self.inverse_jacobian_series(x, short), self.cobracket, x, g)


def _horner(
    coefficients: tuple[Scalar, ...], operator: Callable[[Vector, Vector], Vector], x: Vector, v: Vector
) -> Vector:
    """v + c_1 A v + c_2 A^2 v + ... with A = operator(x, .)."""
    total = zero(len(v))
    for c in reversed(coefficients):
        total = operator(x, add(scale(c, v), total))
    return add(v, total)
