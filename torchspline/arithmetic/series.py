"""Scalar coefficient functions of the library: the only file with polynomial approximations.

Everywhere x = theta^2 >= 0; every function is even in theta, so it is a smooth function of x.

| function              | value                                                              | poles at   |
|-----------------------|--------------------------------------------------------------------|------------|
| `cos_half(x)`         | cos(theta/2)                                                       |            |
| `sin_half(x)`         | sin(theta/2) / theta                                               |            |
| `stumpff(x, n, m)`    | c_n, ..., c_m: c_0 = cos theta, c_1 = sin(theta)/theta,            |            |
|                       | c_(n+2) = (1/n! - c_n)/x, that is c_n = sum_i (-x)^i / (2i+n)!     |            |
| `bernoulli_factor(x)` | e = (1 - (theta/2) cot(theta/2))/x = 1/12 + x/720 + ... and de/dx  | 2 pi, 4 pi |
| `arctan_factor(t)`    | atan(s)/s, t = s^2 <= 1; for the logarithm, where s = tan(theta/4) |            |

On [0, pi^2] each is one polynomial in x: no branch at small angles, nothing that could be NaN, and code that
vectorises. Beyond, unless the caller promises `short=True` (x <= pi^2, up to rounding), closed forms with
sqrt, sin and cos take over. Both sides of such a choice are computed on arguments inside their own domain, so
that the discarded one has finite values and derivatives of every order.

The tables are printed by `tests/series_fit.py`, constant term first: near-minimax, the value at 0 exact, the
error of the fit below a twentieth of a rounding error. float32 has its own, shorter ones.
"""

from torchspline.arithmetic.scalar import Scalar, cos, is_single, sin, sqrt, where

_PI_SQUARED = 9.869604401089358
_INVERSE_FACTORIAL = (1.0, 1.0, 1 / 2, 1 / 6)

# fmt: off
_DOUBLE = {
    "cos_half": (
        1.0, -0.12499999999999996, 0.002604166666666523, -2.170138888872733e-05,
        9.68812003090713e-08, -2.6911441916849515e-10, 5.096818267902971e-13, -6.996482206496994e-16,
        7.034704995010086e-19),
    "sin_half": (
        0.5, -0.020833333333333332, 0.00026041666666666287, -1.5500992063449432e-06,
        5.3822889086192965e-09, -1.2232474101637833e-11, 1.9603203042375425e-14, -2.332488274725547e-17,
        2.0769153125747357e-20),
    "c1": (
        1.0, -0.16666666666666663, 0.008333333333333215, -0.00019841269841249615,
        2.755731922227612e-06, -2.5052108302376098e-08, 1.6059041339636084e-10, -7.647115702040807e-13,
        2.8108646207854878e-15, -8.175166748882782e-18, 1.7587429527964947e-20),
    "c2": (
        0.5, -0.041666666666666664, 0.001388888888888884, -2.4801587301578814e-05,
        2.755731922326862e-07, -2.087675695302516e-09, 1.1470744550429478e-11, -4.7794571940855824e-14,
        1.5616723090876583e-16, -4.0912732067643847e-19, 8.066269765954153e-22),
    "c3": (
        0.16666666666666666, -0.008333333333333325, 0.0001984126984126652, -2.7557319223520935e-06,
        2.5052108353501428e-08, -1.605904259493137e-10, 7.647134543852929e-13, -2.8110340113026092e-15,
        8.183541605134536e-18, -1.776249804461444e-20),
    "c4": (
        0.041666666666666664, -0.0013888888888888885, 2.480158730158591e-05, -2.755731922379095e-07,
        2.0876756974477944e-09, -1.1470745077175629e-11, 4.779465100605289e-14, -1.5617433908719932e-16,
        4.0947876175031043e-19, -8.139736137949813e-22),
    "c5": (
        0.008333333333333333, -0.00019841269841269839, 2.755731922398533e-06, -2.505210838536331e-08,
        1.6059043831436357e-10, -7.64716352249053e-13, 2.8114523365768067e-15, -8.219922612271372e-18,
        1.951055562670982e-20, -3.564382906216551e-23),
    "arctan": (
        1.0, -0.33333333333333276, 0.19999999999988874, -0.1428571428493903,
        0.11111111083346965, -0.09090908487813242, 0.07692298956557651, -0.06666576974230047,
        0.05881671993826289, -0.052592161330122726, 0.04744101957865753, -0.042839610037894216,
        0.03815381595968581, -0.03268282753534551, 0.026004320984524654, -0.018448589445462748,
        0.011173733836957958, -0.0055176825857046925, 0.0021059911760468075, -0.0005777492435135482,
        0.00010077211400301203, -8.359608425864573e-06),
    "bernoulli": (
        0.08333333333333333, 0.0013888888888888907, 3.3068783068765066e-05, 8.267195767854157e-07,
        2.0876756866070797e-08, 5.284191476886188e-10, 1.3382441095494963e-11, 3.3901465286080955e-13,
        8.569931904811893e-15, 2.2151449970892906e-16, 4.777858678311896e-18, 2.356298651457481e-19,
        -5.440004021808972e-21, 6.618340176208728e-22, -2.064830926868605e-23, 5.255646290375807e-25),
    "bernoulli_slope": (
        0.001388888888888889, 6.613756613756606e-05, 2.4801587301595895e-06, 8.350702794791623e-08,
        2.642095076805238e-09, 8.029520985175624e-11, 2.372783821988782e-12, 6.868421180965834e-14,
        1.959104376079687e-15, 5.458430936296903e-17, 1.6446606873215765e-18, 2.4814427249127384e-20,
        3.237783112532123e-21, -1.437650250338091e-22, 1.1080465420858847e-23, -3.5167095265673454e-25,
        7.604423474348985e-27),
}
_SINGLE = {
    "cos_half": (
        1.0, -0.125, 0.002604165, -2.1700629e-05, 9.672593e-08, -2.5465133e-10),
    "sin_half": (
        0.5, -0.020833334, 0.0002604166, -1.5500698e-06, 5.3762905e-09, -1.1674344e-11),
    "c1": (
        1.0, -0.16666666, 0.0083333235, -0.00019840599, 2.7536946e-06, -2.4737716e-08, 1.3640883e-10),
    "c2": (
        0.5, -0.041666668, 0.0013888882, -2.4801162e-05, 2.7544425e-07, -2.0678042e-09, 9.946706e-12),
    "c3": (
        0.16666667, -0.008333332, 0.00019841042, -2.75466e-06, 2.483169e-08, -1.3977261e-10),
    "c4": (
        0.041666668, -0.0013888888, 2.4801442e-05, -2.7550547e-07, 2.0737632e-09, -1.0160025e-11),
    "c5": (
        0.008333334, -0.00019841269, 2.7557232e-06, -2.5048086e-08, 1.5976524e-10, -6.871358e-13),
    "arctan": (
        1.0, -0.33333325, 0.19999632, -0.14279312, 0.11054756, -0.08797995, 0.0671167,
        -0.044267993, 0.022180976, -0.0071491203, 0.0010800516),
    "bernoulli": (
        0.083333336, 0.0013888895, 3.3067172e-05, 8.281023e-07, 2.0321497e-08, 6.4525146e-10, 3.9037458e-13,
        1.0172855e-12),
    "bernoulli_slope": (
        0.0013888889, 6.613755e-05, 2.480212e-06, 8.344812e-08, 2.6732465e-09, 7.131165e-11, 3.8473382e-12,
        -6.544643e-14, 7.793781e-15),
}
# fmt: on


def cos_half(x: Scalar, short: bool = False) -> Scalar:
    """cos(theta/2) of x = theta^2."""
    if short:
        return _polynomial("cos_half", x)
    far, x_near, x_far = _split(x)
    return where(far, cos(0.5 * sqrt(x_far)), _polynomial("cos_half", x_near))


def sin_half(x: Scalar, short: bool = False) -> Scalar:
    """sin(theta/2)/theta of x = theta^2."""
    if short:
        return _polynomial("sin_half", x)
    far, x_near, x_far = _split(x)
    theta = sqrt(x_far)
    return where(far, sin(0.5 * theta) / theta, _polynomial("sin_half", x_near))


def stumpff(x: Scalar, first: int, last: int, short: bool = False) -> tuple[Scalar, ...]:
    """Stumpff functions (c_first, ..., c_last) of x = theta^2, 0 <= first < last, 2 <= last <= 5.

    The top two are polynomials, the others follow from c_n = 1/n! - x c_(n+2), which is stable downward.
    """
    if not (0 <= first < last and 2 <= last <= 5):
        raise ValueError(f"stumpff needs 0 <= first < last and 2 <= last <= 5, got {first} and {last}")
    if short:
        return _stumpff_near(x, first, last)
    far, x_near, x_far = _split(x)
    near = _stumpff_near(x_near, first, last)
    beyond = _stumpff_far(x_far, last)[first:]
    return tuple(where(far, b, n) for b, n in zip(beyond, near, strict=True))


def bernoulli_factor(x: Scalar, short: bool = False) -> tuple[Scalar, Scalar]:
    """e and de/dx of e(x) = (1 - (theta/2) cot(theta/2))/x, x = theta^2, found in inverse Jacobians."""
    if short:
        return _polynomial("bernoulli", x), _polynomial("bernoulli_slope", x)
    far, x_near, x_far = _split(x)
    half = 0.5 * sqrt(x_far)
    k = half * cos(half) / sin(half)
    e = (1.0 - k) / x_far
    slope = (0.125 - e * (1.0 + 0.5 * k)) / x_far
    return (
        where(far, e, _polynomial("bernoulli", x_near)),
        where(far, slope, _polynomial("bernoulli_slope", x_near)),
    )


def arctan_factor(t: Scalar) -> Scalar:
    """atan(sqrt t)/sqrt t for t in [0, 1]."""
    return _polynomial("arctan", t)


def _polynomial(name: str, x: Scalar) -> Scalar:
    """Horner's rule on the table of the precision of `x`."""
    table = (_SINGLE if is_single(x) else _DOUBLE)[name]
    value = table[-1]
    for coefficient in table[-2::-1]:
        value = value * x + coefficient
    return value


def _split(x: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Whether x is beyond the polynomials; x for the polynomials, 0 if beyond; x for sqrt, pi^2 if not."""
    far = x > _PI_SQUARED
    return far, where(far, 0.0, x), where(far, x, _PI_SQUARED)


def _stumpff_near(x: Scalar, first: int, last: int) -> tuple[Scalar, ...]:
    c = {n: _polynomial(f"c{n}", x) for n in (last - 1, last)}
    for n in range(last - 2, first - 1, -1):
        c[n] = _INVERSE_FACTORIAL[n] - x * c[n + 2]
    return tuple(c[n] for n in range(first, last + 1))


def _stumpff_far(x: Scalar, last: int) -> list[Scalar]:
    """c_0 ... c_last upward, from the half angle: c_0 and c_2 keep their relative accuracy near zeros."""
    theta = sqrt(x)
    sine, cosine = sin(0.5 * theta), cos(0.5 * theta)
    c = [(cosine - sine) * (cosine + sine), 2.0 * sine * cosine / theta, 2.0 * sine * sine / x]
    for n in range(3, last + 1):
        c.append((_INVERSE_FACTORIAL[n - 2] - c[n - 2]) / x)
    return c
