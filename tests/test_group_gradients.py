"""The gradient contract of every group operation: exact, finite and transformable wherever one can stand.

Arguments come in batches, one row for each of `ANGLES`: of the points and tangents, or between neighbours, the
identity and 1e-6 from a half-turn included. Steps of finite differences are short enough to stay on one side.
"""

import batteries as kit
import pytest
import torch
from batteries import ANGLES, CASES, PI, arguments, each_dtype, each_group, error, normal, tangents
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vjp, vmap

from torchspline.arithmetic.vector import zero
from torchspline.groups import SE3, SO3, Group
from torchspline.groups.components import join, split

each_case = pytest.mark.parametrize("case", CASES)
#: A row of each kind: the identity, tiny, small, general, 1e-6 from pi.
FEW = (0.0, 1e-12, 1e-8, 1e-4, 1.0, PI - 1e-6)


def beyond(case: str) -> tuple[float, ...]:
    """Angles beyond pi to add where the argument is a tangent; inverse Jacobians have their poles at full turns."""
    if not CASES[case].kinds.startswith("T"):
        return ()
    return kit.BEYOND_PI if CASES[case].inverse else (*kit.BEYOND_PI, *kit.FULL_TURN)


def weights_like(y: torch.Tensor, seed: int = 7) -> torch.Tensor:
    return normal(*y.shape, seed=seed, dtype=y.dtype)


def loss(group: Group, case: str, weights: torch.Tensor):
    """A scalar function that sees every component of the result, also in its second derivatives."""

    def of(*given: torch.Tensor) -> torch.Tensor:
        y = CASES[case].call(group, *given)
        return (weights * (y + 0.5 * y * y)).sum()

    return of


# ---------------------------------------------------------------------- what reverse mode is made of


@each_group
@pytest.mark.parametrize("short", [False, True])
def test_transposes(group, short):
    """Each pair of maps satisfies <y, A x> = <A^T y, x>."""
    g = group.arithmetic
    x = tangents(group, kit.SHORTEST) if short else tangents(group, (*ANGLES, *kit.BEYOND_PI))
    like, x = x, split(x)
    stored = kit.rescaled(group, group.exp(like), (1.0, -0.3, 20.0))
    X, stored, n = split(group.normalize(stored)), split(stored), len(like)
    v, w = (split(normal(n, g.tangent_size, seed=i)) for i in (1, 2))
    p, q = (split(normal(n, g.act_size, seed=i)) for i in (3, 4))
    P = split(normal(n, g.point_size, seed=5))

    def check(forward, cotangent, transpose, argument):
        pair = [join(c, like) for c in (forward, cotangent, transpose, argument)]
        left, right = (pair[0] * pair[1]).sum(-1), (pair[2] * pair[3]).sum(-1)
        size = pair[0].norm(dim=-1) * pair[1].norm(dim=-1) + pair[2].norm(dim=-1) * pair[3].norm(dim=-1)
        assert torch.all((left - right).abs() <= 1e-14 * size)

    for name in ("left_jacobian", "right_jacobian", "left_jacobian_inverse", "right_jacobian_inverse"):
        check(getattr(g, name)(x, v, short), w, getattr(g, f"{name}_transpose")(x, w, short), v)
        assert error(join(getattr(g, name)(x, v, short), like), join(getattr(g, name)(x, v), like)) < 20
    check(g.adjoint(X, v), w, g.coadjoint_inverse(g.inverse(X), w), v)
    check(g.adjoint_inverse(X, v), w, g.coadjoint_inverse(X, w), v)
    check(g.bracket(x, v), w, g.cobracket(x, w), v)
    check(g.push(X, v), P, g.pull(X, P), v)
    check(g.extract(stored, P), w, g.embed(stored, w), P)
    of_point, of_vector = g.act_reverse(X, p, q)
    check(g.act_tangent(X, p, v, zero(g.act_size)), q, of_point, v)
    check(g.act_tangent(X, p, zero(g.tangent_size), p), q, of_vector, p)
    assert error(join(g.exp(x, short), like), group.exp(like)) < 4


# ---------------------------------------------------------------------- against finite differences


@pytest.mark.contract(function="{case}", properties="first second")
@each_case
@each_group
def test_first_and_second_derivatives(group, case):
    given = [x.requires_grad_() for x in arguments(group, case, (*ANGLES, *beyond(case)))]

    def call(*given: torch.Tensor) -> torch.Tensor:
        return CASES[case].call(group, *given)

    # Near their poles inverse Jacobians have derivatives of several hundred, and differences round accordingly.
    precise = {"eps": 1e-7, "atol": 3e-7 if CASES[case].inverse else 3e-8, "rtol": 1e-6, "fast_mode": True}
    assert torch.autograd.gradcheck(call, given, check_forward_ad=True, **precise)
    if call(*given).requires_grad:  # on R^n some results are constants
        assert torch.autograd.gradgradcheck(call, given, check_fwd_over_rev=True, **precise)


@each_group
def test_whole_curves_through_the_exponential(group):
    """Value, Jacobian and Hessian of the exponential are those of the matrix exponential."""
    x = tangents(group, (*kit.SHORTEST, *kit.BEYOND_PI, *kit.FULL_TURN), each=1)
    weights = normal(group.arithmetic.matrix_size, group.arithmetic.matrix_size, seed=2)

    def ours(x):
        return (weights * group.to_matrix(group.exp(x))).sum()

    def theirs(x):
        return (weights * torch.linalg.matrix_exp(kit.hat(group, x))).sum()

    assert error(vmap(jacrev(ours))(x), vmap(jacrev(theirs))(x)) < 60
    expected = vmap(jacrev(jacrev(theirs)))(x)
    for second in (hessian, lambda f: jacrev(jacrev(f)), lambda f: jacfwd(jacfwd(f))):
        assert error(vmap(second(ours))(x), expected, 2) < 60


@each_group
@each_dtype
def test_log_undoes_exp_to_second_order(group, dtype):
    """The Jacobian of log(exp(x)) is the identity and its Hessian zero, up to 1e-12 from a half-turn."""
    x = tangents(group, kit.SHORTEST if dtype == torch.float64 else ANGLES, dtype, each=1)

    def there_and_back(x):
        return group.log(group.exp(x))

    one = torch.eye(group.tangent_size, dtype=torch.float64).expand(len(x), -1, -1)
    for first in (jacrev, jacfwd):
        assert error(vmap(first(there_and_back))(x), one, 2) < 30
        second = vmap(jacfwd(first(there_and_back)))(x)
        assert error(second, torch.zeros_like(second), 3) < 40


@each_group
def test_log_at_half_turns_has_the_gradient_of_its_side(group):
    X = group.normalize(kit.half_turns(group))
    inside = group.exp(group.log(X) * (1 - 1e-10))
    for start, stop in group.arithmetic.sign_blocks:  # the sign that continues X
        inside[:, start:stop] *= (inside[:, start:stop] * X[:, start:stop]).sum(-1, keepdim=True).sign()
    at, near = vmap(jacrev(group.log))(X), vmap(jacrev(group.log))(inside)
    assert error(at, near, 2) * torch.finfo(X.dtype).eps < 1e-8
    assert torch.isfinite(vmap(hessian(lambda X: group.log(X).sum()))(X)).all()


# ---------------------------------------------------------------------- modes and precisions agree


@pytest.mark.contract(function="{case}", properties="forward finite")
@each_case
@each_group
def test_forward_mode_is_dual_to_reverse_mode(group, case):
    given = arguments(group, case, (*kit.SHORTEST, *beyond(case)), each=2)
    rates = [weights_like(x, seed=i) for i, x in enumerate(given)]

    def call(*given):
        return CASES[case].call(group, *given)

    y, forward = jvp(call, tuple(given), tuple(rates))
    cotangent = weights_like(y)
    backward = vjp(call, *given)[1](cotangent)
    left = (cotangent * forward).flatten(1).sum(-1)
    terms = [(g * rate).reshape(len(y), -1) for g, rate in zip(backward, rates, strict=True)]
    right, size = sum(t.sum(-1) for t in terms), sum(t.abs().sum(-1) for t in terms)
    assert torch.all((left - right).abs() <= 1e-13 * (1 + size))


@each_case
@each_group
def test_second_derivatives_along_a_line(group, case):
    """Forward over forward equals reverse over reverse."""
    given = tuple(arguments(group, case, (*kit.SHORTEST, *beyond(case))))
    rates = tuple(weights_like(x, seed=i) for i, x in enumerate(given))
    f = loss(group, case, weights_like(CASES[case].call(group, *given)))

    def slope(*given):
        return jvp(f, given, rates)[1]

    forward = jvp(slope, given, rates)[1]
    leaves = [x.clone().requires_grad_() for x in given]
    value = f(*leaves)
    if not value.requires_grad:
        assert forward == 0
        return
    first = torch.autograd.grad(value, leaves, create_graph=True, materialize_grads=True)
    along = sum((g * rate).sum() for g, rate in zip(first, rates, strict=True))
    second = torch.autograd.grad(along, leaves, materialize_grads=True) if along.requires_grad else rates[:0]
    backward = sum((g * rate).sum() for g, rate in zip(second, rates, strict=False))
    assert abs(forward - backward) <= 1e-11 * (1 + abs(forward))


@pytest.mark.contract(function="{case}", dtypes="float32", properties="single finite")
@each_case
@each_group
def test_float32_gradients(group, case):
    rounded = [x.float() for x in arguments(group, case, (*ANGLES, *beyond(case)), each=2)]
    f = loss(group, case, weights_like(CASES[case].call(group, *rounded)))
    every = tuple(range(len(rounded)))
    single = grad(f, every)(*rounded)
    double = grad(f, every)(*(x.double() for x in rounded))
    for s, d in zip(single, double, strict=True):
        assert s.dtype == torch.float32
        assert error(s[..., None] if s.ndim == 1 else s, d[..., None] if d.ndim == 1 else d) < 200


# ---------------------------------------------------------------------- quaternions of any length


@pytest.mark.parametrize("case", kit.OF_POINTS)
@each_group
@each_dtype
def test_gradients_follow_the_length_of_quaternions(group, case, dtype):
    """Functions of the direction alone: the gradient is orthogonal to q and goes with 1/|q|."""
    unit = kit.on_points(case, group.normalize, [x.to(dtype) for x in arguments(group, case, ANGLES)])
    stretched = kit.on_points(case, lambda x: kit.rescaled(group, x, kit.LENGTHS), unit)
    f = loss(group, case, weights_like(CASES[case].call(group, *unit)))
    every = tuple(range(len(unit)))
    gradients = zip(grad(f, every)(*stretched), grad(f, every)(*unit), strict=True)
    for kind, x, (g, at_unit) in zip(CASES[case].kinds, stretched, gradients, strict=True):
        assert torch.isfinite(g).all()
        if kind != "P":
            continue
        assert error(kit.rescaled(group, g, kit.LENGTHS), at_unit) < 60
        for start, stop, _ in kit.scale_blocks(group):
            q, g_q = x[:, start:stop], g[:, start:stop]
            along, size = (q * g_q).sum(-1).abs(), q.norm(dim=-1) * g_q.norm(dim=-1)
            assert torch.all(along <= 20 * torch.finfo(dtype).eps * (1 + size))


@pytest.mark.parametrize("case", kit.OF_POINTS)
@pytest.mark.parametrize("group", kit.FIXED, ids=str)
@each_dtype
def test_hessians_follow_the_length_of_quaternions(group, case, dtype):
    """They go with 1/|q|^2; float32 has no room for what the extreme lengths need on the way."""
    unit = kit.on_points(case, group.normalize, [x.to(dtype) for x in arguments(group, case, FEW)])
    lengths = (1e-8, 1e8) if dtype == torch.float32 else (1e-15, 70.0, 1e15)
    second = vmap(hessian(loss(group, case, weights_like(CASES[case].call(group, *unit)[0]))))
    expected, blocks = second(*unit), kit.scale_blocks(group)
    for length in lengths:
        result = second(*kit.on_points(case, lambda x: kit.rescaled(group, x, (length,)), unit))
        assert result.dtype == dtype
        for start, stop, _ in blocks:
            inside = (slice(None), slice(start, stop), slice(start, stop))
            assert error(result[inside] * length * length, expected[inside], 2) < 100


# ---------------------------------------------------------------------- transformations


@pytest.mark.contract(function="{case}", properties="vmap")
@each_case
@each_group
def test_vmap_is_a_loop(group, case):
    given = arguments(group, case, FEW)
    y = CASES[case].call(group, *given)
    weights, count = weights_like(y[0]), len(given)
    f = loss(group, case, weights)

    def call(*row):
        return CASES[case].call(group, *row)

    every = tuple(range(count))
    for function, tolerance in (
        (call, 5),
        (grad(f, every), 30),
        (jacrev(call, every), 30),
        (jacfwd(call, every), 30),
    ):
        mapped, loop = vmap(function)(*given), [function(*row) for row in zip(*given, strict=True)]
        if not isinstance(mapped, tuple):
            mapped, loop = (mapped,), [(one,) for one in loop]
        for whole, *parts in zip(mapped, *loop, strict=True):
            assert error(whole.reshape(len(y), -1), torch.stack(parts).reshape(len(y), -1)) < tolerance


@each_case
@pytest.mark.parametrize("group", kit.FIXED, ids=str)
def test_transformations_keep_float32(group, case):
    row = [x[0].float() for x in arguments(group, case, (0.5,))]
    f, every = loss(group, case, weights_like(CASES[case].call(group, *row))), tuple(range(len(row)))
    for first in (jacrev, jacfwd):
        for second in (jacrev, jacfwd):
            blocks = [first(f, every)(*row), *second(first(f, every), every)(*row)]
            assert {x.dtype for block in blocks for x in block} == {torch.float32}


@each_case
@pytest.mark.parametrize("group", [*kit.FIXED, Group("R3xSO3")], ids=str)
def test_hessians_in_every_mode(group, case):
    given = arguments(group, case, FEW)
    f = loss(group, case, weights_like(CASES[case].call(group, *given)[0]))
    every = tuple(range(len(given)))
    both = vmap(jacrev(jacrev(f, every), every))(*given)
    mixed = vmap(jacfwd(jacrev(f, every), every))(*given)
    for i in every:
        for j in every:
            size = given[i][0].numel()
            b, m = both[i][j].reshape(len(FEW), size, -1), mixed[i][j].reshape(len(FEW), size, -1)
            transposed = mixed[j][i].reshape(len(FEW), -1, size).mT
            assert error(b, m, 2) < 60
            assert error(transposed, m, 2) < 60


@pytest.mark.contract(function="{case}", properties="compile")
@each_case
def test_compiled_is_eager(case):
    given = [x.requires_grad_() for x in arguments(SE3, case, FEW)]

    def call(*given):
        return CASES[case].call(SE3, *given)

    torch.compiler.reset()
    compiled = torch.compile(call, fullgraph=True, backend="aot_eager")
    eager, traced = call(*given), compiled(*given)
    assert error(traced.detach(), eager.detach(), eager.ndim - 1) < 5
    cotangent = weights_like(eager)
    for a, b in zip(*(torch.autograd.grad(y, given, cotangent) for y in (traced, eager)), strict=True):
        assert error(a, b, a.ndim) < 20


# ---------------------------------------------------------------------- where other libraries fail


def test_se3_exponential_between_tiny_and_ordinary():
    x = tangents(SE3, torch.logspace(-4, -2.4, 12, dtype=torch.float64).tolist(), each=1).requires_grad_()
    assert torch.autograd.gradcheck(SE3.exp, (x,), atol=1e-7, rtol=1e-6, check_forward_ad=True)


def test_hessian_of_an_angle_at_zero():
    """The squared angle of a rotation vector has the Hessian 2 everywhere, at exactly zero too."""
    for angle in (0.0, 1e-12, 1e-7, 1e-6, 1e-3):
        x = tangents(SO3, [angle], each=1)[0]
        second = hessian(lambda x: SO3.log(SO3.exp(x)).square().sum())(x)
        assert error(second, 2 * torch.eye(3, dtype=torch.float64), 2) < 30


def test_gradient_of_stored_numbers_is_euclidean():
    """What a position contributes stays what it is: no tangent hides in the slots of the point."""
    X, p = SE3.random(5).requires_grad_(), normal(5, 3, seed=1)
    weights = normal(5, 3, seed=2)
    (SE3.act(X, p) * weights).sum().backward()
    assert error(X.grad[:, :3], weights) < 20
    matrix_gradient = torch.einsum("ni,nj->nij", weights, p)
    q = X.detach()[:, 3:].clone().requires_grad_()
    (SO3.to_matrix(q) * matrix_gradient).sum().backward()
    assert error(X.grad[:, 3:], q.grad) < 20


@pytest.mark.parametrize("group", kit.FIXED, ids=str)
@each_dtype
def test_ordinary_optimisers_keep_their_footing(group, dtype):
    target = group.random(4, generator=kit.generator(1), dtype=dtype)
    X = group.identity(4, dtype=dtype).requires_grad_()
    optimizer = torch.optim.Adam([X], lr=0.1)
    for _ in range(250):
        optimizer.zero_grad()
        group.log(group.between(X, target)).square().sum().backward()
        optimizer.step()
    assert group.log(group.between(X, target)).abs().max() < 1e-2
