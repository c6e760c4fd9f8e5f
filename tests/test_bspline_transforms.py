"""The spline under `vmap`, `torch.compile` and autograd's batched modes, on tensors of any layout and origin."""

import itertools

import pytest
import torch
from batteries import GROUPS, generator, normal
from spline_cases import DT, T0, close, control_points, fields, number, times
from torch.utils._pytree import tree_leaves

import torchspline
from torchspline.functional import bspline
from torchspline.groups import SE3, SO3, Group

TRANSFORMED = [SO3, SE3, Group("R3xSO3")]


@pytest.mark.parametrize("group", TRANSFORMED, ids=str)
@pytest.mark.parametrize("order", [2, 4])
def test_vmap_is_a_loop(group, order):
    points = torch.stack([control_points(group, order + 1, seed=i) for i in range(3)])
    t, many = times((3,)), number([0.7, 0.8, 1.1])
    function = fields(group, order)
    for mapped in itertools.product((None, 0), repeat=4):
        if mapped == (None,) * 4:
            continue
        stacks = (points, t, many, T0 - 0.1 * (many - DT))
        given = [x if d == 0 else x[0] for x, d in zip(stacks, mapped, strict=True)]
        loop = [
            function(*(x[i] if d == 0 else x for x, d in zip(given, mapped, strict=True))) for i in range(3)
        ]
        assert close(torch.vmap(function, in_dims=mapped)(*given), torch.stack(loop), 1e-14)
    nested = torch.vmap(torch.vmap(function, in_dims=(None, 0)), in_dims=(0, None))(points, t[0])
    assert close(nested, torch.stack([function(x, t[0]) for x in points]), 1e-14)


@pytest.mark.parametrize("group", TRANSFORMED, ids=str)
def test_gradients_under_vmap(group):
    """Gradients, Jacobian products and Hessians under vmap, vmap under grad, and batched cotangents."""
    points = torch.stack([control_points(group, 5, seed=i) for i in range(3)])
    t = times((3,))
    function = fields(group, 4, validate=False)

    def loss(x, t):
        return function(x, t).square().sum()

    for transform in (torch.func.grad, lambda f, argnums: torch.func.hessian(f, argnums=argnums)):
        derivative = transform(loss, argnums=(0, 1))
        mapped = tree_leaves(torch.vmap(derivative)(points, t))
        loop = [tree_leaves(derivative(x, y)) for x, y in zip(points, t, strict=True)]
        for result, rows in zip(mapped, zip(*loop, strict=True), strict=True):
            assert close(result, torch.stack(rows), 1e-13)
    whole = torch.func.grad(lambda x: torch.vmap(loss)(x, t).sum())(points)
    assert close(
        whole, torch.stack([torch.func.grad(loss)(x, y) for x, y in zip(points, t, strict=True)]), 1e-13
    )
    rate = normal(*points.shape, seed=4)
    moved = torch.vmap(lambda x, v, y: torch.func.jvp(lambda z: function(z, y), (x,), (v,))[1])(
        points, rate, t
    )
    each = [
        torch.func.jvp(lambda z, y=y: function(z, y), (x,), (v,))[1]
        for x, v, y in zip(points, rate, t, strict=True)
    ]
    assert close(moved, torch.stack(each), 1e-13)

    x = points.clone().requires_grad_()
    out = function(x, t)
    g = normal(4, *out.shape, seed=3)
    (batched,) = torch.autograd.grad(out, x, g, is_grads_batched=True, retain_graph=True)
    assert close(
        batched, torch.stack([torch.autograd.grad(out, x, y, retain_graph=True)[0] for y in g]), 1e-13
    )


@pytest.mark.parametrize("group", TRANSFORMED, ids=str)
@pytest.mark.parametrize("clock", ["seconds", "nanoseconds"])
def test_compiled_is_eager(group, clock):
    """`torch.compile(fullgraph=True)` of function and module, with gradients to everything given."""
    points = control_points(group, 6).requires_grad_()
    dt, t0, t = number(DT).requires_grad_(), number(T0).requires_grad_(), times().requires_grad_()
    if clock == "nanoseconds":
        options, t = {"dt_ns": 700_000_000, "t0_ns": -300_000_000}, (times() * 1e9).long()
        wanted = (points,)
    else:
        options, wanted = {"dt": dt, "t0": t0}, (points, t, dt, t0)
    module = torchspline.BSpline(points, group=group, **options)
    beyond = torchspline.BSpline(points, group=group, extrapolate="linear", **options)

    def run(points, t, options):
        return tuple(bspline(points, t, group=group, derivatives=3, **options))

    for eager in (
        lambda: run(points, t, options),
        lambda: tuple(module.evaluate(t, 3)),
        lambda: (module(t), beyond(2 * t)),
    ):
        torch.compiler.reset()
        compiled = torch.compile(eager, fullgraph=True, backend="aot_eager")
        expected, results = eager(), compiled()
        g = [normal(*x.shape, seed=i) for i, x in enumerate(expected)]
        assert all(close(a, b, 1e-14) for a, b in zip(results, expected, strict=True))
        theirs, ours = (torch.autograd.grad(out, wanted, g) for out in (expected, results))
        assert all(close(a, b, 1e-14) for a, b in zip(ours, theirs, strict=True))


# ---------------------------------------------------------------------- tensors of any layout


def layouts(x):
    yield x.mT.contiguous().mT
    yield torch.stack([x, x], dim=-1)[..., 0]
    yield torch.cat([x, x]).view(2, *x.shape)[1]
    yield x.flip(0).flip(0)


@pytest.mark.parametrize("group", GROUPS, ids=str)
def test_layout_does_not_matter_and_nothing_is_modified(group):
    points, t = torch.stack([control_points(group, 6, seed=i) for i in range(2)]), times((2,))
    function = fields(group, 4)

    def gradients(points, t):
        leaf = (points.detach().clone().requires_grad_(), t.detach().clone().requires_grad_())
        out = function(*leaf)
        return out, *torch.autograd.grad(out.square().sum(), leaf)

    expected = gradients(points, t)
    for x, y in zip(layouts(points), layouts(t), strict=True):
        assert torch.equal(x, points)
        x, y = x.requires_grad_(), y.requires_grad_()
        versions, copies = (x._version, y._version), (x.detach().clone(), y.detach().clone())
        out = function(x, y)
        grads = torch.autograd.grad(out.square().sum(), (x, y), create_graph=True)
        torch.autograd.grad(sum(g.sum() for g in grads), (x, y))
        assert (x._version, y._version) == versions
        assert torch.equal(x, copies[0])
        assert torch.equal(y, copies[1])
        for ours, theirs in zip((out, *grads), expected, strict=True):
            assert torch.equal(ours, theirs)


def test_views_and_expanded_tensors_that_require_grad():
    """Gradients reach the leaf behind a view; an expanded dimension sums."""
    leaf = control_points(SE3, 12).requires_grad_()
    function = fields(SE3, 4)
    (gradient,) = torch.autograd.grad(function(leaf[::2], times()).sum(), leaf)
    alone = leaf.detach()[::2].clone().requires_grad_()
    (expected,) = torch.autograd.grad(function(alone, times()).sum(), alone)
    assert torch.equal(gradient[::2], expected)
    assert torch.all(gradient[1::2] == 0)
    point = SE3.random(generator=generator(1)).requires_grad_()
    (gradient,) = torch.autograd.grad(function(point.expand(2, 5, 7), times()).square().sum(), point)
    stacked = point.detach().expand(2, 5, 7).clone().requires_grad_()
    (expected,) = torch.autograd.grad(function(stacked, times()).square().sum(), stacked)
    assert close(gradient, expected.sum((0, 1)), 1e-13)
    time = number(0.2).requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf, time.expand(3)).sum(), time)
    (expected,) = torch.autograd.grad(function(leaf, time).sum(), time)
    assert close(gradient, 3 * expected, 1e-13)


@pytest.mark.parametrize("default", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_default_dtype_does_not_matter(default, dtype):
    points, t = control_points(SE3, 6).to(dtype), times()
    for extrapolate in ("error", "clamp", "linear"):
        results = []
        for chosen in (torch.float32, default):
            before = torch.get_default_dtype()
            torch.set_default_dtype(chosen)
            try:
                x, y = points.clone().requires_grad_(), t.clone().requires_grad_()
                out = fields(SE3, 4, extrapolate=extrapolate)(x, y)
                rate = torch.func.jvp(lambda x: fields(SE3, 4)(x, t), (points,), (torch.ones_like(points),))[
                    1
                ]
                results.append((out, rate, *torch.autograd.grad(out.sum(), (x, y))))
            finally:
                torch.set_default_dtype(before)
        for ours, theirs in zip(*results, strict=True):
            assert ours.dtype == theirs.dtype
            assert torch.equal(ours, theirs)
        assert [x.dtype for x in results[1]] == [dtype, dtype, dtype, torch.float64]
