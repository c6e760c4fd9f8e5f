"""Direct products of groups: every operation runs on each factor by itself.

`R3xSO3` is the split pose: position in the world and rotation, moved independently. As a direct product it acts
on pairs of points, one for each factor; as a pose it is read by `kinematics`.
"""

from collections.abc import Iterator
from itertools import accumulate
from typing import Any

from torchspline.arithmetic.group import GroupArithmetic, Matrix
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, zero


class Product(GroupArithmetic):
    def __init__(self, *factors: GroupArithmetic):
        self.factors = factors
        self.name = "x".join(f.name for f in factors)
        self.point_size = sum(f.point_size for f in factors)
        self.tangent_size = sum(f.tangent_size for f in factors)
        self.act_size = sum(f.act_size for f in factors)
        self.matrix_size = sum(f.matrix_size for f in factors)
        offsets = list(accumulate((f.point_size for f in factors), initial=0))
        for kind in ("sign_blocks", "unit_blocks"):
            blocks = [
                (offset + start, offset + stop)
                for offset, f in zip(offsets, factors, strict=False)
                for start, stop in getattr(f, kind)
            ]
            setattr(self, kind, tuple(blocks))

    def _split(self, kind: str, *vectors: Vector) -> Iterator[tuple[GroupArithmetic, tuple[Vector, ...]]]:
        """Each factor with its share of the vectors; `kind` has a letter a vector: Point, Tangent or Acted on."""
        offsets = [0] * len(vectors)
        for f in self.factors:
            sizes = {"P": f.point_size, "T": f.tangent_size, "A": f.act_size}
            shares = []
            for i, (letter, v) in enumerate(zip(kind, vectors, strict=True)):
                shares.append(v[offsets[i] : offsets[i] + sizes[letter]])
                offsets[i] += sizes[letter]
            yield f, tuple(shares)

    def _each(self, operation: str, kind: str, *vectors: Vector, **options: Any) -> Vector:
        parts = (getattr(f, operation)(*share, **options) for f, share in self._split(kind, *vectors))
        return tuple(component for part in parts for component in part)

    def identity(self) -> tuple[float, ...]:
        return self._each("identity", "")

    def normalize(self, stored: Vector) -> Vector:
        return self._each("normalize", "P", stored)

    def sample(self, normals: Vector) -> Vector:
        return self._each("sample", "P", normals)

    def long_way(self, X: Vector) -> tuple[Scalar, ...]:
        return self._each("long_way", "P", X)

    def compose(self, X: Vector, Y: Vector) -> Vector:
        return self._each("compose", "PP", X, Y)

    def inverse(self, X: Vector) -> Vector:
        return self._each("inverse", "P", X)

    def exp(self, x: Vector, short: bool = False) -> Vector:
        return self._each("exp", "T", x, short=short)

    def log(self, X: Vector) -> Vector:
        return self._each("log", "P", X)

    def signed_log(self, X: Vector) -> Vector:
        return self._each("signed_log", "P", X)

    def act(self, X: Vector, point: Vector) -> Vector:
        return self._each("act", "PA", X, point)

    def act_reverse(self, X: Vector, point: Vector, g: Vector) -> tuple[Vector, Vector]:
        pairs = [f.act_reverse(*share) for f, share in self._split("PAA", X, point, g)]
        return tuple(c for pair in pairs for c in pair[0]), tuple(c for pair in pairs for c in pair[1])

    def act_tangent(self, X: Vector, point: Vector, v: Vector, dpoint: Vector) -> Vector:
        return self._each("act_tangent", "PATA", X, point, v, dpoint)

    def adjoint_inverse(self, X: Vector, v: Vector) -> Vector:
        return self._each("adjoint_inverse", "PT", X, v)

    def coadjoint_inverse(self, X: Vector, g: Vector) -> Vector:
        return self._each("coadjoint_inverse", "PT", X, g)

    def bracket(self, a: Vector, b: Vector) -> Vector:
        return self._each("bracket", "TT", a, b)

    def cobracket(self, a: Vector, g: Vector) -> Vector:
        return self._each("cobracket", "TT", a, g)

    def left_jacobian(self, x: Vector, v: Vector, short: bool = False) -> Vector:
        return self._each("left_jacobian", "TT", x, v, short=short)

    def left_jacobian_transpose(self, x: Vector, g: Vector, short: bool = False) -> Vector:
        return self._each("left_jacobian_transpose", "TT", x, g, short=short)

    def left_jacobian_inverse(self, x: Vector, v: Vector, short: bool = False) -> Vector:
        return self._each("left_jacobian_inverse", "TT", x, v, short=short)

    def left_jacobian_inverse_transpose(self, x: Vector, g: Vector, short: bool = False) -> Vector:
        return self._each("left_jacobian_inverse_transpose", "TT", x, g, short=short)

    def pull(self, X: Vector, stored_cotangent: Vector) -> Vector:
        return self._each("pull", "PP", X, stored_cotangent)

    def push(self, X: Vector, v: Vector) -> Vector:
        return self._each("push", "PT", X, v)

    def embed(self, stored: Vector, g: Vector) -> Vector:
        return self._each("embed", "PT", stored, g)

    def extract(self, stored: Vector, rate: Vector) -> Vector:
        return self._each("extract", "PP", stored, rate)

    def to_matrix(self, X: Vector) -> Matrix:
        """Block diagonal."""
        rows: list[Vector] = []
        before = 0
        for f, (share,) in self._split("P", X):
            after = self.matrix_size - before - f.matrix_size
            rows += [(*zero(before), *row, *zero(after)) for row in f.to_matrix(share)]
            before += f.matrix_size
        return tuple(rows)

    def from_matrix(self, rows: Matrix) -> Vector:
        point: list[Scalar] = []
        offset = 0
        for f in self.factors:
            inside = slice(offset, offset + f.matrix_size)
            point += f.from_matrix(tuple(row[inside] for row in rows[inside]))
            offset += f.matrix_size
        return tuple(point)
