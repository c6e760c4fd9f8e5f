"""Seconds and nanoseconds: against exact fractions."""

from fractions import Fraction

import pytest
import torch
from numpy.testing import assert_allclose

from torchspline import units

F32, F64, I64 = torch.float32, torch.float64, torch.int64
EPOCH = 1_700_000_000_123_456_789


def test_differences_of_an_epoch_keep_their_digits():
    steps = [0, 1, 999_999_999, 10**9, 86_400 * 10**9 + 7]
    t = torch.tensor([EPOCH + step for step in steps])
    exact = [float(Fraction(step, 10**9)) for step in steps]
    for found in (units.seconds(t - EPOCH), units.seconds_since(t, EPOCH)):
        assert found.dtype == F64
        assert_allclose(found, exact, rtol=3e-16)
    assert units.nanoseconds(units.seconds_since(t, EPOCH)).tolist() == steps


@pytest.mark.parametrize("dtype", [F32, F64])
def test_seconds_stay_as_they_are(dtype):
    t = torch.tensor([0.1, -2.5, 1e3], dtype=dtype)
    assert units.unit_of(t) == 1.0
    assert units.seconds(t).equal(t.double())
    assert units.seconds_since(t, 0.5).equal(t.double() - 0.5)


def test_whole_nanoseconds_are_the_nearest():
    x = torch.tensor([0.3, -0.3, 1.4e-9, 1.6e-9, 123.456789012], dtype=F64)
    found = units.nanoseconds(x)
    assert found.dtype == I64
    assert found.tolist() == [round(Fraction(v) * 10**9) for v in x.tolist()]
    assert units.unit_of(found) * units.SECOND == pytest.approx(1.0, abs=1e-15)
