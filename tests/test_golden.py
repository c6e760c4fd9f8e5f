"""Values, derivatives and Jacobians of an established C++ library at 17 digits.

Its Jacobians are for perturbations of the knots on the left; the value's rows are a tangent on the left, too.
"""

import json

import pytest
import torch

from torchspline.functional import bspline
from torchspline.groups import R3, SO3

pytestmark = pytest.mark.realdata
TOLERANCE = {torch.float64: 1e-11, torch.float32: 1e-5}
each_dtype = pytest.mark.parametrize("dtype", TOLERANCE, ids=("float64", "float32"))
each_order = pytest.mark.parametrize("order", [4, 5, 6])
#: Both readings of the same stamps.
each_clock = pytest.mark.parametrize("clock", ["seconds", "nanoseconds"])


def relative(actual, expected):
    """The largest error, in units of the largest number of the field over all queries."""
    assert actual.shape == expected.shape
    assert expected.abs().max() > 0
    return float((actual.double() - expected).abs().max() / expected.abs().max())


@pytest.fixture
def golden(shared_data, request):
    group, order = request.getfixturevalue("group"), request.getfixturevalue("order")
    name = "so3" if group is SO3 else "rd"
    path = shared_data / "golden" / f"{name}.json"
    if not path.is_file():
        pytest.skip(f"{path} is missing")
    sets = [s for s in json.loads(path.read_text())["sets"] if s["order"] == order]
    assert len(sets) == 1
    assert len(sets[0]["queries"]) >= 20
    return sets[0]


def table(golden, field):
    """The queries that have the field (Jacobians are given for some of them), and its numbers."""
    rows = [(i, q[field]) for i, q in enumerate(golden["queries"]) if field in q]
    assert len(rows) >= 5
    return torch.tensor([i for i, _ in rows]), torch.tensor([x for _, x in rows], dtype=torch.float64)


def evaluate(points, golden, clock, group, order, derivatives=3, validate=True):
    stamps = torch.tensor([q["t_ns"] for q in golden["queries"]])
    if clock == "nanoseconds":
        times = {"t": stamps, "t0_ns": golden["t0_ns"], "dt_ns": golden["dt_ns"]}
    else:
        times = {"t": stamps.double() * 1e-9, "t0": golden["t0"], "dt": golden["dt"]}
    return bspline(points, group=group, order=order, derivatives=derivatives, validate=validate, **times)


@pytest.mark.parametrize("group", [SO3, R3], ids=str)
@each_order
@each_clock
@each_dtype
def test_values_and_derivatives(golden, group, order, clock, dtype):
    fields = (
        ("value_wxyz", "vel_body", "acc_body", "jerk_body")
        if group is SO3
        else ("value", "vel", "acc", "jerk")
    )
    points = torch.tensor(golden["knots_wxyz" if group is SO3 else "knots"], dtype=dtype)
    state = evaluate(points, golden, clock, group, order)
    for r, (ours, field) in enumerate(zip(state, fields, strict=True)):
        which, expected = table(golden, field)
        assert len(which) == len(ours)
        assert ours.dtype == dtype
        if r == 0 and group is SO3:
            expected = expected * (expected * ours.double()).sum(-1, keepdim=True).sign()
        assert relative(ours, expected) < TOLERANCE[dtype]


@pytest.mark.parametrize("group", [SO3], ids=str)
@each_order
@each_clock
@each_dtype
@pytest.mark.parametrize("mode", [torch.func.jacrev, torch.func.jacfwd])
def test_so3_jacobians(golden, group, order, clock, dtype, mode):
    knots = torch.tensor(golden["knots_wxyz"], dtype=dtype)
    origin = SO3.inverse(evaluate(knots, golden, clock, group, order, derivatives=0).value)

    def outputs(delta):
        moved = SO3.retract(knots, delta, side="left", validate=False)
        state = evaluate(moved, golden, clock, group, order, derivatives=2, validate=False)
        turned = SO3.log(SO3.compose(state.value, origin, validate=False), validate=False)
        return turned, state.velocity, state.acceleration

    jacobians = mode(outputs)(torch.zeros(len(knots), 3, dtype=dtype))
    segments = torch.tensor([q["seg"] for q in golden["queries"]])
    active = segments[:, None] + torch.arange(order)
    for ours, field in zip(jacobians, ("J_value", "J_vel", "J_acc"), strict=True):
        which, given = table(golden, field)
        expected = torch.zeros(len(which), len(knots), 3, 3, dtype=torch.float64)
        expected[torch.arange(len(which))[:, None], active[which]] = given  # of all other knots: zero
        assert relative(ours.transpose(1, 2)[which], expected) < TOLERANCE[dtype]


@pytest.mark.parametrize("group", [R3], ids=str)
@each_order
@each_clock
@each_dtype
@pytest.mark.parametrize("mode", [torch.func.jacrev, torch.func.jacfwd])
def test_r3_jacobians(golden, group, order, clock, dtype, mode):
    knots = torch.tensor(golden["knots"], dtype=dtype)
    jacobians = mode(lambda p: tuple(evaluate(p, golden, clock, group, order, validate=False)))(knots)
    segments = torch.tensor([q["seg"] for q in golden["queries"]])
    for ours, field in zip(jacobians, ("w_value", "w_vel", "w_acc", "w_jerk"), strict=True):
        expected = torch.zeros(len(segments), 3, len(knots), 3, dtype=torch.float64)
        which, given = table(golden, field)
        assert len(which) == len(segments)
        for query, (segment, weights) in enumerate(zip(segments, given, strict=True)):
            for axis in range(3):
                expected[query, axis, segment : segment + order, axis] = weights
        assert relative(ours, expected) < TOLERANCE[dtype]
