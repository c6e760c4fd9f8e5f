"""The Triton kernels against the reference, through Triton's interpreter, and what its compiler makes of them."""

import itertools
import re
import sys

import pytest
import torch
from batteries import generator, normal
from spline_cases import (
    DT,
    GAPS,
    T0,
    close,
    configurations,
    control_points,
    exactly_pi_apart,
    fields,
    number,
    sizes,
)

from torchspline import use_kernels
from torchspline.functional import bspline
from torchspline.groups import R3, SE3, SO3, Group
from torchspline.kernels import mode, triton
from torchspline.splines import bspline as bspline_module
from torchspline.splines import fused, sweep

float32, float64 = torch.float32, torch.float64
TOLERANCE = {float64: 1e-13, float32: 1e-5}
CPU = torch.device("cpu")
SPLIT = Group("R3xSO3")

#: Group, order, precision, derivatives.
CASES = [
    (SO3, 2, float64, 0),
    (SO3, 4, float64, 2),
    (SO3, 4, float32, 2),
    (SO3, 6, float64, 3),
    (SE3, 3, float64, 2),
    (SE3, 4, float32, 1),
    (SPLIT, 2, float32, 1),
    (SPLIT, 5, float64, 3),
    (R3, 4, float64, 2),
]


@pytest.fixture
def interpreter(monkeypatch):
    """Kernels made meanwhile run on the CPU, operation by operation."""
    pytest.importorskip("triton", reason="Triton is not installed: pip install -e '.[triton]'")
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    monkeypatch.setattr(fused, "triton_kernels_of", make)


make = fused.triton_kernels_of.__wrapped__  # not kept from test to test: interpreted or not is decided once


def kernels_of(group, order, derivatives, dtype):
    return make(group.name, order, derivatives, dtype)


def assert_same(results, expected, scales=None):
    for i, (ours, theirs) in enumerate(zip(results, expected, strict=True)):
        assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype)
        if scales is not None and i == 0:
            ours, theirs = ours * scales, theirs * scales
        assert close(ours, theirs, TOLERANCE[ours.dtype]), f"output {i}: {(ours - theirs).abs().max():.1e}"


@pytest.mark.parametrize(("group", "order", "dtype", "derivatives"), CASES, ids=str)
def test_equals_the_reference(interpreter, group, order, dtype, derivatives):
    """Ordinary control points and those that splines stumble over, as one batch; a block that is not full."""
    points = configurations(group, order + 2, seed=order)
    if dtype == float32:
        points = points[[name != "almost pi apart" for name in GAPS]]  # which it cannot tell from pi
    points = torch.cat([points, exactly_pi_apart(group, order + 2)[::5]]).to(dtype)
    shape = (15,) if order % 2 == 0 else (len(points), 15)  # times of the batch, or each its own
    assert triton.BLOCK < 15 * len(points) < 2 * triton.BLOCK
    u = torch.rand(shape, generator=generator(order), dtype=float64).to(dtype)
    u.view(-1)[:2] = torch.tensor([0.0, 1.0])
    index = torch.randint(0, 3, shape, generator=generator(order))
    kernels = kernels_of(group, order, derivatives, dtype)
    arguments = group.name, order, derivatives
    expected = sweep._forward(points, u, index, *arguments)
    assert_same(kernels.forward(points, u, index), expected)

    cotangents = [normal(*x.shape, seed=i, dtype=dtype) for i, x in enumerate(expected)]
    cotangents[-1] = None if derivatives > 1 else cotangents[-1]
    reverse = sweep._reverse(points, u, index, group.name, order, tuple(cotangents), True)
    assert_same(kernels.reverse(points, u, index, cotangents), reverse, sizes(group, points))


def test_no_queries_and_strided_tensors(interpreter):
    kernels = kernels_of(SO3, 3, 1, float64)
    points = configurations(SO3, 5).mT.contiguous().mT
    u, index = (torch.stack([x, x], -1)[:, 0] for x in (torch.rand(9, dtype=float64), torch.arange(9) % 3))
    cotangents = [normal(len(points), size, 9, seed=0).mT for size in (4, 3)]
    assert not points.is_contiguous()
    assert_same(kernels.forward(points, u, index), sweep._forward(points, u, index, "SO3", 3, 1))
    reverse = sweep._reverse(points, u, index, "SO3", 3, tuple(cotangents), True)
    assert_same(kernels.reverse(points, u, index, cotangents), reverse, sizes(SO3, points))
    none = kernels.reverse(points, u[:0], index[:0], [None, None])
    assert torch.equal(none[0], torch.zeros_like(points))
    assert none[1].shape == (0,)
    assert [x.shape for x in kernels.forward(points[:0], u, index)] == [(0, 9, 4), (0, 9, 3)]


# ---------------------------------------------------------------------- dispatch


@pytest.fixture
def dispatched(interpreter, monkeypatch):
    """CPU tensors are served as CUDA tensors are; counts the launches."""
    launched = []
    call = triton.TritonKernel.__call__
    monkeypatch.setattr(
        triton.TritonKernel,
        "__call__",
        lambda self, *a, **b: (launched.append(self.name), call(self, *a, **b)),
    )
    monkeypatch.setattr(mode, "current", lambda: "auto")
    monkeypatch.setattr(fused, "current", lambda: "auto")
    monkeypatch.setattr(bspline_module, "usable", lambda *_: False)
    monkeypatch.setattr(fused, "triton_available", triton.available.__wrapped__)
    monkeypatch.setitem(fused.ENGINES, "cpu", fused.ENGINES["cuda"])
    return launched


def arguments(ns=False):
    points = configurations(SO3, 5)[-2:].contiguous().requires_grad_()
    t = torch.tensor([[0.01, 0.13, 0.5, 1.99], [0.3, 1.4, 0.8, 1.1]], dtype=float64)
    if ns:
        return [points, 1_700_000_000_123_456_789 + (t * 7e8).long()]
    return [points, (T0 + DT * t).requires_grad_(), number(DT).requires_grad_(), number(T0).requires_grad_()]


@pytest.mark.parametrize("extrapolate", ["error", "clamp", "linear"])
@pytest.mark.parametrize("clock", ["seconds", "nanoseconds"])
def test_calls_are_served(dispatched, monkeypatch, extrapolate, clock):
    points, t, *knots = arguments(clock == "nanoseconds")
    options = {"dt_ns": 700_000_000, "t0_ns": 1_700_000_000_123_456_789}
    options = dict(zip(("dt", "t0"), knots, strict=True)) if knots else options
    if extrapolate != "error":
        t = t + (t - t.min())

    def outcome():
        state = bspline(points, t, group=SO3, order=4, extrapolate=extrapolate, **options)
        wanted = [points, *knots, *([t] if knots else [])]
        cotangents = [normal(*x.shape, seed=i) for i, x in enumerate(state[:3])]
        return [x.detach() for x in state[:3]], torch.autograd.grad(state[:3], wanted, cotangents)

    ours = outcome()
    assert {name.partition("_")[0] for name in dispatched} >= {"forward", "reverse", "pairs", "embed"}
    dispatched.clear()
    monkeypatch.setattr(fused, "current", lambda: "reference")
    theirs = outcome()
    assert not dispatched
    for a, b in zip(itertools.chain(*ours), itertools.chain(*theirs), strict=True):
        assert close(a, b, 1e-13)


def test_transforms_and_higher_derivatives(dispatched, monkeypatch):
    """Through the reference, or through kernels below it; the gradient of a gradient is one of tensor operations."""
    _, _, *knots = arguments()
    t = (T0 + DT * number([0.13, 1.9])).requires_grad_()
    given = [control_points(SO3, 3).requires_grad_(), t, *knots]
    function = fields(SO3, 2, derivatives=1)

    def outcomes():
        gradient = torch.autograd.grad(function(*given).square().sum(), given, create_graph=True)
        yield from torch.autograd.grad(sum(g.square().sum() for g in gradient), given)
        stack = torch.stack([given[0].detach(), 2.0 * given[0].detach()])
        yield torch.vmap(lambda x: function(x, t))(stack)
        yield torch.func.jvp(lambda x: function(x, t), (given[0],), (stack[0].cos(),))[1]
        yield torch.func.jacrev(lambda x: function(x, t.detach()))(given[0].detach())
        out = function(*given)
        yield from torch.autograd.grad(out, given, normal(3, *out.shape, seed=0), is_grads_batched=True)

    ours = list(outcomes())
    assert dispatched
    monkeypatch.setattr(fused, "current", lambda: "reference")
    assert all(close(a, b, 1e-12) for a, b in zip(ours, outcomes(), strict=True))


def test_without_triton(monkeypatch):
    for name in [x for x in sys.modules if x.partition(".")[0] == "triton"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "triton", None)
    assert triton.available.__wrapped__(CPU) is False


def test_a_triton_that_cannot_compile(monkeypatch):
    """Such as one without a GPU, which has no driver to launch with."""
    pytest.importorskip("triton", reason="Triton is not installed: pip install -e '.[triton]'")
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    if torch.cuda.is_available():
        pytest.skip("there is a GPU here")
    with pytest.warns(RuntimeWarning, match="kernels for cpu are off, it runs the slower reference"):
        assert triton.available.__wrapped__(CPU) is False


def test_modes(monkeypatch):
    """On a GPU without Triton "fused" is an error, and with it "reference" has the last word."""
    x = torch.zeros(2, device="meta")
    monkeypatch.setattr(mode, "triton_available", lambda device: device.type == "meta")
    with use_kernels("fused"):
        assert not mode.usable(x)
        with pytest.raises(RuntimeError, match="Triton on a GPU"), torch.inference_mode():
            torch.vmap(lambda y: mode.usable(x) or y)(torch.zeros(2))
    monkeypatch.setattr(mode, "triton_available", lambda device: False)
    with use_kernels("fused"), pytest.raises(RuntimeError, match="Triton on a GPU"):
        mode.usable(x)
    with use_kernels("reference"):
        assert fused.placed_kernels(torch.zeros(4, 4), torch.zeros(1), torch.zeros(1), "SO3", 4, 2) is None


# ---------------------------------------------------------------------- the compiler


@pytest.mark.parametrize("dtype", [float32, float64], ids=str)
def test_machine_code_keeps_the_precision(monkeypatch, dtype):
    """Compiled for a GPU that need not be there: no literal widens float32 or narrows float64, and logarithms are not
    taken of contracted products."""
    compiler = pytest.importorskip("triton", reason="Triton is not installed: pip install -e '.[triton]'")
    from triton.backends.compiler import GPUTarget

    monkeypatch.setenv("TRITON_INTERPRET", "0")
    spline = kernels_of(SO3, 4, 2, dtype)
    pointer, other = ("*fp32", "f64") if dtype == float32 else ("*fp64", "f32")
    for kernel in (spline._pairs, spline._forward, spline._reverse, spline._pairs_reverse, spline._embed):
        function = kernel._function
        types = dict.fromkeys(function.arg_names, pointer) | {"rows": "i32", "BLOCK": "constexpr"}
        if "at" in types:
            types["at"] = "*i64"
        source = compiler.compiler.ASTSource(function, types, {"BLOCK": triton.BLOCK})
        options = {"enable_fp_fusion": kernel.fusion}
        made = compiler.compile(source, target=GPUTarget("cuda", 80, 32), options=options).asm["ptx"]
        arithmetic = re.findall(r"^\s*(?:@\S+ )?((?:add|sub|mul|fma|div|sqrt|neg|cvt)\.[\w.]+)", made, re.M)
        assert arithmetic
        assert not [x for x in arithmetic if other in x]
        assert any(x.startswith("fma") for x in arithmetic) == kernel.fusion
        assert not [x for x in arithmetic if "approx" in x or "full" in x]


@pytest.mark.parametrize("which", ["forward_source", "reverse_source"])
def test_sources_are_python(which):
    for group, dtype in itertools.product((SO3, SE3, SPLIT, R3), (float32, float64)):
        source = getattr(kernels_of(group, 4, 3, dtype), which)()
        compile(source, "shown", "exec")
        others = "tl.float64" if dtype == float32 else "tl.float32"
        assert others not in source
