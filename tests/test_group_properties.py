"""What holds for every group and any numbers, looked for with Hypothesis where float arithmetic is at its edges."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

import torchspline as ts
from torchspline import Group

F32, F64 = torch.float32, torch.float64
GROUPS = ("SO3", "SE3", "DualQuaternion", "SO2", "SE2", "R3", "R3xSO3", "SE2xR2xSO3")
EPS = torch.finfo(F64).eps

#: Lengths on every scale, and those where something changes: subnormal, where squares underflow, series end, pi.
lengths = st.one_of(
    st.sampled_from(
        [
            0.0,
            5e-324,
            1e-310,
            1e-200,
            1e-162,
            1.5e-154,
            1e-16,
            1e-8,
            1.2e-4,
            1e-3,
            0.1,
            1.0,
            math.pi / 2,
            3.0,
            3.14,
        ]
    ),
    st.floats(-300.0, 0.0).map(lambda e: 10.0**e),
    st.floats(0.0, 3.14),
)
coordinates = st.one_of(st.sampled_from([0.0, -0.0, 1.0, -1.0, 5e-324, 1e-200]), st.floats(-1.0, 1.0))
distances = st.one_of(st.just(0.0), st.floats(-1e3, 1e3), st.floats(-12.0, 3.0).map(lambda e: 10.0**e))


@st.composite
def tangents(draw, name):
    """(D,), rotations shorter than pi in any direction, distances up to a kilometre."""
    parts = []
    for factor in name.split("x"):
        rotation = {"SO3": 3, "SE3": 3, "DualQuaternion": 3, "SO2": 1, "SE2": 1}.get(factor, 0)
        place = {"SE3": 3, "DualQuaternion": 3, "SE2": 2}.get(factor, 0) or (
            0 if rotation else int(factor[1:])
        )
        parts += [draw(distances) for _ in range(place)]
        if rotation:
            direction = torch.tensor([draw(coordinates) for _ in range(rotation)], dtype=F64)
            largest = direction.abs().max()
            direction = direction / largest if largest > 0 else torch.ones(rotation, dtype=F64)
            parts += (direction / direction.norm() * draw(lengths)).tolist()
    return torch.tensor(parts, dtype=F64)


def close(a, b, tolerance=1e-13, scale=1.0):
    assert torch.isfinite(a).all()
    assert torch.isfinite(b).all()
    error = (a - b).abs().max().item()
    assert error <= tolerance * scale, (
        f"{error:.2e} apart, {tolerance * scale:.1e} allowed: {a.tolist()}, {b.tolist()}"
    )


def size(*tensors):
    """How large numbers get where these are put together."""
    return 1.0 + sum(x.abs().max().item() for x in tensors)


each_group = pytest.mark.parametrize("name", GROUPS)
fast = examples(40)


@each_group
def test_log_undoes_exp(name):
    group = Group(name)

    @fast
    @given(tangents(name))
    def check(x):
        back = group.log(group.exp(x))
        # A rotation near pi is known to what its quaternion tells; a translation bends by as much.
        close(back, x, 1e-12, size(x))
        again = group.exp(back)
        close(group.log(group.between(again, group.exp(x))), torch.zeros_like(x), 1e-12, size(x))

    check()


@each_group
def test_composition_is_associative_and_has_inverses(name):
    group = Group(name)

    @fast
    @given(tangents(name), tangents(name), tangents(name))
    def check(x, y, z):
        a, b, c = group.exp(x), group.exp(y), group.exp(z)
        left = group.compose(group.compose(a, b), c)
        right = group.compose(a, group.compose(b, c))
        scale = size(x, y, z)
        close(group.to_matrix(left), group.to_matrix(right), 1e-14, scale)
        identity = group.to_matrix(group.identity(dtype=F64))
        close(group.to_matrix(group.compose(a, group.inverse(a))), identity, 1e-14, scale)
        close(group.to_matrix(group.compose(b, group.between(b, c))), group.to_matrix(c), 1e-14, scale)

    check()


@each_group
def test_the_adjoint_moves_tangents_across(name):
    """`X Exp(v) = Exp(Ad_X v) X`, `Ad_(XY) = Ad_X Ad_Y`, and `adjoint_act` is that matrix."""
    group = Group(name)

    @fast
    @given(tangents(name), tangents(name))
    def check(x, v):
        X = group.exp(x)
        v = v / size(v)  # so that what it is moved to turns by less than pi
        moved = group.adjoint_act(X, v)
        scale = size(x) * size(v)
        close(moved, group.adjoint(X) @ v, 1e-14, scale)
        left = group.to_matrix(group.compose(X, group.exp(v)))
        right = group.to_matrix(group.compose(group.exp(moved), X))
        close(left, right, 1e-13, scale)
        Y = group.exp(v)
        close(group.adjoint(group.compose(X, Y)), group.adjoint(X) @ group.adjoint(Y), 1e-13, scale**2)

    check()


@each_group
@pytest.mark.parametrize("dtype", [F32, F64])
def test_length_and_sign_of_stored_numbers_do_not_matter(name, dtype):
    """Quaternions and [cos, sin] of any length from 1e-15 to 1e15 are the same rotation, and so are q and -q."""
    group = Group(name)
    blocks = group.arithmetic.unit_blocks
    eps = torch.finfo(dtype).eps
    signs = st.sampled_from([1.0, -1.0])

    @fast
    @given(tangents(name), tangents(name), st.floats(-15.0, 15.0), signs)
    def check(x, y, exponent, sign):
        a, b = group.exp(x).to(dtype), group.exp(y).to(dtype)
        other = a.clone()
        for start, stop in blocks:
            flip = sign if stop - start == 4 else 1.0
            # A dual quaternion has one length: its dual part is scaled along.
            end = 8 if name == "DualQuaternion" else stop
            other[start:end] = a[start:end] * (flip * 10.0**exponent)
        scale = size(x, y)
        close(group.to_matrix(other), group.to_matrix(a), 16 * eps, scale)
        # Near pi the short way round may be either: compare what is the same both ways.
        close(group.to_matrix(group.compose(other, b)), group.to_matrix(group.compose(a, b)), 16 * eps, scale)
        close(group.to_matrix(group.inverse(other)), group.to_matrix(group.inverse(a)), 16 * eps, scale)
        close(group.adjoint(other), group.adjoint(a), 32 * eps, scale)
        halfway = group.interpolate(other, group.compose(other, b), 0.5)
        assert torch.isfinite(halfway).all()

    check()


@each_group
def test_gradients_are_finite_at_the_edges(name):
    group = Group(name)

    @examples(25)
    @given(tangents(name), tangents(name))
    def check(x, y):
        x = x.clone().requires_grad_()
        X = group.exp(x)
        found = torch.autograd.grad(group.log(group.compose(X, group.exp(y))).sum(), x)[0]
        assert torch.isfinite(found).all()
        point = X.detach().clone().requires_grad_()
        found = torch.autograd.grad(group.log(point).sum(), point)[0]
        assert torch.isfinite(found).all()
        for start, stop in group.arithmetic.unit_blocks:  # nothing depends on the length
            along = (found[start:stop] * point.detach()[start:stop]).sum()
            assert name == "DualQuaternion" or along.abs() <= 1e-10 * (1 + found.abs().max()) * size(
                x.detach()
            )

    check()


def test_every_named_group_is_tried():
    from torchspline.arithmetic.registry import GROUPS as REGISTERED

    single = {name for name in REGISTERED if "x" not in name and not name.startswith("R")}
    assert single <= {factor for name in GROUPS for factor in name.split("x")}
    assert ts.SO3.name in single
