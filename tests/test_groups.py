"""The axioms of every group, and its operations against matrices, mpmath and each other.

Errors are counted in rounding errors of the dtype, relative to the largest component (`batteries.error`).
"""

import copy
import pickle

import batteries as kit
import numpy as np
import pytest
import torch
from batteries import ANGLES, CASES, GROUPS, PI, each_dtype, each_group, equal_up_to_sign, error, tangents

from torchspline.groups import SE3, SO3, Group

# ---------------------------------------------------------------------- matrices as oracle


def test_every_method_has_a_case():
    other = {"identity", "random", "arithmetic", "name", "point_size", "tangent_size"}
    methods = {name for name in dir(Group) if not name.startswith("_")} - other
    assert methods == {name.removesuffix(" right") for name in CASES}


@each_group
@each_dtype
def test_matrices_form_the_same_group(group, dtype):
    X = kit.points(group, ANGLES, dtype)
    Y = X.roll(7, 0)
    one = torch.eye(group.arithmetic.matrix_size, dtype=torch.float64)
    MX, MY = group.to_matrix(X).double(), group.to_matrix(Y).double()
    assert error(group.to_matrix(group.identity(dtype=dtype)), one, 2) == 0
    assert error(group.to_matrix(group.compose(X, Y)), MX @ MY, 2) < 20
    assert error(group.to_matrix(group.inverse(X)), MX.inverse(), 2) < 20
    assert error(group.to_matrix(group.between(X, Y)), torch.linalg.solve(MX, MY), 2) < 20
    assert error(group.to_matrix(group.normalize(X)), MX, 2) < 6
    assert equal_up_to_sign(group, group.from_matrix(group.to_matrix(X)), group.normalize(X)) < 5


@each_group
@each_dtype
def test_exp_is_the_matrix_exponential(group, dtype):
    x = tangents(group, kit.ANY_ANGLE, dtype)
    assert error(group.to_matrix(group.exp(x)), kit.exact_exp(group, x), 2) < 12


@each_group
@each_dtype
def test_act_is_what_matrices_do(group, dtype):
    X, Y = kit.points(group, ANGLES, dtype), kit.points(group, ANGLES, dtype, seed=5).flip(0)
    p = kit.normal(len(X), group.arithmetic.act_size, seed=1, dtype=dtype)
    M, expected, row, at = group.to_matrix(X).double(), [], 0, 0
    for f in kit.factors(group):  # a matrix with one row more than the vector is homogeneous
        share = p[:, at : at + f.act_size].double()
        share = torch.cat([share, torch.ones(len(p), f.matrix_size - f.act_size).double()], dim=-1)
        inside = slice(row, row + f.matrix_size)
        expected.append((M[:, inside, inside] @ share[:, :, None])[:, : f.act_size, 0])
        row, at = row + f.matrix_size, at + f.act_size
    assert error(group.act(X, p), torch.cat(expected, dim=-1)) < 10
    assert error(group.act(group.compose(X, Y), p), group.act(X, group.act(Y, p))) < 20
    assert error(group.act(group.identity(dtype=dtype), p), p) == 0


@each_group
@each_dtype
def test_adjoint_carries_tangents_across(group, dtype):
    X, Y = kit.points(group, ANGLES, dtype), kit.points(group, ANGLES, dtype, seed=5).flip(0)
    v = tangents(group, kit.ANY_ANGLE, dtype, each=3)[: len(X)]
    M, Ad = group.to_matrix(X).double(), group.adjoint(X)
    assert error(Ad @ v[..., None], kit.vee(group, M @ kit.hat(group, v) @ M.inverse())[..., None], 2) < 20
    assert error(group.adjoint_act(X, v), (Ad.double() @ v.double()[..., None])[..., 0]) < 20
    assert error(group.adjoint(group.compose(X, Y)), Ad.double() @ group.adjoint(Y).double(), 2) < 20
    moved = group.compose(group.compose(X, group.exp(v)), group.inverse(X))
    assert equal_up_to_sign(group, moved, group.exp(group.adjoint_act(X, v))) < 15


@each_group
@each_dtype
def test_bracket(group, dtype):
    a, b, c = (kit.normal(9, group.tangent_size, seed=i, dtype=dtype) for i in range(3))
    A, B = kit.hat(group, a), kit.hat(group, b)
    ab = group.bracket(a, b)
    assert error(ab, kit.vee(group, A @ B - B @ A)) < 5
    assert torch.equal(group.bracket(b, a), -ab)
    bca, cab = group.bracket(group.bracket(b, c), a), group.bracket(group.bracket(c, a), b)
    assert error(group.bracket(ab, c) + bca + cab, torch.zeros_like(a)) < 25


@each_group
def test_bracket_is_the_derivative_of_the_adjoint(group):
    a, b = (kit.normal(9, group.tangent_size, seed=i) for i in range(2))
    t = torch.zeros(9, 1, dtype=a.dtype)
    _, rate = torch.func.jvp(lambda t: group.adjoint_act(group.exp(t * a), b), (t,), (t + 1.0,))
    assert error(rate, group.bracket(a, b)) < 10


# ---------------------------------------------------------------------- exp and log against mpmath


@pytest.mark.parametrize("name", kit.EXACT_EXP)
@each_dtype
def test_exp_in_every_digit(name, dtype):
    group = Group(name)
    x = tangents(group, kit.ANY_ANGLE, dtype)
    X, exact = group.exp(x), kit.through_mpmath(kit.EXACT_EXP[name], x)
    assert error(X, exact) < 10
    # Small rotations have small vector parts, which are to be as accurate in relation to their own size.
    short = x[:, -3:].norm(dim=-1) < PI
    assert error(X[short, -3:], exact[short, -3:], floor=1e-14) < 5


@pytest.mark.parametrize("name", kit.EXACT_LOG)
@each_dtype
def test_log_in_every_digit(name, dtype):
    group = Group(name)
    X = group.exp(tangents(group, kit.SHORTEST)).to(dtype)
    for stored in (X, kit.rescaled(group, X, (-1.0, 3.0))):
        x, exact = group.log(stored), kit.through_mpmath(kit.EXACT_LOG[name], stored)
        assert error(x, exact) < 5
        assert error(x[:, -3:], exact[:, -3:], floor=1e-14) < 5


@each_group
@each_dtype
def test_round_trips(group, dtype):
    angles = ANGLES if dtype == torch.float32 else kit.SHORTEST
    x = tangents(group, angles, dtype, each=4)
    back = group.log(group.exp(x))
    assert error(back, x) < 8
    for block in kit.rotation_blocks(group.name):
        assert error(back[:, block], x[:, block], floor=1e-14) < 6
    X = kit.points(group, angles, dtype)
    assert equal_up_to_sign(group, group.exp(group.log(X)), group.normalize(X)) < 8
    longer = tangents(group, kit.BEYOND_PI, dtype)
    assert equal_up_to_sign(group, group.exp(group.log(group.exp(longer))), group.exp(longer)) < 8


@each_group
@each_dtype
def test_ties_at_half_turns(group, dtype):
    X = kit.half_turns(group, dtype)
    x = group.log(X)
    assert torch.equal(x, group.log(kit.rescaled(group, X, (-1.0,))))
    assert equal_up_to_sign(group, group.exp(x), group.normalize(X)) < 5
    for block in kit.rotation_blocks(group.name):
        w = x[:, block]
        assert error(w.norm(dim=-1, keepdim=True), torch.full_like(w[:, :1], PI)) < 3
        first = w.gather(1, (w != 0).int().argmax(dim=1, keepdim=True))
        assert torch.all(first > 0)


@pytest.mark.parametrize("case", kit.OF_POINTS)
@each_group
@each_dtype
def test_length_and_sign_of_quaternions_do_not_matter(group, case, dtype):
    call = CASES[case].call
    given = [x.to(dtype) for x in kit.arguments(group, case, ANGLES, each=3)]
    lengths = [sign * length for length in kit.LENGTHS for sign in (1, -1)]
    other = kit.on_points(case, lambda x: kit.rescaled(group, group.normalize(x), lengths), given)
    expected, result = call(group, *given), call(group, *other)
    compare = equal_up_to_sign if case in kit.GIVE_POINTS else lambda _, a, b: error(a, b)
    assert compare(group, result, expected) < 25


# ---------------------------------------------------------------------- Jacobians


@each_group
@each_dtype
def test_jacobians_are_integrals_of_the_adjoint(group, dtype):
    for angles, tolerance in ((kit.SHORTEST, 25), ((*kit.BEYOND_PI, *kit.FULL_TURN), 40)):
        x = tangents(group, angles, dtype, each=1)
        left = kit.exact_jacobian(group, x)
        assert error(group.left_jacobian(x), left, 2) < tolerance
        assert error(group.right_jacobian(-x), left, 2) < tolerance
        regular = torch.tensor([angle not in kit.FULL_TURN for angle in angles])
        x, inverse = x[regular], left[regular].inverse()
        assert error(group.left_jacobian_inverse(x), inverse, 2) < 2 * tolerance
        assert error(group.right_jacobian_inverse(-x), inverse, 2) < 2 * tolerance


@each_group
def test_jacobians_differentiate_the_matrix_exponential(group):
    x = tangents(group, kit.ANY_ANGLE)
    v = kit.normal(*x.shape, seed=4)
    M, rate = torch.func.jvp(torch.linalg.matrix_exp, (kit.hat(group, x),), (kit.hat(group, v),))
    assert error((group.left_jacobian(x) @ v[..., None])[..., 0], kit.vee(group, rate @ M.inverse())) < 120
    assert error((group.right_jacobian(x) @ v[..., None])[..., 0], kit.vee(group, M.inverse() @ rate)) < 120


@each_group
def test_jacobians_predict_small_steps(group):
    """[S20] (9) and (10) up to second order: a tenth of the step, a hundredth of the error."""
    x = tangents(group, [angle for angle in ANGLES if angle < 3.1], each=1)
    v = kit.normal(*x.shape, seed=4)

    def misses(h: float) -> list[torch.Tensor]:
        predicted = h * (group.right_jacobian_inverse(x) @ v[..., None])[..., 0]
        logs = group.log(group.compose(group.exp(x), group.exp(h * v))) - x - predicted
        step = group.exp(h * (group.right_jacobian(x) @ v[..., None])[..., 0])
        exact, stepped = group.exp(x + h * v), group.compose(group.exp(x), step)
        return [logs, group.to_matrix(exact) - group.to_matrix(stepped)]

    for coarse, fine in zip(misses(1e-3), misses(1e-4), strict=True):
        assert coarse.abs().max() < 5e-5
        assert fine.abs().max() <= coarse.abs().max() / 90 + 1e-14


@each_dtype
def test_where_other_libraries_lose_digits(dtype):
    """The angles at which published implementations are off by 1e-3 to 0.65, on SE(3) and densely around them."""
    dense = torch.logspace(-7, -1, 25, dtype=torch.float64).tolist()
    x = tangents(SE3, (1e-6, 1.1e-5, 1e-3, 3.5e-3, *dense), dtype, each=1, seed=3)
    X, left = SE3.exp(x), kit.exact_jacobian(SE3, x)
    assert error(SE3.left_jacobian(x), left, 2) < 3
    assert error(SE3.log(X), x) < 4
    assert error(SE3.left_jacobian_inverse(SE3.log(X)), left.inverse(), 2) < 4
    assert error(SO3.right_jacobian(x[:, 3:]), kit.exact_jacobian(SO3, -x[:, 3:]), 2) < 2


# ---------------------------------------------------------------------- steps and geodesics


@each_group
@each_dtype
def test_retract_steps_on_either_side(group, dtype):
    X, v = (x.to(dtype) for x in kit.arguments(group, "retract", ANGLES, each=2))
    step = group.exp(v)
    assert torch.equal(group.retract(X, v), group.compose(step, X))
    assert torch.equal(group.retract(X, v, side="right"), group.compose(X, step))
    expected = kit.exact_exp(group, v) @ group.to_matrix(X).double()
    assert error(group.to_matrix(group.retract(X, v)), expected, 2) < 20
    with pytest.raises(ValueError, match="side"):
        group.retract(X, v, side="middle")


@each_group
@each_dtype
def test_interpolate_is_the_short_geodesic(group, dtype):
    a, b, _ = (x.to(dtype) for x in kit.arguments(group, "interpolate", ANGLES))
    step = group.log(group.between(a, b))
    for block in kit.rotation_blocks(group.name):
        assert step[:, block].norm(dim=-1).max() <= PI * (1 + 1e-6)
    A, B = group.to_matrix(a).double(), group.to_matrix(b).double()
    assert error(group.to_matrix(group.interpolate(a, b, 0.0)), A, 2) < 8
    assert error(group.to_matrix(group.interpolate(a, b, 1.0)), B, 2) < 20
    for s in (0.5, 0.25, -1.0, 2.5):
        expected = A @ kit.exact_exp(group, s * step.double())
        assert error(group.to_matrix(group.interpolate(a, b, s)), expected, 2) < 30
        assert error(group.to_matrix(group.interpolate(b, a, 1 - s)), expected, 2) < 30
    half = group.interpolate(a, b, 0.5)
    assert error(group.log(group.between(half, b)), step / 2) < 30
    flipped = group.interpolate(a, kit.rescaled(group, b, (-1.0,)), 0.5)
    assert equal_up_to_sign(group, flipped, half) < 10


def test_interpolate_known_quarter_turn():
    start, end = torch.tensor([2.0, 0.0, 0.0, 0.0]), torch.tensor([-1.0, 0.0, 0.0, -1.0])
    for s, angle in ((0.5, PI / 4), (1.5, 3 * PI / 4), (-1.0, -PI / 2)):
        q = SO3.interpolate(start, end, s)
        assert equal_up_to_sign(SO3, q, torch.tensor([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])) < 3


# ---------------------------------------------------------------------- tensors in, tensors out


@pytest.mark.parametrize("case", CASES)
@each_group
def test_batches(group, case):
    call = CASES[case].call
    given = kit.arguments(group, case, ANGLES[::3])
    before = [x.clone() for x in given]
    full = call(group, *given)
    one_by_one = torch.stack([call(group, *(x[i] for x in given)) for i in range(len(full))])
    assert error(full, one_by_one) < 3
    for count in (0, 1):
        assert call(group, *(x[:count] for x in given)).shape == (count, *full.shape[1:])
        assert call(group, *(x[None, :count] for x in given)).shape == (1, count, *full.shape[1:])
    spread = [torch.stack([x, x], dim=-1)[..., 0] for x in given]
    assert not all(x.is_contiguous() for x in spread)
    assert torch.equal(call(group, *spread), full)
    expanded = [x.expand(2, *x.shape) for x in given]
    assert torch.equal(call(group, *expanded), full.expand(2, *full.shape))
    assert all(torch.equal(x, y) for x, y in zip(given, before, strict=True))
    for i in range(len(given)):  # every argument may be the one that is broadcast
        if len(given) > 1:
            same = call(group, *(x[:1].expand_as(x) if i == j else x for j, x in enumerate(given)))
            for part in (0, slice(0, 1)):
                some = call(group, *(x[part] if i == j else x for j, x in enumerate(given)))
                assert torch.equal(some, same)
            outer = call(group, *(x[:, None] if i == j else x[None] for j, x in enumerate(given)))
            assert error(outer.diagonal(dim1=0, dim2=1).movedim(-1, 0), full) < 3
    result = call(group, *given)
    result += 1.0
    assert all(torch.equal(x, y) for x, y in zip(given, before, strict=True)), "the result shares memory"


@pytest.mark.parametrize("default", kit.PRECISIONS, ids=("default32", "default64"))
@each_group
def test_dtype_follows_the_arguments(group, default):
    previous = torch.get_default_dtype()
    try:
        torch.set_default_dtype(default)
        for dtype in kit.PRECISIONS:
            for name, (call, _, _) in CASES.items():
                given = [x.to(dtype).requires_grad_() for x in kit.arguments(group, name, ANGLES[::3])]
                result = call(group, *given)
                assert result.dtype == dtype, name
                assert result.device == given[0].device
                if result.requires_grad:
                    result.sum().backward()
                assert all(x.grad is None or x.grad.dtype == dtype for x in given), name
            assert group.identity(2, dtype=dtype).dtype == dtype
            assert group.random(2, dtype=dtype).dtype == dtype
            point = group.random(2, dtype=dtype)
            assert group.interpolate(point, point, 0.5).dtype == dtype
        assert group.identity().dtype == group.random().dtype == torch.float64
    finally:
        torch.set_default_dtype(previous)


# ---------------------------------------------------------------------- the group as an object


@each_group
def test_groups_are_values(group):
    pickled = pickle.loads(pickle.dumps(group))
    for twin in (Group(group.name), copy.copy(group), copy.deepcopy(group), pickled):
        assert twin == group
        assert hash(twin) == hash(group)
        assert twin.arithmetic is group.arithmetic
    assert sum(other == group for other in GROUPS) == 1
    with pytest.raises(AttributeError):
        group.name = "SO3"


@each_group
@each_dtype
def test_random_is_seeded_and_normalised(group, dtype):
    first, second = (group.random(500, 2, generator=kit.generator(3), dtype=dtype) for _ in range(2))
    assert first.shape == (500, 2, group.point_size)
    assert torch.equal(first, second)
    assert not torch.equal(first, group.random(500, 2, dtype=dtype))
    assert error(group.normalize(first), first) < 3
    # Half of all rotations turn by more than 2.31 rad: uniform on the rotations, not on the angles.
    for block in kit.rotation_blocks(group.name):
        if len(block) == 3:
            assert abs(group.log(first)[..., block].norm(dim=-1).median() - 2.31) < 0.1
    assert group.random().shape == (group.point_size,)
