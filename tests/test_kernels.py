"""Compiled kernels against the reference: values and gradients, for every group, order, precision and clock."""

import copy
import pickle

import pytest
import torch
from batteries import FIXED, generator, normal, rescaled
from spline_cases import DT, GAPS, T0, configurations, control_points, exactly_pi_apart, number, sizes
from torch.autograd import forward_ad

import torchspline
from torchspline import BSpline
from torchspline.functional import bspline
from torchspline.groups import R3, SE3, SO3, Group
from torchspline.kernels.spline import SplineKernels

pytest.importorskip("numba")

float32, float64 = torch.float32, torch.float64
TOLERANCE = {float64: 1e-13, float32: 1e-5}
NANOSECONDS = {"dt_ns": 700_000_000, "t0_ns": 1_700_000_000_123_456_789}
CUBIC = {"group": SO3, "order": 4, "derivatives": 2}

#: Group, order, precision, derivatives, nanoseconds: kernels of their own, compiled in a few seconds when met first.
SOME = [
    (SO3, 4, float64, 2, False),
    (SO3, 4, float32, 2, False),
    (SO3, 2, float64, 0, False),
    (SO3, 3, float64, 3, True),
    (R3, 5, float32, 1, True),
    (Group("R3xSO3"), 2, float64, 2, False),
    (SE3, 3, float64, 2, False),
]
#: All orders on the two groups that most people use, few on the others: compiling takes seconds each.
_ORDERS = {
    **dict.fromkeys((g.name for g in FIXED), (2, 4)),
    **{"SO3": range(2, 9), "SE3": range(2, 9)},
    **{"R1": (2, 5), "R3": (4, 8), "R3xSO3": (3, 4, 6), "SO3xSE3": (2, 4)},
}
EVERY = [
    (Group(name), order, dtype, 2, False)
    for name, orders in _ORDERS.items()
    for order in orders
    for dtype in (float64, float32)
]
EVERY += [(SE3, 4, float64, 3, True), (SE3, 4, float32, 3, False), (SE3, 4, float32, 0, True)]


def spread(segments, *shape, ns=False, seed=0):
    """Times over all of the domain, both ends among them."""
    u = torch.rand(shape, generator=generator(seed), dtype=float64)
    if u.numel() > 2:
        u.view(-1)[:2] = torch.tensor([0.0, 1.0])
    if ns:
        return NANOSECONDS["t0_ns"] + (u * (segments * NANOSECONDS["dt_ns"])).long()
    return T0 + DT * segments * u


def outcome(mode, points, t, part=range(4), learnt=("control_points", "t", "t0", "dt"), **options):
    """Results, and gradients of a random loss of those in `part` by the `learnt` arguments."""
    given = NANOSECONDS if t.dtype == torch.int64 else {"t0": number(T0), "dt": number(DT)}
    given = {**CUBIC, **given, "control_points": points.detach(), "t": t.detach(), **options}
    wanted = [given[x].requires_grad_() for x in learnt if x in given and given[x].is_floating_point()]
    with torchspline.use_kernels(mode):
        fields = [x for x in bspline(**given) if x is not None]
        used = [x for i, x in enumerate(fields) if i in part and x.requires_grad]
        assert used or not wanted
        cotangents = [normal(*x.shape, seed=i, dtype=x.dtype) for i, x in enumerate(used)]
        grads = torch.autograd.grad(used, wanted, cotangents, allow_unused=True) if used else []
    return [x.detach() for x in fields], [torch.zeros(()) if g is None else g for g in grads]


def assert_same(points, t, group=SO3, **options):
    """Relative to the largest number of each result; gradients by quaternions relative to 1 / their length."""
    ours, theirs = (outcome(mode, points, t, group=group, **options) for mode in ("fused", "reference"))
    for i, (result, expected) in enumerate(zip(ours[0] + ours[1], theirs[0] + theirs[1], strict=True)):
        assert (result.shape, result.dtype) == (expected.shape, expected.dtype)
        if expected.numel() == 0:
            continue
        if i == len(ours[0]) and expected.shape == points.shape:
            result, expected = (x * sizes(group, points) for x in (result, expected))
        scale = expected.abs().max().clamp_min(1.0)
        if (
            expected.ndim == 0 and points.dtype == float32
        ):  # of t0 and dt: sums over all times, which may cancel
            scale = theirs[1][1].abs().clamp_min(1.0).sum()
        error = (result - expected).abs().max() / scale
        assert error <= TOLERANCE[points.dtype], f"output {i}: {error:.1e}"


@pytest.mark.parametrize(
    ("group", "order", "dtype", "derivatives", "ns"),
    [*SOME, *(pytest.param(*case, marks=pytest.mark.slow) for case in EVERY if case not in SOME)],
    ids=str,
)
def test_equals_the_reference(group, order, dtype, derivatives, ns):
    """Random control points and those that splines stumble over, each by itself."""
    sets = dict(zip(GAPS, configurations(group, order + 2, seed=order), strict=True))
    if dtype == float32:
        del sets["almost pi apart"]  # which it cannot tell from pi
    flipped = rescaled(group, control_points(group, order + 2), (1.0, -1.0, -1.0))
    for points in (*sets.values(), *exactly_pi_apart(group, order + 2)[::5], flipped):
        t = spread(3, 70, ns=ns, seed=order)
        assert_same(points.to(dtype), t, group=group, order=order, derivatives=derivatives)


#: Batch of control points: shape of times.
SHAPES = (
    ": :2,5 :2,3,0 :0 :1 :31 :32 :33 :64 :65 3:1 3:31 3:33 4: 4:4,5 4:1,33 4:4,0 1:4,5 "
    "0: 0:5 0:0,5 2,1:3,5 3:2,1,5 2,3:"
)


def stack(*batch, count=7):
    total = torch.Size(batch).numel()
    if count > 100:
        return SO3.random(*batch, count, generator=generator(total))
    rows = [control_points(SO3, count, seed=i) for i in range(max(total, 1))]
    return torch.stack(rows)[:total].reshape(*batch, count, 4)


@pytest.mark.parametrize("shapes", SHAPES.split())
def test_shapes(shapes):
    batch, times = ([int(n) for n in shape.split(",") if n] for shape in shapes.split(":"))
    assert_same(stack(*batch), spread(4, *times))


@pytest.mark.parametrize("points", [7, 3000])
@pytest.mark.parametrize("shapes", [((), (100_000,)), ((4,), (25_000,)), ((4,), (4, 25_000))], ids=str)
def test_many_queries(shapes, points):
    """So many that they are split, unsorted and sorted."""
    t = spread(points - 3, *shapes[1])
    for times in (t, t.sort(-1).values):
        assert_same(stack(*shapes[0], count=points), times)


def test_layouts():
    """Transposed, strided, offset, expanded, and lazily negated tensors."""
    points, t = stack(3), spread(4, 3, 9)
    fields, grads = outcome("fused", points, t)
    expected = fields + grads

    def layouts(x):
        yield x.mT.contiguous().mT
        yield torch.stack([x, x], dim=-1)[..., 0]
        yield torch.cat([x, x])[3:]
        yield x.flip(0).flip(0)
        yield torch.complex(x, -x).conj().imag

    for x, y in zip(layouts(points), layouts(t), strict=True):
        results = outcome("fused", x, y)
        assert all(torch.equal(a, b) for a, b in zip(results[0] + results[1], expected, strict=True))
    assert_same(points[:1].expand(3, -1, -1), t[:1].expand(3, -1))
    assert_same(points[0, :1].expand(7, -1), t[0, :1].expand(40))


# ---------------------------------------------------------------------- autograd


@pytest.mark.parametrize("part", [[0], [1], [2], [0, 2]], ids=str)
@pytest.mark.parametrize("learnt", ["control_points t t0 dt", "control_points", "t", "t0", "dt", "t dt"])
def test_some_results_and_some_arguments(part, learnt):
    assert_same(stack(2), spread(4, 9), part=part, learnt=learnt.split())


def test_nothing_to_learn():
    assert_same(stack(2), spread(4, 9), learnt=[])
    with torch.inference_mode():
        assert_same(stack(2), spread(4, 9), learnt=[])


def fused(points, t, dt, t0):
    with torchspline.use_kernels("fused"):
        return torch.cat(bspline(points, t, dt=dt, t0=t0, **CUBIC)[:3], dim=-1)


def arguments():
    t = T0 + DT * torch.tensor([0.13, 0.5, 1.71], dtype=float64)
    return [x.requires_grad_() for x in (stack(count=5), t, number(DT), number(T0))]


def test_higher_derivatives():
    given = arguments()
    assert torch.autograd.gradcheck(fused, given)
    assert torch.autograd.gradgradcheck(fused, given)
    assert torch.autograd.gradgradcheck(lambda x: fused(x, *(y.detach() for y in given[1:])), given[:1])


def test_higher_derivatives_of_arguments_that_depend_on_each_other():
    """Times computed from t0 and dt: what reaches those by way of the times is counted once."""
    results = []
    for mode in ("fused", "reference"):
        points, _, dt, t0 = arguments()
        t = t0 + dt * torch.tensor([0.1, 0.7, 1.9], dtype=float64)
        with torchspline.use_kernels(mode):
            state = bspline(points * dt, t, dt=dt, t0=t0, **CUBIC)
            first = torch.autograd.grad(state.velocity.square().sum(), (points, dt, t0), create_graph=True)
            second = torch.autograd.grad(sum(g.square().sum() for g in first), (points, dt, t0))
        results.append((*first, *second))
    assert all(torch.allclose(a, b, rtol=1e-11, atol=1e-11) for a, b in zip(*results, strict=True))


def test_batched_cotangents():
    given = arguments()
    out = fused(*given)
    g = normal(4, *out.shape, seed=3)
    batched = torch.autograd.grad(out, given, g, is_grads_batched=True, retain_graph=True)
    each = [torch.autograd.grad(out, given, row, retain_graph=True) for row in g]
    for ours, theirs in zip(batched, zip(*each, strict=True), strict=True):
        assert torch.allclose(ours, torch.stack(theirs), rtol=1e-12, atol=1e-12)
    jacobian = torch.autograd.functional.jacobian(fused, tuple(given), vectorize=True)[0]
    assert torch.allclose(torch.einsum("bij,ij...->b...", g, jacobian), batched[0], rtol=1e-12, atol=1e-12)


def test_a_graph_is_used_twice():
    points, *others = arguments()
    out = fused(points, *others).square().sum()
    assert torch.equal(*(torch.autograd.grad(out, points, retain_graph=again)[0] for again in (True, False)))
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(out, points)


@pytest.mark.parametrize("changed", range(4))
def test_arguments_changed_before_the_backward_pass(changed):
    given = [x * 1.0 for x in arguments()]
    out = fused(*given).sum()
    with torch.no_grad():
        given[changed].mul_(1.01)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.backward()


@pytest.mark.parametrize("field", ["value", "velocity", "acceleration"])
def test_results_changed_before_the_backward_pass(field):
    """Gravity is often added to an acceleration in place: allowed as with the reference."""
    results = []
    for mode in ("fused", "reference"):
        points, t, dt, t0 = arguments()
        with torchspline.use_kernels(mode):
            state = bspline(points, t, dt=dt, t0=t0, **CUBIC)
            getattr(state, field).mul_(3.0)
            results.append(torch.autograd.grad(sum(x.sum() for x in state[:3]), (points, t, dt, t0)))
    assert all(torch.allclose(a, b, rtol=1e-12, atol=1e-12) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("use_reentrant", [True, False])
def test_checkpoints_and_hooks(use_reentrant):
    given = arguments()
    expected = torch.autograd.grad(fused(*given).square().sum(), given)
    torch.utils.checkpoint.checkpoint(fused, *given, use_reentrant=use_reentrant).square().sum().backward()
    assert all(map(torch.equal, (x.grad for x in given), expected))
    with torch.autograd.graph.save_on_cpu():
        stored = fused(*given).square().sum()
    assert all(map(torch.equal, torch.autograd.grad(stored, given), expected))


TRANSFORMS = {
    "vmap": lambda f, x: torch.vmap(f)(x),
    "grad": lambda f, x: torch.func.grad(lambda x: f(x).sum())(x),
    "jacrev": lambda f, x: torch.func.jacrev(f)(x),
    "jacfwd": lambda f, x: torch.func.jacfwd(f)(x),
    "hessian": lambda f, x: torch.func.hessian(lambda x: f(x).square().sum())(x[0]),
    "jvp": lambda f, x: torch.func.jvp(f, (x,), (x.cos(),))[1],
    "vjp": lambda f, x: torch.func.vjp(f, x)[1](normal(2, 3, 10, seed=0))[0],
    "forward mode": lambda f, x: forward_mode(f, x),
}


def forward_mode(f, x):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(f(forward_ad.make_dual(x, x.cos()))).tangent


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_transforms_use_the_reference(transform):
    points, t = stack(2, count=5), spread(2, 3)

    def function(x):
        return torch.cat(bspline(x, t, dt=DT, t0=T0, **CUBIC)[:3], dim=-1)

    def result(mode):
        with torchspline.use_kernels(mode):
            return TRANSFORMS[transform](function, points)

    assert torch.equal(result("auto"), result("reference"))
    with pytest.raises(RuntimeError, match="no kernel serves this call"):
        result("fused")


@pytest.fixture
def launched(monkeypatch):
    """Names of the kernels that are used."""
    names = []
    for kind in ("forward", "reverse"):
        method = getattr(SplineKernels, kind)
        monkeypatch.setattr(
            SplineKernels,
            kind,
            lambda self, *a, kind=kind, method=method: (
                names.append((kind, self.nanoseconds)),
                method(self, *a),
            )[1],
        )
    return names


@pytest.mark.parametrize("clock", ["seconds", "nanoseconds"])
@pytest.mark.parametrize("extrapolate", ["error", "linear"])
def test_compiled_graphs_use_kernels(launched, clock, extrapolate):
    """Their operators do, at places in segments, and agree with eager calls."""
    points, t, dt, t0 = (
        x.detach().requires_grad_() for x in (stack(2), spread(4, 40), number(DT), number(T0))
    )
    options, wanted = {"dt": dt, "t0": t0}, (points, t, dt, t0)
    if clock == "nanoseconds":
        options, wanted, t = NANOSECONDS, (points,), spread(4, 40, ns=True)
    if extrapolate == "linear":
        t = (t + (t - t.min())).detach().requires_grad_(clock == "seconds")
        wanted = wanted if clock == "nanoseconds" else (points, t, dt, t0)

    def function(points, t):
        return torch.cat(bspline(points, t, extrapolate=extrapolate, **options, **CUBIC)[:3], dim=-1)

    def outcome(function):
        result = function(points, t)
        return result, *torch.autograd.grad(result, wanted, normal(*result.shape, seed=0))

    torch.compiler.reset()
    with torchspline.use_kernels("fused"):
        ours = outcome(torch.compile(function, fullgraph=True, backend="aot_eager"))
    assert ("reverse", None) in launched
    launched.clear()
    with torchspline.use_kernels("reference"):
        theirs = outcome(torch.compile(function, fullgraph=True, backend="aot_eager"))
        eager = outcome(function)
    assert not launched
    assert all(map(torch.allclose, ours, theirs, [1e-13] * 5, [1e-13] * 5))
    assert all(map(torch.allclose, ours, eager, [1e-13] * 5, [1e-13] * 5))


@pytest.mark.parametrize(
    ("group", "order", "dtype"),
    [(SO3, 4, float64), pytest.param(SE3, 5, float32, marks=pytest.mark.slow)],
    ids=str,
)
def test_places_equal_the_reference(launched, group, order, dtype):
    """Times outside are served by the kernels that take places; sums over chunks, shared times and each its own."""
    points = torch.stack([control_points(group, 9, seed=i) for i in range(2)]).to(dtype)
    for t in (spread(9 - order + 1, 40_000), spread(9 - order + 1, 2, 17), spread(9 - order + 1, 2, 20_000)):
        t.view(-1)[:2] = torch.tensor([T0 - 1.0, T0 + 7.0])
        assert_same(points, t, group=group, order=order, extrapolate="linear", learnt=["control_points", "t"])
    assert {("forward", None), ("reverse", None)} <= set(launched)


WRONG = (float("nan"), float("inf"), -float("inf"), T0 - 1e-3 * DT, T0 + 4.001 * DT, 1e300)


def message(mode, points, t, **options):
    with torchspline.use_kernels(mode), pytest.raises((ValueError, TypeError)) as caught:
        bspline(points, t, **{"dt": DT, "t0": T0, **CUBIC, **options})
    return caught.type, str(caught.value)


@pytest.mark.parametrize("batch", [(), (2,)])
def test_the_same_errors(batch):
    points, t = stack(*batch), spread(4, 5)
    late = [t.index_fill(0, torch.tensor(3), wrong) for wrong in WRONG]
    cases = [(points, x, {}) for x in late]
    for factor, row in ((float("nan"), 0), (float("inf"), 6), (0.0, 3), (1e-16, 2), (1e16, 2)):
        bad = points.clone()
        bad[(-1,) * len(batch) + (row,)] *= factor
        cases += [(bad, t, {}), (bad, late[0], {}), (bad.float(), late[3], {})]
    cases.append((points, t.float() + 1e6, {"t0": 1e6 + T0}))
    cases.append((points, spread(4, 5, ns=True) + 9 * 10**9, {"dt": None, "t0": 0.0, **NANOSECONDS}))
    for x, y, options in cases:
        assert message("fused", x, y, **options) == message("reference", x, y, **options)


@pytest.mark.parametrize("kind", ["seconds", "nanoseconds"])
def test_unchecked_times_touch_no_foreign_memory(kind):
    """Without checks results are undefined, but nothing is read or written outside the arrays."""
    points, t = stack(count=400).requires_grad_(), spread(397, 100_000, ns=kind == "nanoseconds")
    knots, wild = NANOSECONDS, [0, 2**63 - 1, -(2**63), 1]
    if kind == "seconds":
        knots, wild = {"dt": DT, "t0": T0}, [0.0, -1e300, 1e300, float("inf"), float("nan"), 1e18]
    for x in wild:
        t[torch.randperm(len(t), generator=generator(1))[:30]] = x
        with torchspline.use_kernels("fused"):
            out = bspline(points, t, validate=False, **knots, **CUBIC).velocity
            assert torch.autograd.grad(out.sum(), points)[0].shape == points.shape


def test_epochs_with_a_spacing_below_their_rounding():
    """At 1.7e18 ns float64 counts in steps of 256; knots here are 10 ns apart."""
    t = torch.randint(0, 29_970, (100_000,), generator=generator(0)).sort().values + NANOSECONDS["t0_ns"]
    assert_same(stack(count=3000), t, dt_ns=10)


def test_modules_are_copied_and_pickled_after_use():
    spline = BSpline(stack(), group=SO3, dt=DT, t0=T0)
    t = spread(4, 9)
    with torchspline.use_kernels("fused"):
        expected = spline.evaluate(t)
        expected.velocity.sum().backward()
        for other in (copy.deepcopy(spline), pickle.loads(pickle.dumps(spline))):
            assert all(torch.equal(a, b) for a, b in zip(other.evaluate(t)[:3], expected[:3], strict=True))


def test_modes():
    points, t = stack(), spread(4, 9)
    assert all(map(torch.equal, *(outcome(mode, points, t)[0] for mode in ("auto", "fused"))))
    with pytest.raises(ValueError, match="mode: expected one of 'auto', 'fused', 'reference', got 'fast'"):
        torchspline.use_kernels("fast").__enter__()
    with torchspline.use_kernels("fused"):  # extrapolation is the reference's business
        outside = bspline(points, t + 9.0, dt=DT, t0=T0, extrapolate="clamp", **CUBIC)
    assert torch.isfinite(outside.value).all()
