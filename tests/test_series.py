"""The coefficient functions against mpmath, at the float they were given, in both precisions.

Errors are measured in eps |f(x)|, eps = 2^-52 or 2^-23, and at most 4 of them are allowed, except

* up to pi, for `cos_half`, c_0 and c_1, which are 1 at 0 and vanish at pi, pi/2 and pi: near such a zero,
  that is where |f| < 1/2, the unit is eps/2, as at |f| = 1/2;
* beyond pi, theta = sqrt(x) is rounded before sine and cosine see it. One unit in the last place of theta is
  granted (torch does not round float32 roots correctly everywhere): x may seem larger by a factor 1 + 2 eps,
  so 2 eps |x f'(x)| is added, which for sin(theta) amounts to theta eps |cos(theta)|.
"""

from functools import cache

import mpmath as mp
import numpy as np
import pytest
import series_fit as exact
import torch

from torchspline.arithmetic import series

PI = np.pi
PI2 = PI**2
PRECISIONS = {"double": torch.float64, "single": torch.float32}


def stumpff_case(n, first, last):
    return lambda x, **short: series.stumpff(x, first, last, **short)[n - first]


# name -> (function under test, exact function, largest theta)
CASES = {
    "cos_half": (series.cos_half, exact.cos_half, 100 * PI),
    "sin_half": (series.sin_half, exact.sin_half, 100 * PI),
    "bernoulli": (
        lambda x, **short: series.bernoulli_factor(x, **short)[0],
        exact.bernoulli_factor,
        1.95 * PI,
    ),
    "slope": (lambda x, **short: series.bernoulli_factor(x, **short)[1], exact.bernoulli_slope, 1.95 * PI),
}
STUMPFF_EXACT = [lambda x, n=n: exact.stumpff(n, x) for n in range(6)]
for last in range(2, 6):
    for n in range(last + 1):
        # c_n comes from one of the two polynomials by steps of two, whatever `first` is.
        case = stumpff_case(n, min(n, last - 1), last)
        CASES[f"c{n} below c{last}"] = (case, STUMPFF_EXACT[n], 100 * PI)
WITH_ZEROS = ("cos_half", "c0", "c1")


@cache
def reference(f, x):
    with mp.workdps(40):
        return f(mp.mpf(x))


@cache
def reference_derivative(f, x, order):
    with mp.workdps(40):
        return mp.diff(f, mp.mpf(x), order)


def grid(largest):
    """Angles, log-uniform from 1e-12 to pi, dense towards and around pi, and up to the largest."""
    near = [[0.0], np.geomspace(1e-12, PI, 120), np.linspace(1.0, PI, 60), PI + np.linspace(-1e-2, 1e-2, 41)]
    ulps = [PI * (1 + np.arange(-4, 5) * 2.0**-52), PI * (1 + np.arange(-4, 5) * 2.0**-23)]
    beyond = [np.linspace(PI, min(largest, 4 * PI), 80), np.geomspace(PI, largest, 40)]
    return np.concatenate(near + ulps + beyond)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_tables_are_the_fitted_ones(precision):
    tables = {"double": series._DOUBLE, "single": series._SINGLE}[precision]
    assert tables == exact.tables(precision)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_fit_error_is_far_below_rounding(precision):
    tables = {"double": series._DOUBLE, "single": series._SINGLE}[precision]
    with mp.workdps(40):
        for name, table in tables.items():
            coefficients, error = exact.fit(name, precision)
            assert len(coefficients) == len(table)
            assert error < {"double": 5.6e-18, "single": 3e-9}[precision]


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", CASES)
def test_accuracy(name, precision):
    f, f_exact, largest = CASES[name]
    dtype = PRECISIONS[precision]
    eps = torch.finfo(dtype).eps
    x = torch.tensor(grid(largest) ** 2, dtype=dtype)
    value = f(x)
    assert value.dtype == dtype
    for x_i, value_i in zip(x.tolist(), value.tolist(), strict=True):
        true = reference(f_exact, x_i)
        unit, granted = eps * abs(true), 0.0
        if x_i > series._PI_SQUARED:
            granted = 2 * eps * abs(x_i * reference_derivative(f_exact, x_i, 1))
        elif name.startswith(WITH_ZEROS):
            unit = max(unit, eps / 2)
        error = abs(value_i - true)
        assert error <= 4 * unit + granted, f"x = {x_i!r}: {float(error / unit):.2f} units"


@pytest.mark.parametrize("precision", PRECISIONS)
def test_accuracy_of_arctan(precision):
    dtype = PRECISIONS[precision]
    t = torch.tensor(
        np.concatenate([[0.0], np.geomspace(1e-24, 1, 200), np.linspace(0, 1, 200)]), dtype=dtype
    )
    for t_i, value in zip(t.tolist(), series.arctan_factor(t).tolist(), strict=True):
        true = reference(exact.arctan_factor, t_i)
        assert abs(value - true) <= 4 * torch.finfo(dtype).eps * true


@pytest.mark.parametrize("dtype", PRECISIONS.values())
def test_values_at_zero_are_exact(dtype):
    zero = torch.zeros((), dtype=dtype)
    assert series.cos_half(zero) == 1
    assert series.sin_half(zero) == 0.5
    assert series.arctan_factor(zero) == 1
    for last in range(2, 6):
        for n, c in enumerate(series.stumpff(zero, 0, last)):
            assert c == torch.tensor(1 / np.prod(np.arange(1.0, n + 1)), dtype=dtype)
    e, slope = series.bernoulli_factor(zero)
    assert e == torch.tensor(1 / 12, dtype=dtype)
    assert slope == torch.tensor(1 / 720, dtype=dtype)


def derivatives(f, x):
    """Values, first and second derivatives of an elementwise function."""
    x = x.clone().requires_grad_()
    value = f(x)
    (first,) = torch.autograd.grad(value.sum(), x, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), x)
    return value.detach(), first.detach(), second


def check_derivatives(f, f_exact, x):
    for order, tolerance in ((1, 1e-13), (2, 1e-11)):
        # The derivative of c_0 vanishes at pi: there, a tenth of its value at 0 sets the scale.
        scale = abs(reference_derivative(f_exact, 0.0, order)) / 10
        for x_i, value in zip(x.tolist(), derivatives(f, x)[order].tolist(), strict=True):
            true = reference_derivative(f_exact, x_i, order)
            assert abs(value - true) <= tolerance * max(abs(true), scale), f"order {order}, x = {x_i!r}"


@pytest.mark.parametrize("name", CASES)
def test_derivatives(name):
    f, f_exact, _ = CASES[name]
    near = [0.0, 1e-300, 1e-24, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 4.0, 9.0, np.nextafter(PI2, 0), PI2]
    beyond = [np.nextafter(PI2, 20), PI2 * (1 + 1e-6), 10.0, 12.0, 20.0, 30.0]
    check_derivatives(f, f_exact, torch.tensor(near + beyond, dtype=torch.float64))


def test_derivatives_of_arctan():
    t = torch.tensor([0.0, 1e-300, 1e-24, 1e-12, 1e-6, 1e-3, 0.1, 0.5, 0.9, 1.0], dtype=torch.float64)
    check_derivatives(series.arctan_factor, exact.arctan_factor, t)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("short", [False, True])
def test_gradcheck(name, short):
    f = CASES[name][0]
    # Away from pi^2: the finite differences would straddle the change of formula.
    x = torch.tensor(
        [0.0, 1e-4, 0.3, 2.0, 5.0, 9.5] + ([] if short else [10.3, 15.0, 25.0]), dtype=torch.float64
    )
    x.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: f(x, short=short), x)
    assert torch.autograd.gradgradcheck(lambda x: f(x, short=short), x)


def test_gradcheck_of_arctan():
    t = torch.tensor([0.0, 1e-4, 0.3, 0.999], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(series.arctan_factor, t)
    assert torch.autograd.gradgradcheck(series.arctan_factor, t)


@pytest.mark.parametrize("dtype", PRECISIONS.values())
@pytest.mark.parametrize("name", CASES)
def test_everything_is_finite(name, dtype):
    pi2 = torch.tensor(PI2, dtype=dtype)
    around = [torch.nextafter(pi2, pi2 * 0), pi2, torch.nextafter(pi2, pi2 * 2)]
    x = torch.tensor([0.0, 1e-38, 1e-30, 1e-12, 1.0, *around, 10.0, 1e3, 1e8, 1e16, 1e25], dtype=dtype)
    for values in derivatives(CASES[name][0], x):
        assert values.dtype == dtype
        assert values.isfinite().all()


@pytest.mark.parametrize("name", CASES)
def test_python_floats(name):
    f = CASES[name][0]
    for x in (0.0, 1e-24, 0.5, 9.0, PI2, 9.9, 15.0, 1e4):
        value = f(x)
        assert type(value) is float
        expected = f(torch.tensor(x, dtype=torch.float64)).item()
        assert value == pytest.approx(expected, rel=1e-14, abs=1e-15)
        if x <= PI2:
            assert f(x, short=True) == value
    assert type(series.arctan_factor(0.5)) is float


@pytest.mark.parametrize("default", PRECISIONS.values())
@pytest.mark.parametrize("dtype", PRECISIONS.values())
@pytest.mark.parametrize("name", CASES)
def test_default_dtype_does_not_matter(name, dtype, default):
    f = CASES[name][0]
    x = torch.linspace(0, 30, 31, dtype=dtype)
    expected = f(x)
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(default)
        for argument in (x, x[3]):
            assert f(argument).dtype == dtype
        assert torch.equal(f(x), expected)
        assert f(x[:9], short=True).dtype == dtype
        assert series.arctan_factor(x[:2]).dtype == dtype
    finally:
        torch.set_default_dtype(before)


def test_short_is_the_same_polynomial():
    x = torch.linspace(0, PI2, 101, dtype=torch.float64)
    for f, _, _ in CASES.values():
        assert torch.equal(f(x), f(x, short=True))


@pytest.mark.parametrize(("first", "last"), [(0, 1), (2, 2), (3, 2), (-1, 2), (0, 6)])
def test_stumpff_refuses_other_ranges(first, last):
    with pytest.raises(ValueError, match="stumpff needs"):
        series.stumpff(0.5, first, last)


def test_stumpff_range():
    for last in range(2, 6):
        for first in range(last):
            assert len(series.stumpff(1.0, first, last)) == last - first + 1
            assert series.stumpff(20.0, first, last) == series.stumpff(20.0, 0, last)[first:]
