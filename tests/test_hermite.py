"""Quintic Hermite splines: [E17] written out in matrices, boundary conditions, differentials, the gradient contract."""

import itertools

import batteries as kit
import pytest
import scipy.interpolate
import torch
from batteries import GROUPS, each_group, error, normal
from oracles import body_rates, expm
from spline_cases import close
from test_jet import derivatives_of

from torchspline import R3, SE3, SO3, HermiteSpline, Trajectory
from torchspline.functional import hermite
from torchspline.groups import Group
from torchspline.splines.hermite import QUINTICS, quintic_weights
from torchspline.splines.trajectory import State, to_body_frame, to_world_frame

float64 = torch.float64
TIMES = torch.tensor([-0.4, 0.3, 0.5, 1.7], dtype=float64)
T = torch.tensor([-0.4, -0.1, 0.31, 0.47, 1.2, 1.7], dtype=float64)
each_kind = pytest.mark.parametrize("coordinates", ["product", "logarithm"])
each_frame = pytest.mark.parametrize("frame", ["body", "world"])


def knots(group, count=4, batch=(), seed=0, speed=1.0):
    """Values, velocities and accelerations; quaternions of any length and sign."""
    size = torch.Size(batch).numel()
    values = kit.rescaled(group, group.random(count * size, generator=kit.generator(seed)), (2.0, -0.3, 1.0))
    rates = normal(2, count * size, group.tangent_size, seed=seed + 1)
    shape = (*batch, count, -1)
    return values.reshape(shape), speed * rates[0].reshape(shape), speed**2 * rates[1].reshape(shape)


def spline(group, coordinates="product", frame="body", **options):
    return HermiteSpline(
        *knots(group, **options), group=group, times=TIMES, coordinates=coordinates, frame=frame
    )


# ---------------------------------------------------------------------- the curve


def test_polynomials():
    """[E17] (66)-(76): each a_j is one of twelve numbers at the ends, and zero in the others."""
    ends = quintic_weights(torch.tensor([0.0, 1.0], dtype=float64), 2)
    expected = torch.zeros(2, 3, 5, dtype=float64)
    for j, (end, derivative) in enumerate([(1, 0), (0, 1), (1, 1), (0, 2), (1, 2)]):
        expected[end, derivative, j] = 1.0
    assert torch.equal(ends, expected)
    u = torch.linspace(0, 1, 7, dtype=float64)
    for j, row in enumerate(QUINTICS):
        exact = torch.as_tensor(scipy.interpolate.PPoly([[float(c)] for c in row[::-1]], [0, 1])(u.numpy()))
        assert close(quintic_weights(u, 0)[:, 0, j], exact, 1e-14)


@each_group
@each_kind
@each_frame
@pytest.mark.parametrize("speed", [0.0, 1.0, 30.0])
def test_boundary_conditions_and_c2(group, coordinates, frame, speed):
    """[E17] (53)-(58), (82)-(85) at every knot from both sides; fast knots turn by more than pi in a segment."""
    values, velocities, accelerations = knots(group, speed=speed)
    options = {"group": group, "coordinates": coordinates, "frame": frame}
    for i in range(4):
        for part in (slice(i, i + 2), slice(i - 1, i + 1)):  # the segment after the knot, the one before
            if not 0 <= part.start < part.stop <= 4:
                continue
            here = HermiteSpline(
                values[part], velocities[part], accelerations[part], times=TIMES[part], **options
            )
            state = here.evaluate(TIMES[i], frame=frame)
            assert kit.equal_up_to_sign(group, state.value, group.normalize(values[i])) < 100
            assert close(state.velocity, velocities[i], 1e-13)
            assert close(state.acceleration, accelerations[i], 1e-13)


@each_group
@each_kind
@each_frame
def test_rates_are_derivatives(group, coordinates, frame):
    """Up to the jerk, in both frames, by nested forward mode through matrices."""
    curve, t = spline(group, coordinates, frame, speed=3.0), T[1:-1]
    curve.validate = False
    matrices = derivatives_of(lambda t: group.to_matrix(curve(t), validate=False), t, 3)
    exact = State(curve(t), *body_rates(group, matrices))
    for state, expected in (
        (curve.evaluate(t, 3), exact),
        (curve.evaluate(t, 3, frame="world"), to_world_frame(exact, group)),
    ):
        for ours, theirs in zip(state, expected, strict=True):
            assert close(ours, theirs, 1e-10)
    back = to_body_frame(to_world_frame(exact, group), group)
    assert all(close(a, b, 1e-13) for a, b in zip(back, exact, strict=True))
    back = group.to_matrix(exact.value) @ kit.hat(group, exact.velocity)
    ahead = kit.hat(group, to_world_frame(exact, group).velocity) @ group.to_matrix(exact.value)
    assert close(back, ahead, 1e-13)


@each_kind
def test_on_a_commutative_group_it_is_the_quintic(coordinates):
    """SciPy's polynomials in Bernstein form from the same derivatives."""
    y = torch.stack(knots(R3), dim=1)
    reference = scipy.interpolate.BPoly.from_derivatives(TIMES.numpy(), y.numpy())
    state = spline(R3, coordinates).evaluate(T, 3)
    for r, ours in enumerate(state):
        assert close(
            ours, torch.as_tensor(reference.derivative(r)(T.numpy()) if r else reference(T.numpy())), 1e-12
        )


@each_group
def test_value_signs_and_lengths_do_not_matter(group):
    values, *rates = knots(group)
    other = kit.rescaled(group, values, (1e-15, -1e15, -1.0))
    for coordinates in ("product", "logarithm"):
        options = {"group": group, "times": TIMES, "coordinates": coordinates}
        a, b = (hermite(x, *rates, T, **options) for x in (values, other))
        assert kit.equal_up_to_sign(group, a.value, b.value) < 50
        assert all(close(x, y, 1e-13) for x, y in zip(a[1:3], b[1:3], strict=True))
    dense = hermite(values, *rates, torch.linspace(-0.4, 1.7, 2000, dtype=float64), **options).value
    for start, stop in group.arithmetic.sign_blocks:
        assert ((dense[1:, start:stop] * dense[:-1, start:stop]).sum(-1) > 0).all()


def smooth(group, t):
    """A motion without any relation to the spline: a product of two exponentials."""
    a, b, c = (normal(group.tangent_size, seed=i) for i in range(3))
    x = torch.sin(1.3 * t)[:, None] * a + torch.cos(0.7 * t)[:, None] * b
    return group.compose(group.exp(x, validate=False), group.exp((t * t)[:, None] * 0.5 * c, validate=False))


def sampled(group, count, coordinates):
    times = torch.linspace(0.0, 1.5, count + 1, dtype=float64)
    matrices = derivatives_of(lambda t: group.to_matrix(smooth(group, t), validate=False), times, 2)
    rates = body_rates(group, matrices)
    return HermiteSpline(smooth(group, times), *rates, group=group, times=times, coordinates=coordinates)


@pytest.mark.parametrize("group", [SO3, SE3], ids=str)
@pytest.mark.parametrize(
    ("coordinates", "orders"),
    [("product", (3, 2, 1)), ("logarithm", (6, 5, 4))],
    ids=("product", "logarithm"),
)
def test_order_of_convergence(group, coordinates, orders):
    t = torch.linspace(0.0, 1.5, 401, dtype=float64)
    matrices = derivatives_of(lambda t: group.to_matrix(smooth(group, t), validate=False), t, 2)
    exact, misses = body_rates(group, matrices), []
    for count in (8, 16):
        state = sampled(group, count, coordinates).evaluate(t)
        steps = group.log(group.between(smooth(group, t), state.value))
        misses.append(
            [x.abs().max() for x in (steps, *(a - b for a, b in zip(state[1:3], exact, strict=True)))]
        )
    for order, coarse, fine in zip(orders, *misses, strict=True):
        assert abs(torch.log2(coarse / fine) - order) < 0.35


# ---------------------------------------------------------------------- [E17] to the letter


def matrices_of_e17(group, p, a, B0):
    """(24), (33), (36), (59) in matrices, for a(t) and two derivatives at one time; and Ad of each A_i."""
    S, rate, second, factors = torch.eye(len(B0), dtype=float64), 0.0, 0.0, []
    rate = second = torch.zeros(group.tangent_size, dtype=float64)
    for i in range(5):
        A = expm(kit.hat(group, a[0][i] * p[i])[None])[0]
        Ad = expm(kit.ad(group, a[0][i] * p[i])[None])[0]  # (4)
        second = a[2][i] * p[i] + Ad @ second + kit.ad(group, a[1][i] * p[i]) @ Ad @ rate
        rate = a[1][i] * p[i] + Ad @ rate
        S = A @ S
        factors.append((Ad, rate, second))
    return S @ B0, rate, second, factors


def integral_exp(group, x):
    """(37), D_exp[x] = int exp(s ad x) ds, a block of an exponential."""
    A = kit.ad(group, x)
    one, none = torch.eye(len(A), dtype=float64), torch.zeros_like(A)
    return expm(torch.cat([torch.cat([A, one], 1), torch.cat([none, none], 1)])[None])[0][: len(A), len(A) :]


def differentials_of_e17(group, p, a, factors):
    """(39)-(45) by p_i of its own S_i, then (46)-(52) to the last: three lists of D x D matrices."""
    size = group.tangent_size
    one = torch.eye(size, dtype=float64)
    own, before = [], (torch.zeros(size, dtype=float64),) * 2
    for i in range(5):
        Ad, rate, second = factors[i]
        dA = a[0][i] * integral_exp(group, a[0][i] * p[i])  # (40)
        ad_rate, ad_second = kit.ad(group, Ad @ before[0]), kit.ad(group, Ad @ before[1])
        ad_A = kit.ad(group, a[1][i] * p[i])
        first = a[1][i] * one - ad_rate @ dA  # (43)
        two = a[2][i] * one - (ad_second + ad_A @ ad_rate) @ dA - a[1][i] * ad_rate  # (44)
        own.append((dA, first, two))
        before = (rate, second)
    L, l, total = one, torch.zeros(size, dtype=float64), [None] * 5
    for i in reversed(range(5)):
        zero, first, two = own[i]
        total[i] = (L @ zero, L @ first, L @ two + kit.ad(group, l) @ L @ first)  # (48)-(50)
        l = l + L @ (a[1][i] * p[i])  # (52) with the L of step i
        L = L @ factors[i][0]  # (51)
    return total, L


@each_group
def test_e17_to_the_letter(group):
    """Value, world-frame rates (33), (36) and all differentials (93)-(100) of one segment of a second."""
    values, velocities, accelerations = (x[:2] for x in knots(group, seed=7))
    times = torch.tensor([2.0, 3.0], dtype=float64)
    curve = HermiteSpline(values, velocities, accelerations, group=group, times=times, frame="world")
    B0 = group.to_matrix(values[0])
    p1 = group.log(group.compose(values[1], group.inverse(values[0])))  # (81)
    p = [p1, velocities[0], velocities[1], accelerations[0], accelerations[1]]
    for u in (0.0, 0.2, 0.55, 0.97):
        a = [row.tolist() for row in quintic_weights(torch.tensor(u, dtype=float64), 2)]
        value, rate, second, factors = matrices_of_e17(group, p, a, B0)
        t = torch.tensor([2.0 + u], dtype=float64)
        state = curve.evaluate(t, frame="world")
        for ours, theirs in zip(
            (group.to_matrix(state.value), *state[1:3]), (value, rate, second), strict=True
        ):
            assert close(ours[0], theirs, 1e-13)
        total, S = differentials_of_e17(group, p, a, factors)
        inverse = torch.linalg.inv(integral_exp(group, p1))
        by_B1 = [block @ inverse for block in total[0]]  # (93), (96)
        by_B0 = [
            -block @ inverse @ group.adjoint(values[1]) @ group.adjoint(group.inverse(values[0]))
            for block in total[0]
        ]
        by_B0[0] = by_B0[0] + S  # (94), (95): S moves with B0, its rates do not
        jacobian = curve.differentials(t, side="left").jacobian[0]
        for r in range(3):
            expected = [by_B0[r], by_B1[r], *(total[i][r] for i in range(1, 5))]
            for ours, theirs in zip(jacobian[r], expected, strict=True):
                assert close(ours, theirs, 1e-12)


@pytest.mark.parametrize("group", [g for g in GROUPS if g.name != "R1"], ids=str)
@each_kind
@each_frame
@pytest.mark.parametrize("side", ["left", "right"])
def test_differentials_are_forward_mode(group, coordinates, frame, side):
    values, *rates = knots(group, seed=3)
    options = {"group": group, "times": TIMES, "coordinates": coordinates, "frame": frame}
    curve = HermiteSpline(values, *rates, **options)
    t, base = T[1:5:2], curve(T[1:5:2]).detach()
    found = curve.differentials(t, side)

    def outputs(delta, v, a):
        moved = group.retract(values, delta, side=side, validate=False)
        state = hermite(moved, v, a, t, validate=False, **options)
        if side == "left":
            step = group.compose(state.value, group.inverse(base, validate=False), validate=False)
        else:
            step = group.between(base, state.value, validate=False)
        state = to_world_frame(state, group) if frame == "world" else state
        return torch.stack([group.log(step, validate=False), *state[1:3]], dim=-2)

    blocks = torch.func.jacfwd(outputs, (0, 1, 2))(torch.zeros_like(rates[0]), *rates)
    for q, i in enumerate(found.segment.tolist()):
        for k, (source, end) in enumerate(itertools.product(range(3), range(2))):
            assert close(found.jacobian[q, :, k], blocks[source][q][:, :, i + end], 1e-10)
            elsewhere = [m for m in range(4) if m not in (i, i + 1)]
            assert blocks[source][q][:, :, elsewhere].abs().max() == 0


def test_differentials_in_batches():
    values, *rates = knots(SE3, batch=(2, 3))
    curve = HermiteSpline(values, *rates, group=SE3, times=TIMES)
    shared, own = curve.differentials(T), curve.differentials(T.expand(2, 3, 6))
    assert shared.jacobian.shape == (2, 3, 6, 3, 6, 6, 6)
    assert shared.segment.shape == (2, 3, 6)
    for i, j in itertools.product(range(2), range(3)):
        alone = HermiteSpline(values[i, j], *(x[i, j] for x in rates), group=SE3, times=TIMES).differentials(
            T
        )
        for found in (shared, own):
            assert close(found.jacobian[i, j], alone.jacobian, 1e-13)
            assert torch.equal(found.segment[i, j], alone.segment)


# ---------------------------------------------------------------------- gradients


@pytest.mark.parametrize(
    ("group", "coordinates", "frame"),
    [
        (SO3, "product", "body"),
        (SO3, "product", "world"),
        (SO3, "logarithm", "body"),
        (Group("SE2"), "logarithm", "world"),
        (SE3, "product", "body"),
    ],
    ids=str,
)
def test_gradients(group, coordinates, frame):
    """First and second derivatives by everything: knots, times of knots, queries."""
    given = [x.requires_grad_() for x in (*knots(group, count=3, seed=2), T[1:3].clone(), TIMES[:3].clone())]
    weights = None

    def total(values, velocities, accelerations, t, times):
        nonlocal weights
        state = hermite(
            values, velocities, accelerations, t,
            group=group, times=times, coordinates=coordinates, frame=frame, validate=False, derivatives=2,
        )  # fmt: skip
        fields = torch.cat(state[:3], dim=-1)
        weights = normal(*fields.shape, seed=9) if weights is None else weights
        return (fields * weights).sum()

    fast = {"fast_mode": True, "atol": 1e-5, "rtol": 1e-5}
    assert torch.autograd.gradcheck(total, given, check_forward_ad=True, **fast)
    if (group.name, frame) in (("SO3", "body"), ("SE2", "world")):  # one of each kind: these take seconds
        assert torch.autograd.gradgradcheck(total, given, eps=1e-5, **fast)


@each_group
@each_kind
def test_still_knots_have_finite_gradients(group, coordinates):
    """All knots the same and at rest: nothing turns, nothing is divided by."""
    values = group.identity(3).requires_grad_()
    rest = torch.zeros(3, group.tangent_size, dtype=float64).requires_grad_()
    fields = hermite(
        values, rest, rest, T[:3], group=group, times=TIMES[:3], coordinates=coordinates, derivatives=3
    )
    total = sum(((x + 0.3) ** 3).sum() for x in fields)
    first = torch.autograd.grad(total, (values, rest), create_graph=True)
    second = torch.autograd.grad(sum(g.square().sum() for g in first), (values, rest))
    assert all(torch.isfinite(g).all() for g in (*first, *second))


@each_kind
def test_transformations(coordinates):
    values, *rates = knots(SE3, batch=(5,), seed=4)
    options = {"group": SE3, "times": TIMES, "coordinates": coordinates, "derivatives": 2, "validate": False}

    def fields(values, velocities, accelerations):
        return torch.cat(hermite(values, velocities, accelerations, T[1:4], **options)[:3], dim=-1)

    mapped = torch.func.vmap(fields)(values, *rates)
    assert close(mapped, fields(values, *rates), 1e-13)
    inputs, directions = (values, *rates), [normal(*x.shape, seed=i) for i, x in enumerate((values, *rates))]
    out, forwards = torch.func.jvp(fields, inputs, tuple(directions))
    cotangent = normal(*out.shape, seed=8)
    backwards = torch.func.vjp(fields, *inputs)[1](cotangent)
    left, right = (
        (cotangent * forwards).sum(),
        sum((g * v).sum() for g, v in zip(backwards, directions, strict=True)),
    )
    assert abs(left - right) < 1e-11 * (1 + abs(left))
    hessian = torch.func.jacfwd(torch.func.jacrev(lambda v: fields(values[0], v, rates[1][0]).sin().sum()))(
        rates[0][0]
    )
    again = torch.func.jacrev(torch.func.jacrev(lambda v: fields(values[0], v, rates[1][0]).sin().sum()))(
        rates[0][0]
    )
    assert close(hessian, again, 1e-10)


@pytest.mark.contract(function="hermite ({coordinates})", regimes="general", properties="compile")
@pytest.mark.slow
@each_kind
def test_compiled_is_eager(coordinates):
    given = [x.requires_grad_() for x in (*knots(SO3), T.clone(), TIMES.clone())]

    def call(*given):
        *rows, t, times = given
        return torch.cat(hermite(*rows, t, group=SO3, times=times, coordinates=coordinates)[:3], dim=-1)

    torch.compiler.reset()
    eager, compiled = call(*given), torch.compile(call, fullgraph=True, backend="aot_eager")(*given)
    assert close(compiled, eager, 1e-13)
    for a, b in zip(*(torch.autograd.grad(y.sin().sum(), given) for y in (eager, compiled)), strict=True):
        assert close(a, b, 1e-12)


# ---------------------------------------------------------------------- shapes, precision, the module


@each_kind
def test_shapes(coordinates):
    values, *rates = knots(SE3, batch=(2, 3))
    for t, shape in (
        (T[1], (2, 3)),
        (T, (2, 3, 6)),
        (T.expand(2, 3, 6), (2, 3, 6)),
        (T.expand(3, 6), (2, 3, 6)),
    ):
        state = hermite(values, *rates, t, group=SE3, times=TIMES, coordinates=coordinates)
        assert state.value.shape == (*shape, 7)
        assert state.velocity.shape == state.acceleration.shape == (*shape, 6)
        assert state.jerk is None
        alone = hermite(
            values[1, 2], *(x[1, 2] for x in rates), T, group=SE3, times=TIMES, coordinates=coordinates
        )
        if t.ndim:
            assert all(close(a[1, 2], b, 1e-14) for a, b in zip(state[:3], alone, strict=False))
    single = hermite(values[0, 0], *(x[0, 0] for x in rates), T.reshape(2, 3), group=SE3, times=TIMES)
    assert single.value.shape == (2, 3, 7)


@each_kind
@kit.each_dtype
def test_precision(coordinates, dtype):
    given = [x.to(dtype) for x in knots(SE3)]
    state = hermite(*given, T.to(dtype)[1:5], group=SE3, times=TIMES, coordinates=coordinates, derivatives=3)
    exact = hermite(
        *(x.double() for x in given), T.to(dtype)[1:5].double(), group=SE3, times=TIMES, coordinates=coordinates,
        derivatives=3,
    )  # fmt: skip
    for ours, theirs in zip(state, exact, strict=True):
        assert ours.dtype == dtype
        assert error(ours, theirs) < 3000


def test_extrapolation():
    curve, outside = spline(SE3), torch.tensor([-0.8, 1.7, 2.1], dtype=float64)
    with pytest.raises(ValueError, match=r"t: 2 of 3 times lie outside the domain \[-0.4, 1.7\] s"):
        curve(outside)
    curve.extrapolate = "clamp"
    state, ends = curve.evaluate(outside), curve.evaluate(TIMES[[0, -1, -1]])
    assert close(state.value, ends.value, 1e-14)
    assert state.velocity[[0, 2]].abs().max() == 0
    assert close(state.velocity[1], ends.velocity[1], 1e-13)
    curve.extrapolate = "linear"
    state = curve.evaluate(outside)
    assert close(state.velocity, ends.velocity, 1e-13)
    drift = SE3.log(SE3.between(ends.value, state.value))
    assert close(drift, (outside - TIMES[[0, -1, -1]])[:, None] * ends.velocity, 1e-12)


def test_module():
    curve = spline(SE3)
    assert isinstance(curve, Trajectory)
    assert set(dict(curve.named_parameters())) == {"values", "velocities", "accelerations"}
    assert curve.domain == (-0.4, 1.7)
    single = spline(SE3).to(torch.float32)
    assert single.times.dtype == float64
    assert single.values.dtype == single(T).dtype == torch.float32
    other = spline(SE3, seed=5)
    other.load_state_dict(curve.state_dict())
    assert torch.equal(other(T), curve(T))
    leaf = knots(SE3)[1].requires_grad_()
    values, _, accelerations = knots(SE3)
    given = HermiteSpline(values, leaf, accelerations, group=SE3, times=TIMES, learnable=False)
    assert given.velocities is leaf
    assert list(given.parameters()) == []
    given(T).sum().backward()
    assert leaf.grad.abs().max() > 0
    motion = curve.kinematics(T)
    assert motion.rotation.shape == (6, 4)
    assert curve.mounted(SE3.random(generator=kit.generator(1))).kinematics(T).acceleration.shape == (6, 3)
