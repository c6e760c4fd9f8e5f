"""Explicit Jacobians of B-splines against forward-mode differentiation, golden numbers and a worked example."""

import json

import pytest
import torch
from numpy.testing import assert_allclose

import torchspline as ts
from torchspline.functional import bspline
from torchspline.groups import R3, SE3, SO3, Rn, product

float64 = torch.float64
GROUPS = [SO3, SE3, product(R3, SO3), Rn(2)]


def random_spline(group, order, seed, batch=(2,), count=9, dtype=float64, size=0.4):
    generator = torch.Generator().manual_seed(seed)
    steps = size * torch.randn(*batch, count, group.tangent_size, generator=generator, dtype=float64)
    points = group.exp(steps.cumsum(-2)).to(dtype)
    t = 0.7 * (count - order + 1) * torch.rand(*batch, 6, generator=generator, dtype=float64)
    return ts.BSpline(points, group=group, order=order, dt=0.7), t


def outputs(spline, points, t, reference, side):
    """Tangent of the value from a reference one, on a side, and the derivatives: (..., N, 4, D)."""
    group = spline.group
    state = bspline(points, t, group=group, order=spline.order, dt=spline.dt, derivatives=3, validate=False)
    back = group.inverse(reference, validate=False)
    pair = (state.value, back) if side == "left" else (back, state.value)
    moved = group.log(group.compose(*pair, validate=False), validate=False)
    return torch.stack([moved, state.velocity, state.acceleration, state.jerk], dim=-2)


#: Kernels for one order: the side is a matter of what comes after them.
WAYS = [("reference", side, order) for side in ("left", "right") for order in (2, 4, 5)] + [
    ("fused", "left", 4)
]


@pytest.mark.parametrize(("mode", "side", "order"), WAYS)
@pytest.mark.parametrize("group", GROUPS, ids=str)
def test_equal_to_forward_mode(group, order, side, mode):
    spline, t = random_spline(group, order, seed=order)
    points = spline.control_points.detach()
    reference = spline(t).detach()
    with ts.use_kernels(mode):
        jacobians = spline.jacobians(t, derivatives=3, side=side)
    D, N = group.tangent_size, t.shape[-1]

    def of_points(delta):
        return outputs(spline, group.retract(points, delta, side=side, validate=False), t, reference, side)

    def of_time(t):
        return outputs(spline, points, t, reference, side)

    dense = torch.func.jacfwd(of_points)(torch.zeros(2, 9, D, dtype=float64))
    by_time = torch.func.jvp(of_time, (t,), (torch.ones_like(t),))[1]
    assert_allclose(jacobians.time, by_time, rtol=0, atol=1e-13 * float(1 + by_time.abs().max()))
    assert jacobians.first.shape == (2, N)
    for fewer in range(3):
        with ts.use_kernels(mode):
            fields = spline.jacobians(t, derivatives=fewer, side=side)
        assert all(x is None for x in fields[2 + fewer : 5])
        assert_allclose(
            fields.time, by_time[..., : fewer + 1, :], rtol=0, atol=1e-13 * float(1 + by_time.abs().max())
        )
        for ours, expected in zip(fields[1 : 2 + fewer], jacobians[1 : 2 + fewer], strict=True):
            assert torch.equal(ours, expected)
    for r, ours in enumerate(jacobians[1:5]):
        assert ours.shape == (2, N, order, D, D)
        expected = torch.zeros(2, N, 9, D, D, dtype=float64)
        for b in range(2):
            for n in range(N):
                expected[b, n, jacobians.first[b, n] : jacobians.first[b, n] + order] = ours[b, n]
        whole = torch.stack([dense[b, :, r, :, b].transpose(1, 2) for b in range(2)])
        assert_allclose(whole, expected, rtol=0, atol=1e-13 * float(1 + whole.abs().max()))


def test_worked_example_of_the_docstring():
    spline = ts.BSpline(torch.randn(6, 1, dtype=float64), group=Rn(1), order=4, dt=0.5)
    jacobians = spline.jacobians(torch.tensor([0.25], dtype=float64), derivatives=1)
    assert_allclose(
        jacobians.value[0, :, 0, 0], torch.tensor([1.0, 23.0, 23.0, 1.0], dtype=float64) / 48, rtol=1e-14
    )
    assert_allclose(
        jacobians.velocity[0, :, 0, 0], torch.tensor([-0.25, -1.25, 1.25, 0.25], dtype=float64), rtol=1e-14
    )
    still = ts.BSpline(SO3.identity(6), group=SO3, order=4, dt=0.5)
    jacobians = still.jacobians(torch.tensor(0.25, dtype=float64), derivatives=1)
    weights = torch.tensor([1.0, 23.0, 23.0, 1.0], dtype=float64) / 48
    expected = weights[:, None, None] * torch.eye(3, dtype=float64)
    assert_allclose(jacobians.value, expected, atol=1e-14)
    assert jacobians.first.shape == ()
    assert jacobians.acceleration is None


def test_nanoseconds_and_float32():
    spline, t = random_spline(SE3, 4, seed=0, batch=())
    stamps = (t * 1e9).round().long()
    points = spline.control_points.detach()
    exact = spline.jacobians(stamps.double() * 1e-9)
    clocked = ts.BSpline(points, group=SE3, order=4, dt_ns=700_000_000, t0_ns=1_700_000_000_000_000_000)
    nanoseconds = clocked.jacobians(stamps + 1_700_000_000_000_000_000)
    single = ts.BSpline(points.float(), group=SE3, order=4, dt=0.7).jacobians(stamps.double() * 1e-9)
    for ours, rough, expected in zip(nanoseconds, single, exact, strict=True):
        if expected is None:
            assert ours is None
            continue
        assert_allclose(ours, expected, rtol=0, atol=1e-12 * float(1 + expected.abs().max()))
        if expected.dtype == float64:
            assert rough.dtype == torch.float32
            assert_allclose(rough, expected, rtol=0, atol=3e-5 * float(1 + expected.abs().max()))


@pytest.mark.parametrize("step", [0.0, 1e-12, 1e-6, 1e-3, 3.141592])
def test_close_and_far_neighbours(step):
    """Between tiny and ordinary angles, where series meet closed forms, and within 1e-6 of a half-turn."""
    generator = torch.Generator().manual_seed(3)
    axis = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=float64), dim=0)
    points = SO3.exp(step * torch.arange(6)[:, None] * axis)
    spline = ts.BSpline(points, group=SO3, order=4, dt=0.7)
    t = torch.tensor([0.1, 0.9, 2.0], dtype=float64)
    with ts.use_kernels("auto"):
        jacobians = spline.jacobians(t, derivatives=2)
    reference = spline(t).detach()

    def of_points(delta):
        moved = SO3.retract(points, delta, validate=False)
        return outputs(spline, moved, t, reference, "left")

    dense = torch.func.jacfwd(of_points)(torch.zeros(6, 3, dtype=float64))
    for r, ours in enumerate(jacobians[1:4]):
        for n in range(3):
            first = int(jacobians.first[n])
            expected = dense[n, r][:, first : first + 4].transpose(0, 1)
            assert_allclose(ours[n], expected, rtol=0, atol=1e-11 * float(1 + expected.abs().max()))


@pytest.mark.realdata
@pytest.mark.parametrize("order", [4, 5, 6])
@pytest.mark.parametrize("name", ["so3", "rd"])
def test_golden_numbers(shared_data, name, order):
    path = shared_data / "golden" / f"{name}.json"
    if not path.is_file():
        pytest.skip(f"{path} is missing")
    golden = next(s for s in json.loads(path.read_text())["sets"] if s["order"] == order)
    group, knots = (SO3, "knots_wxyz") if name == "so3" else (R3, "knots")
    spline = ts.BSpline(
        torch.tensor(golden[knots], dtype=float64), group=group, order=order, dt_ns=golden["dt_ns"],
        t0_ns=golden["t0_ns"],
    )  # fmt: skip
    stamps = torch.tensor([q["t_ns"] for q in golden["queries"]])
    jacobians = spline.jacobians(stamps, derivatives=3)
    assert jacobians.first.tolist() == [q["seg"] for q in golden["queries"]]
    fields = ("J_value", "J_vel", "J_acc") if name == "so3" else ("w_value", "w_vel", "w_acc", "w_jerk")
    for ours, field in zip(jacobians[1:], fields, strict=False):
        which = [i for i, q in enumerate(golden["queries"]) if field in q]
        assert len(which) >= 5
        expected = torch.tensor([golden["queries"][i][field] for i in which], dtype=float64)
        if name == "rd":
            expected = expected[..., None, None] * torch.eye(3, dtype=float64)
        error = (ours[which] - expected).abs().max() / expected.abs().max()
        assert float(error) < 1e-11
