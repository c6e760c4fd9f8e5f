"""What the tests of groups and of everything built on them share: groups, adversarial arguments, oracles.

A newly registered group joins `GROUPS` by itself, and a new method of `Group` is missed by a test until it has
a line in `CASES`.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import mpmath as mp
import numpy as np
import pytest
import torch
from scipy.linalg import block_diag
from torch import Tensor

from torchspline.arithmetic import registry
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.product import Product
from torchspline.arithmetic.rn import Rn
from torchspline.groups import Group

PI = math.pi
PRECISIONS = (torch.float32, torch.float64)

FIXED = [Group(name) for name, g in registry.GROUPS.items() if not isinstance(g, (Rn, Product))]
GROUPS = [*FIXED, *map(Group, ("R1", "R3", "R3xSO3", "SO3xSE3"))]

#: From nothing to close to a half-turn; the odd ones are where other libraries lose their digits.
ANGLES = (0.0, 1e-12, 1e-8, 1e-6, 1.1e-5, 1e-4, 1e-3, 3.5e-3, 0.03, 0.3, 1.0, 2.0, 3.0, PI - 1e-3, PI - 1e-6)
#: Closer than float32 can tell from pi.
ALMOST_PI = (PI - 1e-8, PI - 1e-10, PI - 1e-12)
#: Beyond a half-turn, where a rotation vector is not the shortest, away from full turns.
BEYOND_PI = (PI + 1e-6, 4.0, 5.0, 2 * PI - 0.3, 2 * PI + 0.3, 7.5, 3 * PI)
FULL_TURN = (2 * PI - 1e-6, 2 * PI, 2 * PI + 1e-6)
SHORTEST = (*ANGLES, *ALMOST_PI)
ANY_ANGLE = (*SHORTEST, *BEYOND_PI, *FULL_TURN)
LENGTHS = (1e-15, 1e-8, 0.3, 1.0, 70.0, 1e7, 1e15)

each_group = pytest.mark.parametrize("group", GROUPS, ids=str)
each_dtype = pytest.mark.parametrize("dtype", PRECISIONS, ids=("float32", "float64"))


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64).to(dtype)


def error(actual: Tensor, expected: Tensor, dims: int = 1, floor: float = 1.0) -> float:
    """The largest difference in rounding errors of `actual`, NaN if there is one.

    Relative to the largest component, over the last `dims` dimensions, of what is expected, at least to `floor`.
    """
    assert actual.shape == expected.shape, f"{tuple(actual.shape)} instead of {tuple(expected.shape)}"
    last = tuple(range(-dims, 0))
    scale = expected.double().abs().amax(dim=last).clamp_min(floor)
    difference = (actual.double() - expected.double()).abs().amax(dim=last)
    return float((difference / scale).max()) / torch.finfo(actual.dtype).eps


# ---------------------------------------------------------------------- the Lie algebra, written by hand


def _skew() -> np.ndarray:
    basis = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        basis[i, j, k], basis[i, k, j] = -1.0, 1.0
    return basis


def _motions() -> np.ndarray:
    basis = np.zeros((6, 4, 4))
    basis[[0, 1, 2], [0, 1, 2], 3] = 1.0
    basis[3:, :3, :3] = _skew()
    return basis


HATS: dict[str, Callable[[], np.ndarray]] = {"SO3": _skew, "SE3": _motions}


@cache
def hat_basis(name: str) -> np.ndarray:
    """Matrices (D, n, n) of the unit tangents. Groups without an entry above are asked for theirs: at the identity."""
    group = registry.arithmetic(name)
    if name in HATS:
        return HATS[name]()
    if isinstance(group, Rn):
        basis = np.zeros((group.tangent_size, group.matrix_size, group.matrix_size))
        for i in range(group.tangent_size):
            basis[i, i, -1] = 1.0
        return basis
    if isinstance(group, Product):
        sizes = [f.matrix_size for f in group.factors]
        basis = []
        for i, factor in enumerate(group.factors):
            for hat in hat_basis(factor.name):
                basis.append(block_diag(*(hat if i == j else np.zeros((n, n)) for j, n in enumerate(sizes))))
        return np.stack(basis)
    of_tangent = Group(name)
    origin = torch.zeros(of_tangent.tangent_size, dtype=torch.float64)
    moved = torch.func.jacfwd(lambda x: of_tangent.to_matrix(of_tangent.exp(x)))(origin)
    return moved.movedim(-1, 0).numpy()


def hat(group: Group, x: Tensor) -> Tensor:
    """The matrices (..., n, n) of tangents (..., D), in float64."""
    return torch.einsum("...d,dij->...ij", x.double(), torch.from_numpy(hat_basis(group.name)))


def vee(group: Group, matrix: Tensor) -> Tensor:
    """Inverse of `hat`."""
    basis = hat_basis(group.name)
    inverse = np.linalg.pinv(basis.reshape(len(basis), -1).T)
    return matrix.double().flatten(-2) @ torch.from_numpy(inverse).mT


def ad(group: Group, x: Tensor) -> Tensor:
    """The matrices (..., D, D) of v -> [x, v], from commutators."""
    X, E = hat(group, x).unsqueeze(-3), torch.from_numpy(hat_basis(group.name))
    return vee(group, X @ E - E @ X).mT


@cache
def rotation_blocks(name: str) -> tuple[tuple[int, ...], ...]:
    """The tangent components that turn, one tuple for each independent rotation."""
    basis = hat_basis(name)
    blocks: list[list[int]] = []
    for i, E in enumerate(basis):
        if np.abs(np.linalg.eigvals(E).imag).max() < 0.5:
            continue
        F = basis[blocks[-1][0]] if blocks else E
        if np.any(E @ F != F @ E):
            blocks[-1].append(i)
        else:
            blocks.append([i])
    return tuple(map(tuple, blocks))


# ---------------------------------------------------------------------- exponentials and logarithms by mpmath


def expm(matrices: Tensor) -> Tensor:
    """The matrix exponential, correctly rounded: the usual float64 routines are off by up to 200 roundings."""
    with mp.workdps(30):
        exact = [mp.expm(mp.matrix(matrix)).tolist() for matrix in matrices.tolist()]
    return torch.tensor([[[float(c) for c in row] for row in rows] for rows in exact], dtype=torch.float64)


def exact_exp(group: Group, x: Tensor) -> Tensor:
    return expm(hat(group, x))


def exact_jacobian(group: Group, x: Tensor) -> Tensor:
    """The left Jacobian, the integral over s from 0 to 1 of exp(s ad_x), as a block of an exponential."""
    A = ad(group, x)
    one = torch.eye(A.shape[-1], dtype=A.dtype).expand_as(A)
    above = torch.cat([A, one], dim=-1)
    return expm(torch.cat([above, torch.zeros_like(above)], dim=-2))[:, : len(A[0]), len(A[0]) :]


def exact_rotation_exp(w):
    angle = mp.sqrt(sum(c * c for c in w))
    factor = mp.sin(angle / 2) / angle if angle else mp.mpf(1) / 2
    return [mp.cos(angle / 2), *(factor * c for c in w)]


def exact_rotation_log(q):
    q = [-c for c in q] if q[0] < 0 else q
    size = mp.sqrt(sum(c * c for c in q[1:]))
    return [2 * mp.atan2(size, q[0]) / size * c for c in q[1:]] if size else [mp.mpf(0)] * 3


def exact_translation(w):
    """The matrix that turns the translation of a tangent into that of its exponential."""
    W = mp.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    angle = mp.sqrt(sum(c * c for c in w))
    if angle == 0:
        return mp.eye(3)
    return mp.eye(3) + (1 - mp.cos(angle)) / angle**2 * W + (angle - mp.sin(angle)) / angle**3 * W * W


EXACT_EXP = {
    "SO3": exact_rotation_exp,
    "SE3": lambda x: [*(exact_translation(x[3:]) * mp.matrix(x[:3])), *exact_rotation_exp(x[3:])],
}


def exact_motion_log(X):
    w = exact_rotation_log(X[3:])
    return [*mp.lu_solve(exact_translation(w), mp.matrix(X[:3])), *w]


EXACT_LOG = {"SO3": exact_rotation_log, "SE3": exact_motion_log}


def through_mpmath(function, rows: Tensor) -> Tensor:
    with mp.workdps(80):
        results = [[float(c) for c in function([mp.mpf(c) for c in row])] for row in rows.tolist()]
    return torch.tensor(results, dtype=torch.float64)


# ---------------------------------------------------------------------- adversarial arguments


def tangents(
    group: Group, angles: Sequence[float], dtype: torch.dtype = torch.float64, each: int = 2, seed: int = 0
) -> Tensor:
    """`each` random tangents per angle, rotating by that angle, other components of order one."""
    x = normal(len(angles) * each, group.tangent_size, seed=seed)
    for block in rotation_blocks(group.name):
        size = x[:, block].norm(dim=-1, keepdim=True)
        x[:, block] *= torch.tensor(angles, dtype=torch.float64).repeat_interleave(each)[:, None] / size
    return x.to(dtype)


def scale_blocks(group: Group) -> list[tuple[int, int, bool]]:
    """Component ranges that may be multiplied by any number above zero, and whether by any below it too."""
    signed = group.arithmetic.sign_blocks
    inside = [b for b in group.arithmetic.unit_blocks if not any(s[0] <= b[0] < s[1] for s in signed)]
    return [*((*block, True) for block in signed), *((*block, False) for block in inside)]


def rescaled(group: Group, point: Tensor, factors: Sequence[float]) -> Tensor:
    """The same elements in other numbers: quaternions times `factors`, one after the other along the batch.

    Where the sign counts, as in [cos, sin], only the size of the factors does.
    """
    point = point.clone()
    factor = point.new_tensor([factors[i % len(factors)] for i in range(len(point))])[:, None]
    for start, stop, signed in scale_blocks(group):
        point[:, start:stop] *= factor if signed else factor.abs()
    return point


def half_turns(group: Group, dtype: torch.dtype = torch.float64) -> Tensor:
    """Rotations by exactly pi, scalar part exactly zero of either sign, about axes and in general directions."""
    axes = torch.cat([torch.eye(3), torch.tensor([[1.0, 1.0, 0.0], [0.0, 1.0, -2.0]])]).double()
    axes = torch.cat([axes, normal(3, 3, seed=8)])
    q = torch.cat([axes[:, :1] * 0.0, axes / axes.norm(dim=-1, keepdim=True)], dim=-1)
    q = torch.cat([q, -q])
    turn = group.identity(len(q))
    zeros = 0.0 * q[:, :1]  # of both signs
    for start, stop in group.arithmetic.unit_blocks:
        turn[:, start:stop] = q if stop - start == 4 else torch.cat([zeros - 1.0, zeros], dim=-1)
    shift = group.exp(tangents(group, [0.0], each=len(q), seed=9))
    return group.compose(shift, turn).to(dtype)


def points(
    group: Group, angles: Sequence[float], dtype: torch.dtype = torch.float64, each: int = 2, seed: int = 0
) -> Tensor:
    """The identity, `each` points per angle, every third with its sign flipped, and all exact half-turns."""
    x = rescaled(group, group.exp(tangents(group, angles, each=each, seed=seed)), (1.0, 1.0, -1.0))
    return torch.cat([group.identity(1), x, half_turns(group)]).to(dtype)


def equal_up_to_sign(group: Group, actual: Tensor, expected: Tensor) -> float:
    """`error` of points whose quaternions may differ by their sign."""
    actual = actual.clone()
    for start, stop in group.arithmetic.sign_blocks:
        opposite = (actual[..., start:stop] * expected[..., start:stop]).sum(-1, keepdim=True) < 0
        actual[..., start:stop] *= torch.where(opposite, -1.0, 1.0)
    return error(actual, expected)


# ---------------------------------------------------------------------- every operation


class Case(NamedTuple):
    """A method of `Group`; a letter for each argument: Point, Tangent, Vector, Scalar, Matrix."""

    call: Callable[..., Tensor]
    kinds: str
    #: Singular at full turns.
    inverse: bool = False


CASES: dict[str, Case] = {
    "exp": Case(Group.exp, "T"),
    "log": Case(Group.log, "P"),
    "compose": Case(Group.compose, "PP"),
    "inverse": Case(Group.inverse, "P"),
    "between": Case(Group.between, "PP"),
    "act": Case(Group.act, "PV"),
    "interpolate": Case(Group.interpolate, "PPS"),
    "power": Case(Group.power, "PS"),
    "retract": Case(Group.retract, "PT"),
    "retract right": Case(lambda g, x, v: g.retract(x, v, side="right"), "PT"),
    "normalize": Case(Group.normalize, "P"),
    "adjoint": Case(Group.adjoint, "P"),
    "adjoint_act": Case(Group.adjoint_act, "PT"),
    "bracket": Case(Group.bracket, "TT"),
    "left_jacobian": Case(Group.left_jacobian, "T"),
    "right_jacobian": Case(Group.right_jacobian, "T"),
    "left_jacobian_inverse": Case(Group.left_jacobian_inverse, "T", inverse=True),
    "right_jacobian_inverse": Case(Group.right_jacobian_inverse, "T", inverse=True),
    "to_matrix": Case(Group.to_matrix, "P"),
    "from_matrix": Case(Group.from_matrix, "M"),
}
OF_POINTS = [name for name, case in CASES.items() if "P" in case.kinds]
#: Their results are points, whose sign is free.
GIVE_POINTS = (
    "exp",
    "compose",
    "inverse",
    "between",
    "interpolate",
    "power",
    "retract",
    "retract right",
    "normalize",
)


def arguments(group: Group, case: str, angles: Sequence[float], each: int = 1, seed: int = 0) -> list[Tensor]:
    """Arguments for a case in float64, one row per angle: the angle of points, tangents, or between neighbours."""
    step = tangents(group, angles, each=each, seed=seed + 1)
    lengths = rescaled(group, group.exp(step), (1.0, -0.3, 2.0))
    count = len(step)
    made: list[Tensor] = []
    for i, kind in enumerate(CASES[case].kinds):
        if kind == "P" and i == 0 and CASES[case].kinds.startswith("PP"):
            made.append(rescaled(group, group.random(count, generator=generator(seed + 2)), (2.0, 1.0, -0.3)))
        elif kind == "P" and i == 1:
            made.append(rescaled(group, group.compose(made[0], group.exp(step)), (1.0, -0.3, 2.0)))
        elif kind == "S":
            made.append(normal(count, seed=seed + 3))
        elif kind == "V":
            made.append(normal(count, group.arithmetic.act_size, seed=seed + 4))
        elif kind == "T" and i == 1:
            made.append(tangents(group, angles, each=each, seed=seed + 5).flip(0))
        else:
            made.append({"P": lengths, "T": step, "M": group.to_matrix(lengths)}[kind])
    return made


def on_points(case: str, change: Callable[[Tensor], Tensor], given: Sequence[Tensor]) -> list[Tensor]:
    """`given` arguments of a case, the points among them changed."""
    return [change(x) if kind == "P" else x for kind, x in zip(CASES[case].kinds, given, strict=True)]


def factors(group: Group) -> Sequence[GroupArithmetic]:
    """The factors of a direct product, or the group itself."""
    return group.arithmetic.factors if isinstance(group.arithmetic, Product) else (group.arithmetic,)
