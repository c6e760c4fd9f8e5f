"""Truncated power series against nested differentiation, and products of geodesics against them and matrices."""

import math

import batteries as kit
import pytest
import torch
from batteries import each_group, normal
from oracles import body_rates, product_rule
from spline_cases import close

import torchspline
from torchspline.arithmetic import jet
from torchspline.arithmetic.jet import Jet
from torchspline.arithmetic.scalar import cos, sin, sqrt, where
from torchspline.functional import geodesic_product
from torchspline.groups.components import join, split
from torchspline.groups.operations import geodesics, operation_of, run

float64 = torch.float64


def derivatives_of(function, u, count):
    """Value and derivatives by nested forward mode."""
    results, f = [], function
    for _ in range(count + 1):
        results.append(f(u))
        f = lambda u, f=f: torch.func.jvp(f, (u,), (torch.ones_like(u),))[1]  # noqa: E731
    return results


SCALARS = {
    "products": lambda x: x * x * 3.0 - 2.0 * x + x * (1.0 - x),
    "quotients": lambda x: 1.0 / (1.0 + x * x) + x / (2.0 - x) + (x + 2.0) / 4.0,
    "root": lambda x: sqrt(x * x + 0.3) - 1.0,
    "sine and cosine": lambda x: sin(2.0 * x) * cos(x * x),
    "choice": lambda x: where(x > 0.5, x * x * x, 2.0 * x) + where(x < 0.5, 1.0, sin(x)),
    "constant": lambda x: 0.0 * x + 7.0,
}


@pytest.mark.parametrize("name", SCALARS)
def test_scalars(name):
    function, u = SCALARS[name], torch.tensor([-0.7, 0.1, 0.6, 1.4], dtype=float64)
    ours = function(jet.variable(u, 3))
    for r, exact in enumerate(derivatives_of(function, u, 3)):
        value = jet.values((ours,), r)[0]
        assert close(torch.as_tensor(value, dtype=float64).expand(4), exact.expand(4), 1e-14)


def test_the_shorter_jet_says_how_much_is_known():
    x, y = Jet(1.0, 2.0, 3.0), Jet(2.0, 5.0)
    for result in (x + y, x * y, x - y, x / y):
        assert len(result.coefficients) == 2
    assert jet.derivative(x).coefficients == (2.0, 6.0)
    assert jet.values((x, 4.0), 2) == (6.0, 0.0)
    assert where(True, Jet(1.0, 2.0), Jet(1.0, 3.0)).coefficients == (1.0, 2.0)


@each_group
@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.4, 2.0])
def test_rates_of_a_curve(group, size):
    """Exp of a cubic: its rates from the numbers of its points, from J_r, and by differentiating matrices."""
    algebra, u = group.arithmetic, torch.tensor([0.1, 0.6, 0.9], dtype=float64)
    c = [size * normal(3, group.tangent_size, seed=i) for i in range(4)]

    def tangent(u):
        return c[0] + u[:, None] * (c[1] + u[:, None] * (c[2] + u[:, None] * c[3]))

    taylor = [d / math.factorial(r) for r, d in enumerate(derivatives_of(tangent, u, 3))]
    x = tuple(map(Jet, *map(split, taylor)))
    matrices = derivatives_of(lambda u: group.to_matrix(group.exp(tangent(u), validate=False)), u, 3)
    exact = body_rates(group, matrices)
    stored = (
        tuple(2.5 * component for component in algebra.exp(x)) if algebra.sign_blocks == ((0, 4),) else None
    )
    for r, rate in enumerate(exact):
        for ours in (jet.logarithmic_rates(algebra, x, 3), jet.rates(algebra, algebra.exp(x), 3)):
            assert close(join(ours[r], c[0]), rate, 1e-10)
        if stored is not None:  # quaternions of another length
            assert close(join(jet.rates(algebra, stored, 3)[r], c[0]), rate, 1e-10)


# ---------------------------------------------------------------------- products of geodesics


def product_arguments(group, count, derivatives, rows, seed=0):
    start = kit.rescaled(group, group.random(rows, generator=kit.generator(seed)), (1.0, -0.3, 2.0))
    steps = normal(rows, count, group.tangent_size, seed=seed + 1) * 1.3
    weights = normal(rows, derivatives + 1, count, seed=seed + 2)
    return start, steps, weights


@each_group
@pytest.mark.parametrize("count", [1, 3])
def test_products_of_geodesics(group, count):
    """Any weights, steps beyond pi: [E17] (24), (33), (36) in the body frame, and the jerk, by the product rule."""
    start, steps, weights = product_arguments(group, count, 3, 6)
    value, *rates = geodesic_product(start, steps, weights, group=group)
    rows = [row.unbind(-1) for row in weights.unbind(1)]
    for i in range(6):
        of_row = [[w[i : i + 1] for w in row] for row in rows]
        matrices = product_rule(group, group.to_matrix(start[i]), steps[i], of_row)
        assert close(group.to_matrix(value[i]), matrices[0][0], 1e-13)
        for rate, exact in zip(rates, body_rates(group, matrices), strict=True):
            assert close(rate[i], exact[0], 1e-11)
    for derivatives in range(3):
        fewer = geodesics(group.name, start, steps, weights[:, : derivatives + 1])
        assert len(fewer) == derivatives + 1
        assert all(torch.equal(x, y) for x, y in zip(fewer, (value, *rates), strict=False))


@each_group
def test_gradients_of_products_of_geodesics(group):
    given = [x.requires_grad_() for x in product_arguments(group, 2, 2, 3)]

    def fields(*given):
        return torch.cat(geodesics(group.name, *given), dim=-1)

    fast = {"fast_mode": True, "atol": 1e-6, "rtol": 1e-5}
    assert torch.autograd.gradcheck(fields, given, check_forward_ad=True, **fast)
    assert torch.autograd.gradgradcheck(fields, given, check_fwd_over_rev=True, **fast)


def test_compiled_products_of_geodesics():
    """Kernels equal the reference, forward and in reverse, on both sides of pi."""
    pytest.importorskip("numba")
    group, results = torchspline.SO2, []
    for mode in ("fused", "reference"):
        given = [x.requires_grad_() for x in product_arguments(group, 2, 2, 5000)]
        with torchspline.use_kernels(mode):
            fields = torch.cat(geodesics(group.name, *given), dim=-1)
            results.append([fields, *torch.autograd.grad(fields.sin().sum(), given)])
    for ours, theirs in zip(*results, strict=True):
        assert close(ours, theirs, 1e-12)
    assert operation_of("geodesics_2_2").compiles(torchspline.SE3.arithmetic) == (True, True)
    assert operation_of("geodesics_9_2").compiles(torchspline.SE3.arithmetic) == (False, False)


def test_one_geodesic_is_interpolation():
    group = torchspline.SE3
    a, b = (group.random(4, generator=kit.generator(i)) for i in (1, 2))
    s = torch.tensor([0.0, 0.3, 1.0, 2.2], dtype=float64)
    value, velocity = geodesics(
        group.name, a, group.log(group.between(a, b))[:, None], torch.stack([s, torch.ones(4)], -1)[..., None]
    )
    assert kit.equal_up_to_sign(group, value, run("interpolate", group.name, a, b, s[:, None])) < 4
    assert close(velocity, group.log(group.between(a, b)), 1e-14)
