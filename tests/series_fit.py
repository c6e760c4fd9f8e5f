"""Regenerates the coefficient tables of `torchspline.arithmetic.series`: `python tests/series_fit.py`.

Each polynomial interpolates its function in the zeros of a Chebyshev polynomial whose interval is stretched
to the left until the first zero falls on 0. So the ripples of the error are nearly equal, and the constant
term is exactly the value at 0. The number of terms is the smallest whose error stays below a twentieth of a
rounding error (half a unit in the last place) of the value at 0. All is done with 60 digits and rounded once
at the end, so the tables are the same on every machine.
"""

from collections.abc import Callable
from itertools import count

import mpmath as mp
import numpy as np

DIGITS = 60
TOLERANCE = {"double": mp.mpf(2) ** -53 / 20, "single": mp.mpf(2) ** -24 / 20}


def stumpff(n: int, x) -> mp.mpf:
    """c_n(x) = sum_i (-x)^i / (2i + n)!, the power series up to x = 40, closed forms beyond."""
    x = mp.mpf(x)
    if abs(x) < 40:
        term = total = 1 / mp.factorial(n)
        i = 1
        while abs(term) > mp.eps * abs(total) * mp.mpf(10) ** -10:
            term *= -x / ((2 * i + n - 1) * (2 * i + n))
            total += term
            i += 1
        return total
    with mp.extradps(20):
        if n == 0:
            return mp.cos(mp.sqrt(x))
        if n == 1:
            return mp.sin(mp.sqrt(x)) / mp.sqrt(x)
        return (1 / mp.factorial(n - 2) - stumpff(n - 2, x)) / x


def cos_half(x) -> mp.mpf:
    return stumpff(0, mp.mpf(x) / 4)


def sin_half(x) -> mp.mpf:
    return stumpff(1, mp.mpf(x) / 4) / 2


def arctan_factor(t) -> mp.mpf:
    return mp.mpf(1) if t == 0 else mp.hyp2f1(mp.mpf(1) / 2, 1, mp.mpf(3) / 2, -mp.mpf(t))


def bernoulli_factor(x) -> mp.mpf:
    """e(x) = sum_n |B_(2n+2)| x^n / (2n+2)! for small x, its closed form beyond."""
    x = mp.mpf(x)
    if abs(x) < 2:
        return mp.fsum(abs(mp.bernoulli(2 * n)) / mp.factorial(2 * n) * x ** (n - 1) for n in range(1, 60))
    half = mp.sqrt(x) / 2
    return (1 - half * mp.cot(half)) / x


def bernoulli_slope(x) -> mp.mpf:
    """e'(x)."""
    x = mp.mpf(x)
    if abs(x) < 2:
        return mp.fsum(
            (n - 1) * abs(mp.bernoulli(2 * n)) / mp.factorial(2 * n) * x ** (n - 2) for n in range(2, 60)
        )
    half = mp.sqrt(x) / 2
    return (half * mp.cot(half) + (half / mp.sin(half)) ** 2 - 2) / (2 * x**2)


# name in the tables -> (exact function, right end of the interval that begins at 0)
FUNCTIONS: dict[str, tuple[Callable, Callable]] = {
    "cos_half": (cos_half, lambda: mp.pi**2),
    "sin_half": (sin_half, lambda: mp.pi**2),
    "c1": (lambda x: stumpff(1, x), lambda: mp.pi**2),
    "c2": (lambda x: stumpff(2, x), lambda: mp.pi**2),
    "c3": (lambda x: stumpff(3, x), lambda: mp.pi**2),
    "c4": (lambda x: stumpff(4, x), lambda: mp.pi**2),
    "c5": (lambda x: stumpff(5, x), lambda: mp.pi**2),
    "arctan": (arctan_factor, lambda: mp.mpf(1)),
    "bernoulli": (bernoulli_factor, lambda: mp.pi**2),
    "bernoulli_slope": (bernoulli_slope, lambda: mp.pi**2),
}


def nodes(terms: int, end: mp.mpf) -> list[mp.mpf]:
    """Zeros of a Chebyshev polynomial, increasing, the first one moved onto 0."""
    zeros = [-mp.cos(mp.pi * (2 * i + 1) / (2 * terms)) for i in range(terms)]
    return [end * (z - zeros[0]) / (1 - zeros[0]) for z in zeros]


def interpolate(f: Callable, terms: int, end: mp.mpf) -> list[mp.mpf]:
    """Monomial coefficients, constant first, of the polynomial through f at the nodes (Newton's form)."""
    points = nodes(terms, end)
    divided = [f(p) for p in points]
    for level in range(1, terms):
        for i in range(terms - 1, level - 1, -1):
            divided[i] = (divided[i] - divided[i - 1]) / (points[i] - points[i - level])
    coefficients = [divided[-1]]
    for point, constant in zip(reversed(points[:-1]), reversed(divided[:-1]), strict=True):
        shifted = [mp.mpf(0), *coefficients]
        coefficients = [s - point * c for s, c in zip(shifted, [*coefficients, mp.mpf(0)], strict=True)]
        coefficients[0] += constant
    return coefficients


def fit_error(f: Callable, coefficients: list[mp.mpf], end: mp.mpf) -> mp.mpf:
    """Largest error, relative to the value at 0, halfway between the nodes (in angle) and at the end."""
    terms = len(coefficients)
    first = -mp.cos(mp.pi / (2 * terms))
    ripples = [end * (-mp.cos(mp.pi * i / terms) - first) / (1 - first) for i in range(1, terms + 1)]
    return max(abs(mp.polyval(coefficients[::-1], x) - f(x)) for x in ripples) / abs(f(mp.mpf(0)))


def fit(name: str, precision: str) -> tuple[list[mp.mpf], mp.mpf]:
    """Coefficients before rounding, and the error of the fit."""
    f, interval = FUNCTIONS[name]
    for terms in count(3):
        coefficients = interpolate(f, terms, interval())
        error = fit_error(f, coefficients, interval())
        if error < TOLERANCE[precision]:
            return coefficients, error
    raise AssertionError("unreachable")


def tables(precision: str) -> dict[str, tuple[float, ...]]:
    """Every table, rounded to the precision; float32 values as the shortest decimals that round to them."""
    rounded = {"double": float, "single": lambda c: float(str(np.float32(float(c))))}[precision]
    with mp.workdps(DIGITS):
        return {name: tuple(rounded(c) for c in fit(name, precision)[0]) for name in FUNCTIONS}


def main() -> None:
    """Prints the tables in the form in which they stand in the module."""
    for precision in ("double", "single"):
        print(f"_{precision.upper()} = {{")
        for name, table in tables(precision).items():
            print(f'    "{name}": (')
            width = 4 if precision == "double" else 7
            rows = [", ".join(map(repr, table[i : i + width])) for i in range(0, len(table), width)]
            print("        " + ",\n        ".join(rows) + "),")
        print("}")


if __name__ == "__main__":
    main()
