"""Recurrences along time: loops, products of pairs and the definition agree, gradients of all orders included."""

import pytest
import torch

from torchspline import SO3, use_kernels
from torchspline.imu.scan import linear_recurrence, prefix, rotation_products

F32, F64 = torch.float32, torch.float64
MODES = pytest.mark.parametrize("mode", ["reference", "auto"])


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def numbers(*shape, seed=0):
    return torch.randn(shape, dtype=F64, generator=seeded(seed))


def one_by_one(factors, x):
    factors = factors.expand_as(x)
    rows = [x[..., 0, :]]
    for k in range(1, x.shape[-2]):
        rows.append(factors[..., k, :] * rows[-1] + x[..., k, :])
    return torch.stack(rows, -2)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 8, 33])
def test_prefixes_of_matrix_products_keep_their_order(count):
    steps = numbers(2, count, 4)

    def multiply(a, b):
        product = a[0].unflatten(-1, (2, 2)) @ b[0].unflatten(-1, (2, 2))
        return (product.flatten(-2),)

    (found,) = prefix(multiply, (steps,))
    assert found.shape == steps.shape
    product = torch.eye(2, dtype=F64)
    for k in range(count):
        product = product @ steps[:, k].unflatten(-1, (2, 2))
        assert torch.allclose(found[:, k], product.flatten(-2), rtol=1e-12, atol=1e-12)


@MODES
@pytest.mark.parametrize(
    "shape", [(), (1,), (3,), (9, 1), (9, 3), (4, 1, 1), (4, 9, 1), (4, 1, 3), (2, 1, 9, 3), (2, 4, 9, 3)]
)
def test_linear_recurrence_is_what_it_says(mode, shape):
    x, factors = numbers(2, 4, 9, 3), numbers(*shape, seed=1)
    with use_kernels(mode):
        assert torch.allclose(linear_recurrence(factors, x), one_by_one(factors, x), rtol=1e-12, atol=1e-12)
        transposed = x.mT.contiguous().mT
        assert torch.allclose(linear_recurrence(factors, transposed), one_by_one(factors, x))


@MODES
def test_linear_recurrence_of_few_samples_and_in_single_precision(mode):
    with use_kernels(mode):
        for count in (0, 1):
            x = numbers(2, count, 3)
            assert torch.equal(linear_recurrence(numbers(1), x), x)
        x, factors = numbers(3, 400, 2), numbers(3, 400, 1).tanh()
        found = linear_recurrence(factors.to(F32), x.to(F32))
        assert found.dtype == F32
        assert torch.allclose(found.double(), one_by_one(factors, x), rtol=1e-4, atol=1e-5)


def test_large_batches_are_shared_among_threads():
    x, factors = numbers(5, 3000, 3), 0.99 * torch.ones((), dtype=F64)
    before = torch.get_num_threads()
    try:
        results = []
        for count in (1, 3):
            torch.set_num_threads(count)
            with use_kernels("auto"):
                results.append(linear_recurrence(factors, x))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*results)
    assert torch.allclose(results[0], linear_recurrence(factors, x), rtol=1e-10, atol=1e-10)


@MODES
@pytest.mark.parametrize("shape", [(), (3,), (6, 1), (2, 1, 3), (2, 6, 3)])
def test_gradients_of_linear_recurrence(mode, shape):
    x, factors = numbers(2, 6, 3).requires_grad_(), numbers(*shape, seed=1).requires_grad_()
    with use_kernels(mode):
        assert torch.autograd.gradcheck(linear_recurrence, (factors, x))
        assert torch.autograd.gradgradcheck(linear_recurrence, (factors, x))


def test_transforms_of_linear_recurrence():
    x, factors = numbers(5, 7, 3), numbers(5, 7, 1, seed=1)
    with use_kernels("auto"):
        mapped = torch.func.vmap(linear_recurrence)(factors, x)
        assert torch.allclose(mapped, linear_recurrence(factors, x), rtol=1e-12, atol=1e-12)
        _, rate = torch.func.jvp(lambda f: linear_recurrence(f, x), (factors,), (torch.ones_like(factors),))
        (back,) = torch.autograd.functional.vjp(lambda f: linear_recurrence(f, x), factors, x)[1:]
        assert torch.allclose((rate * x).sum(), back.sum(), rtol=1e-9)


@MODES
@pytest.mark.parametrize("count", [0, 1, 2, 7, 20])
def test_rotation_products_are_those_of_matrices(mode, count):
    start, steps = SO3.random(2, generator=seeded(0)), SO3.exp(numbers(2, count, 3))
    with use_kernels(mode):
        found = rotation_products(start, steps)
    assert found.shape == (2, count + 1, 4)
    R = SO3.to_matrix(start)
    for k in range(count + 1):
        assert torch.allclose(SO3.to_matrix(found[:, k]), R, rtol=0, atol=1e-13)
        R = R @ SO3.to_matrix(steps[:, k]) if k < count else R


@MODES
def test_many_rotation_products_stay_rotations(mode):
    start = SO3.random(3, generator=seeded(0), dtype=F32)
    steps = SO3.exp(0.01 * numbers(3, 8000, 3).to(F32))
    with use_kernels(mode):
        found = rotation_products(start, steps)
    assert found.dtype == F32
    assert (found.norm(dim=-1) - 1).abs().max() < 3e-7
    exact = rotation_products(SO3.normalize(start.double()), SO3.normalize(steps.double()))
    assert (found.double() - exact).norm(dim=-1).max() < 1e-4


@MODES
def test_gradients_of_rotation_products(mode):
    start, tangents = SO3.random(2, generator=seeded(0)).requires_grad_(), numbers(2, 5, 3).requires_grad_()

    def products(start, tangents):
        return rotation_products(SO3.normalize(start), SO3.exp(tangents))

    with use_kernels(mode):
        assert torch.autograd.gradcheck(products, (start, tangents))
        assert torch.autograd.gradgradcheck(products, (start, tangents), atol=1e-4)
        mapped = torch.func.vmap(products)(start.detach(), tangents.detach())
        assert torch.allclose(mapped, products(start, tangents), rtol=0, atol=1e-14)


@MODES
def test_slow_rotations_add_up_in_single_precision(mode):
    """The earth's, seen at 200 Hz for ten minutes: a step is three times what a quaternion is rounded by."""
    angle, count = 7.3e-5 * 0.005, 120_000
    start = SO3.exp(torch.tensor([0.3, 0.2, 0.1], dtype=F64))
    steps = SO3.exp(torch.tensor([0.0, 0.0, angle])).expand(count, 4)
    with use_kernels(mode):
        last = rotation_products(start.to(F32), steps)[-1].to(F64)
    expected = SO3.compose(start, SO3.exp(torch.tensor([0.0, 0.0, count * angle], dtype=F64)))
    assert SO3.log(SO3.between(last, expected)).norm() < 1e-5
