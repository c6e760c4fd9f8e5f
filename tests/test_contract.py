"""The gradient contract of splines, trajectories and readings, and its page in the documentation.

Each function takes control points from all regimes at once, one of a batch, on SE3: what other groups and orders add is
tested where they are (`test_bspline_gradients.py`, `test_hermite.py`, ...).
"""

from collections.abc import Callable
from typing import NamedTuple

import contract
import pytest
import torch
from batteries import PI, normal
from spline_cases import chain, number
from torch import Tensor

import torchspline as ts
from torchspline.functional import bspline, geodesic_product, hermite, interpolate, nonuniform_bspline
from torchspline.groups import SE3

F64 = torch.float64
#: Rotation between neighbours, for each regime.
GAPS = {"identity": (0.0,), "small": (1e-12, 1e-8, 1e-4), "general": (0.8,), "near pi": (PI - 1e-6,)}
ROWS = [gap for gaps in GAPS.values() for gap in gaps]
NEAR_PI = len(ROWS) - 1


def points(count: int) -> Tensor:
    """`(rows, count, 7)`: neighbours turned by each of the gaps and shifted about as far; no unit quaternions."""
    made = []
    for i, gap in enumerate(ROWS):
        step = normal(count - 1, 6, seed=i)
        step = torch.cat([step[:, :3], step[:, 3:] / step[:, 3:].norm(dim=-1, keepdim=True)], dim=-1) * gap
        made.append(chain(SE3, step, seed=i))
    return torch.stack(made) * torch.tensor([1.0, 1, 1, 1.3, 1.3, 1.3, 1.3], dtype=F64)


def rates(count: int, seed: int) -> Tensor:
    """Tangents at knots, as large as the motion."""
    return normal(len(ROWS), count, 6, seed=seed) * torch.tensor(ROWS, dtype=F64)[:, None, None].clamp_max(
        1.0
    )


class Function(NamedTuple):
    """A function of the arguments the contract names, and good ones: the first `batched` have a row for each gap."""

    call: Callable[..., tuple[Tensor, ...]]
    make: Callable[[], list[Tensor]]
    batched: int


T = number([0.23, 0.9])
T_SAMPLES = number([0.1, 0.35, 0.6])
KNOTS = number([-0.6, -0.2, -0.1, 0.0, 0.5, 1.2, 1.3, 1.5, 2.0])
TIMES = number([0.0, 0.5, 1.3])
KEYS = number([0.0, 0.4, 1.3, 1.6])
POSE = number([0.3, -0.2, 0.1, 0.9, 0.1, -0.3, 0.2])
DT = 0.5


def _spline(X: Tensor) -> ts.BSpline:
    return ts.BSpline(X, group=SE3, dt=DT, learnable=False, validate=False)


def _bspline(X: Tensor, t: Tensor, dt: Tensor, t0: Tensor) -> tuple[Tensor, ...]:
    return bspline(X, t, group=SE3, dt=dt, t0=t0, validate=False)[:3]


def _nonuniform(X: Tensor, t: Tensor, knots: Tensor) -> tuple[Tensor, ...]:
    return nonuniform_bspline(X, t, group=SE3, knots=knots, validate=False)[:3]


def _hermite(coordinates: str) -> Callable[..., tuple[Tensor, ...]]:
    def call(X: Tensor, v: Tensor, a: Tensor, t: Tensor, times: Tensor) -> tuple[Tensor, ...]:
        options = {"group": SE3, "times": times, "coordinates": coordinates, "validate": False}
        return hermite(X, v, a, t, **options)[:3]

    return call


def _interpolate(method: str) -> Callable[..., tuple[Tensor, ...]]:
    def call(X: Tensor, times: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        return interpolate(method, X, times, t, group=SE3, validate=False)[:3]

    return call


def _geodesics(start: Tensor, steps: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
    return geodesic_product(start, steps, weights, group=SE3, validate=False)[:3]


def _kinematics(X: Tensor, t: Tensor) -> tuple[Tensor, ...]:
    return tuple(_spline(X).kinematics(t))


def _mounted(X: Tensor, t: Tensor, T: Tensor) -> tuple[Tensor, ...]:
    return _spline(X).mounted(T).evaluate(t)[:3]


def _measure(X: Tensor, t: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
    return tuple(ts.imu.measure(_spline(X), t, *others))


def _imu(
    X: Tensor, bg: Tensor, ba: Tensor, sg: Tensor, sa: Tensor, T: Tensor, g: Tensor
) -> tuple[Tensor, ...]:
    sensor = ts.imu.Imu(
        gyroscope_bias=bg, accelerometer_bias=ba, gyroscope_scale=sg, accelerometer_scale=sa, T_body_imu=T, gravity=g
    )  # fmt: skip
    return tuple(sensor(_spline(X), T_SAMPLES)[:2])


def _increments(X: Tensor, t: Tensor) -> tuple[Tensor, ...]:
    return tuple(ts.imu.increments(_spline(X), t))


def _integrated(gyroscope: Tensor, t: Tensor, start: Tensor) -> tuple[Tensor, ...]:
    return (ts.imu.integrate_gyroscope(gyroscope, t, start),)


def _strapdown(angle: Tensor, velocity: Tensor, t: Tensor) -> tuple[Tensor, ...]:
    start = ts.imu.Navigation(POSE[3:].to(angle.dtype), POSE[:3].to(angle.dtype), POSE[:3].to(angle.dtype))
    return tuple(ts.imu.strapdown(ts.imu.Increments(angle, velocity), t, start))


def _turns(count: int, seed: int) -> Tensor:
    """Turns `(rows, count, 3)` by each of the gaps."""
    size = torch.tensor(ROWS, dtype=F64)[:, None, None]
    return torch.nn.functional.normalize(normal(len(ROWS), count, 3, seed=seed), dim=-1) * size


def _steps() -> list[Tensor]:
    size = torch.tensor(ROWS, dtype=F64)[:, None, None]
    return [
        points(1),
        torch.nn.functional.normalize(normal(len(ROWS), 3, 6, seed=3), dim=-1)[:, None] * size[..., None],
    ]


FUNCTIONS = {
    "bspline": Function(_bspline, lambda: [points(5), T, number(DT), number(-0.01)], 1),
    "nonuniform_bspline": Function(_nonuniform, lambda: [points(5), T, KNOTS], 1),
    "hermite (product)": Function(
        _hermite("product"), lambda: [points(3), rates(3, 1), rates(3, 2), T, TIMES], 3
    ),
    "hermite (logarithm)": Function(
        _hermite("logarithm"), lambda: [points(3), rates(3, 1), rates(3, 2), T, TIMES], 3
    ),
    **{
        f"interpolate ({method})": Function(_interpolate(method), lambda: [points(4), KEYS, T], 1)
        for method in ("geodesic", "squad", "cumulative_bspline")
    },
    "geodesic_product": Function(_geodesics, lambda: [*_steps(), normal(3, 3, seed=4)], 2),
    "Trajectory.kinematics": Function(_kinematics, lambda: [points(5), T], 1),
    "Trajectory.mounted": Function(_mounted, lambda: [points(5), T, POSE], 1),
    "imu.measure": Function(
        _measure,
        lambda: [points(5), T, number([0.1, 0.2, -9.8]), number([0.1, 0, 0.2]), number([0, 0.1, 0.3]), POSE],
        1,
    ),
    "imu.Imu": Function(
        _imu,
        lambda: [
            points(5), number([0.1, 0, 0.2]), number([0, 0.1, 0.3]), number([1.1, 1, 0.9]), number([0.9, 1, 1.2]),
            POSE, number([0.1, 0.2, -9.8]),
        ],
        1,
    ),
    "imu.increments": Function(_increments, lambda: [points(5), T_SAMPLES], 1),
    "imu.integrate_gyroscope": Function(_integrated, lambda: [_turns(4, 5) / 0.3, KEYS, POSE[3:]], 1),
    "imu.strapdown": Function(
        _strapdown, lambda: [_turns(3, 5), normal(len(ROWS), 3, 3, seed=6), KEYS], 2
    ),
}  # fmt: skip
#: Hermite splines are compiled in test_hermite.py, on a smaller group.
COMPILED = [
    n
    for n in contract.SPLINES
    if not n.startswith("hermite") and (n, "compile", "general") not in contract.EXCEPTIONS
]
each_function = pytest.mark.parametrize("function", FUNCTIONS)


def flat(function: Function) -> Callable[..., Tensor]:
    """All results in a row: `(rows, ...)` or, of one row, `(...)`."""

    def call(*given: Tensor) -> Tensor:
        fields = function.call(*given)
        return torch.cat([x.flatten(-2) for x in fields if x.shape[-1] != 0], dim=-1)

    return call


def close(actual: Tensor, expected: Tensor, tolerance: float) -> bool:
    """Of each row relative to the largest number expected in it, at least to one; NaN is never close."""
    assert actual.shape == expected.shape
    error, size = (actual - expected).abs(), expected.abs()
    if actual.ndim > 1:
        error, size = error.flatten(1).amax(1), size.flatten(1).amax(1)
    return bool((error <= tolerance * size.clamp_min(1.0)).all())


def like(x: Tensor, seed: int) -> Tensor:
    return normal(max(x.numel(), 1), seed=seed).reshape(x.shape)


def leaves(function: Function) -> list[Tensor]:
    return [x.clone().requires_grad_() for x in function.make()]


@pytest.mark.contract(function="{function}", properties="first")
@each_function
def test_first_derivatives(function):
    call, given = flat(FUNCTIONS[function]), leaves(FUNCTIONS[function])
    precise = {"eps": 1e-7, "atol": 1e-6, "rtol": 1e-5, "fast_mode": True}
    assert torch.autograd.gradcheck(call, given, check_forward_ad=True, **precise)


@pytest.mark.contract(function="{function}", properties="second")
@each_function
def test_second_derivatives(function):
    call, given = flat(FUNCTIONS[function]), leaves(FUNCTIONS[function])
    precise = {"eps": 1e-7, "atol": 1e-5, "rtol": 1e-5, "fast_mode": True}
    assert torch.autograd.gradgradcheck(call, given, **precise)


@pytest.mark.contract(function="{function}", properties="forward finite")
@each_function
def test_forward_mode_is_dual_to_reverse_mode(function):
    """<g, J x> = <J^T g, x>, for each argument by itself, and for batched ones in each row."""
    call, given = flat(FUNCTIONS[function]), FUNCTIONS[function].make()
    y, backward = torch.func.vjp(call, *given)
    g = normal(*y.shape, seed=1)
    gradients = backward(g)
    for i, x in enumerate(given):
        rate = [like(z, seed=2) if j == i else torch.zeros_like(z) for j, z in enumerate(given)]
        ahead = g * torch.func.jvp(call, tuple(given), tuple(rate))[1]
        back = gradients[i] * rate[i]
        if i < FUNCTIONS[function].batched:
            left, right, size = ahead.sum(-1), back.flatten(1).sum(1), ahead.abs().sum(-1)
        else:
            left, right, size = ahead.sum(), back.sum(), ahead.abs().sum()
        assert torch.isfinite(gradients[i]).all()
        assert torch.all((left - right).abs() <= 1e-9 * size.clamp_min(1e-3)), (
            f"argument {i}, {tuple(x.shape)}"
        )


@pytest.mark.contract(function="{function}", properties="vmap")
@each_function
def test_vmap_is_a_loop(function):
    """Values and gradients, over rows of every regime."""
    call, given, batched = flat(FUNCTIONS[function]), FUNCTIONS[function].make(), FUNCTIONS[function].batched
    every = tuple(range(len(given)))
    weights = like(call(*given)[0], seed=1)

    def loss(*row: Tensor) -> Tensor:
        return (call(*row) * weights).sum()

    dims = tuple(0 if i < batched else None for i in every)
    loops = [[x[r] if i < batched else x for i, x in enumerate(given)] for r in range(len(ROWS))]
    assert close(
        torch.func.vmap(call, in_dims=dims)(*given), torch.stack([call(*row) for row in loops]), 1e-13
    )
    derivative = torch.func.grad(loss, every)
    mapped = torch.func.vmap(derivative, in_dims=dims)(*given)
    for whole, *parts in zip(mapped, *(derivative(*row) for row in loops), strict=True):
        assert close(whole, torch.stack(parts), 1e-11)


@pytest.mark.contract(function="{function}", properties="compile")
@pytest.mark.parametrize("function", COMPILED)
def test_compiled_is_eager(function):
    call, given = flat(FUNCTIONS[function]), leaves(FUNCTIONS[function])
    torch.compiler.reset()
    eager = call(*given)
    compiled = torch.compile(call, fullgraph=True, backend="aot_eager")(*given)
    assert close(compiled, eager, 1e-13)
    g = normal(*eager.shape, seed=1)
    for a, b in zip(*(torch.autograd.grad(y, given, g) for y in (compiled, eager)), strict=True):
        assert close(a, b, 1e-11)


@pytest.mark.contract(
    function="{function}", regimes="identity, small, general", dtypes="float32", properties="single"
)
@pytest.mark.contract(function="{function}", dtypes="float32", properties="finite")
@each_function
def test_single_precision(function):
    """float32 against float64 from the same rounded numbers; times stay in double precision."""
    call, batched = flat(FUNCTIONS[function]), FUNCTIONS[function].batched
    clocks = ("t", "dt", "t0", "knots", "times")
    names = contract.FUNCTIONS[function]
    rounded = [
        x if name in clocks else x.float() for x, name in zip(FUNCTIONS[function].make(), names, strict=True)
    ]
    results = []
    for dtype in (torch.float32, F64):
        given = [x.clone() if name in clocks else x.to(dtype) for x, name in zip(rounded, names, strict=True)]
        given = [x.requires_grad_() for x in given]
        y = call(*given)
        assert y.dtype == dtype
        weights = normal(*y.shape, seed=1).to(dtype)
        results.append((y.detach(), torch.autograd.grad((y * weights).sum(), given)))
        assert all(torch.isfinite(g).all() for g in results[-1][1])
        rows = torch.autograd.grad((call(*given) * weights)[:NEAR_PI].sum(), given)
        results[-1] = (y.detach()[:NEAR_PI], rows)
    (y, gradients), (y_double, gradients_double) = results
    assert close(y.double(), y_double, 3e-5)
    for i, (single, double) in enumerate(zip(gradients, gradients_double, strict=True)):
        rows = slice(0, NEAR_PI) if i < batched else slice(None)
        one, other = (x.double()[rows] if x.ndim else x.double() for x in (single, double))
        assert close(one, other, 5e-5 if i < batched else 2e-4)


# ---------------------------------------------------------------------- the contract and its page


def test_every_promise_has_a_test():
    claimed = contract.claimed()
    missing = [promise for promise in contract.promises() if promise not in claimed]
    assert not missing, f"{len(missing)} promises without a test, the first: {missing[:5]}"


def test_the_page_is_up_to_date():
    """What it says is what the markers claim; `.ci/run` compares it with what passed, too."""
    assert contract.PAGE.read_text(encoding="utf-8") == contract.render(contract.claimed())


def test_a_promise_without_a_test_is_seen(monkeypatch):
    others = tuple(module for module in contract.MODULES if module != "test_contract")
    monkeypatch.setattr(contract, "MODULES", others)
    claimed = contract.claimed()
    missing = {promise.function for promise in contract.promises() if promise not in claimed}
    assert "imu.measure" in missing
    assert "exp" not in missing
    assert contract.render(claimed) != contract.PAGE.read_text(encoding="utf-8")


def test_what_one_worker_broke_is_not_ticked(tmp_path, monkeypatch):
    kept = contract.Promise("log", "point", "float64", "general", "first")
    broken = contract.Promise("exp", "tangent", "float64", "general", "first")
    for worker in ("gw0", "gw1"):
        monkeypatch.setenv("PYTEST_XDIST_WORKER", worker)
        recorder = contract.Recorder(tmp_path)
        recorder.kept[kept].add("a")
        (recorder.broken if worker == "gw1" else recorder.kept)[broken].add("b")
        recorder.write()
    assert len(list(tmp_path.iterdir())) == 2
    assert contract.recorded(tmp_path) == {kept: {"a"}}


def test_markers_name_what_exists():
    mark = pytest.mark.contract(function="exp", arguments="point", properties="first").mark
    with pytest.raises(ValueError, match="no promise like"):
        list(contract.claims([mark], {}))
