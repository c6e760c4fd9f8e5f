"""Compiled loops of keyframe schemes: what they serve equals the reference, and what they do not know goes there."""

import batteries as kit
import pytest
import torch
from spline_cases import close
from test_interpolation import UNEVEN, group_of, keyframes

import torchspline
from torchspline import SO3, HermiteSpline, NonuniformBSpline
from torchspline.functional import interpolate
from torchspline.kernels.curve import CurveKernel
from torchspline.splines.interpolation import SCHEMES
from torchspline.splines.interpolation.scheme import curve_kernel
from torchspline.splines.located import located_kernel

float64 = torch.float64


@pytest.mark.parametrize(
    ("name", "derivatives"), [("QLB", 2), ("DLFus", 0), ("SQUAD", 0), ("SLERP", 2), ("CuBsp", 0)], ids=str
)
@kit.each_dtype
def test_kernels_equal_the_reference(name, derivatives, dtype):
    """Values, rates, gradients and gradients of gradients on as many queries as kernels are compiled for."""
    pytest.importorskip("numba")
    group, results = group_of(name), []
    t = torch.linspace(-1.0, 5.0, 5001, dtype=float64)
    for mode in ("auto", "reference"):
        keys = group.normalize(keyframes(group)).to(dtype).requires_grad_()
        with torchspline.use_kernels(mode):
            state = interpolate(name, keys, UNEVEN, t, derivatives)
            fields = torch.cat(state[: derivatives + 1], dim=-1)
            loss = (fields * torch.linspace(0, 1, 5001, dtype=dtype)[:, None]).square().mean()
            (gradient,) = torch.autograd.grad(loss, keys, create_graph=True)
            (second,) = torch.autograd.grad(gradient.square().sum(), keys)
        results.append((fields, gradient, second))
    for ours, theirs in zip(*results, strict=True):
        assert close(ours, theirs, 1e-12 if dtype == float64 else 2e-4)


@pytest.mark.parametrize(
    ("name", "derivatives"), [("LERP", 2), ("QLB+LERP", 1), ("DLB", 0), ("SLERP", 2), ("CuBsp", 1)], ids=str
)
def test_one_loop_for_one_curve(name, derivatives, monkeypatch):
    """Without gradients, times in any order, at keys, at both ends and a rounding beyond: the same as the reference."""
    pytest.importorskip("numba")
    group = group_of(name)
    keys = group.normalize(keyframes(group))
    t = torch.linspace(-1.0, 5.0, 5001, dtype=float64)
    t = torch.cat([t[torch.randperm(5001, generator=kit.generator(0))], UNEVEN, UNEVEN[-1:] + 1e-15])
    found, calls, called = [], [], CurveKernel.__call__

    def counted(self, table, knots, times, *rest):
        calls.append(len(times))
        return called(self, table, knots, times, *rest)

    monkeypatch.setattr(CurveKernel, "__call__", counted)
    for mode in ("auto", "reference"):
        with torchspline.use_kernels(mode):
            found.append(interpolate(name, keys, UNEVEN, t, derivatives))
    for ours, theirs in zip(*(state[: derivatives + 1] for state in found), strict=True):
        assert close(ours, theirs, 1e-12)
    assert calls == [len(t)]


def test_one_loop_refuses_what_it_does_not_know():
    """Outside, extrapolated, NaN, in batches: as without it."""
    pytest.importorskip("numba")
    keys = SO3.normalize(keyframes(SO3))
    t = torch.linspace(-1.0, 5.0, 5000, dtype=float64)
    late = torch.cat([t, t[-1:] + 1e-3])
    with torchspline.use_kernels("auto"):
        with pytest.raises(ValueError, match="t: 1 of 5001 times lie outside"):
            interpolate("QLB", keys, UNEVEN, late, 0)
        with pytest.raises(ValueError, match="t: expected finite numbers, got nan"):
            interpolate("QLB", keys, UNEVEN, torch.cat([t, t[-1:] * torch.nan]), 0)
        held = interpolate("QLB", keys, UNEVEN, late, 0, extrapolate="clamp").value
        one = interpolate("QLB", keys, UNEVEN, t, 0).value
        two = interpolate("QLB", keys.expand(2, -1, -1), UNEVEN, t, 0).value
        with torch.no_grad():
            learnt = interpolate("QLB", keys.clone().requires_grad_(), UNEVEN, t, 0).value
    assert close(held[:-1], one, 1e-15)
    assert close(held[-1], one[-1], 1e-15)
    assert close(two[1], one, 1e-15)
    assert torch.equal(learnt, one)
    assert interpolate("QLB", keys.clone().requires_grad_(), UNEVEN, t, 0).value.requires_grad


def test_long_curves_are_not_compiled():
    assert located_kernel(SCHEMES["linear"].components, "SO3", 8, 2, float64) is not None
    assert curve_kernel(SCHEMES["linear"], "SO3", 8, 2, float64) is not None
    assert curve_kernel(SCHEMES["bezier"], "SE3", 70, 2, float64) is None


def trajectories():
    """One of each kind of curve, on the smallest group that turns: larger ones take long to compile."""
    rates = 0.5 * kit.normal(2, 7, 3, seed=1)
    values = SO3.normalize(keyframes(SO3))
    yield HermiteSpline(values, *rates, group=SO3, times=UNEVEN, learnable=False)
    yield HermiteSpline(
        values, *rates, group=SO3, times=UNEVEN, learnable=False, coordinates="logarithm", frame="world"
    )
    # An end of the domain that comes more than once, with a segment of no duration before it, and a double knot.
    end = UNEVEN[-1:]
    knots = torch.cat([UNEVEN[:1] - 1.0, UNEVEN[:4], UNEVEN[3:], end, end, end + 1.0])
    points = SO3.random(len(knots) - 3, generator=kit.generator(4))
    yield NonuniformBSpline(points, group=SO3, knots=knots, order=3, learnable=False)


@pytest.mark.parametrize(
    ("spline", "derivatives"),
    list(zip(trajectories(), (0, 1, 1), strict=True)),
    ids=["product", "logarithm", "non-uniform"],
)
def test_one_loop_for_other_curves(spline, derivatives):
    pytest.importorskip("numba")
    start, end = spline.domain
    t = torch.linspace(start, end, 5001, dtype=float64)
    found, before = [], located_kernel.cache_info().misses
    for mode in ("auto", "reference"):
        with torchspline.use_kernels(mode):
            found.append(spline.evaluate(t, derivatives))
    assert located_kernel.cache_info().misses == before + 1
    for ours, theirs in zip(*(state[: derivatives + 1] for state in found), strict=True):
        assert close(ours, theirs, 1e-12)
