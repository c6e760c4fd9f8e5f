"""Records of poses and IMU samples, and stamps that are exact to the nanosecond."""

from decimal import Decimal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from io_cases import STAMP, imu, poses
from properties import examples

from torchspline.io import PoseRecord
from torchspline.io.text import format_seconds, parse_seconds


def test_seconds_lose_nothing_at_epoch_stamps():
    record = poses([STAMP, STAMP + 1, STAMP + 10**9])
    assert record.time.tolist() == [0.0, 1e-9, 1.0]
    assert record.time.dtype == torch.float64
    assert record.seconds(STAMP + 1).tolist() == [-1e-9, 0.0, 0.999999999]
    assert record.seconds(0)[0].item() == STAMP / 1e9


@pytest.mark.parametrize("make", [poses, imu])
def test_window_includes_both_ends_and_keeps_order(make):
    record = make([STAMP + 5, STAMP, STAMP + 1, STAMP + 1, STAMP + 9])
    part = record.window(STAMP + 1, STAMP + 5)
    assert type(part) is type(record)
    assert part.time_ns.tolist() == [STAMP + 5, STAMP + 1, STAMP + 1]
    for column in record._widths:
        assert torch.equal(getattr(part, column), getattr(record, column)[[0, 2, 3]])
    assert (len(record), len(record.window(0, 1))) == (5, 0)
    assert record.window(0, 1).time.shape == (0,)
    with pytest.raises(TypeError):
        record.window(float(STAMP), STAMP + 5)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"time_ns": torch.zeros(2)},
            TypeError,
            "PoseRecord.time_ns: expected torch.int64, got torch.float32",
        ),
        ({"time_ns": torch.tensor(1)}, ValueError, r"PoseRecord.time_ns: expected shape \(N,\), got \(\)"),
        ({"position": torch.zeros(2, 3)}, TypeError, "position: expected torch.float64"),
        ({"position": np.zeros((2, 3))}, TypeError, "position: expected a tensor, got ndarray"),
        (
            {"rotation": torch.zeros(2, 3).double()},
            ValueError,
            r"rotation: expected shape \(N, 4\), got \(2, 3\)",
        ),
        ({"rotation": torch.zeros(3, 4).double()}, ValueError, "rotation: expected 2 rows .*, got 3"),
    ],
)
def test_records_check_their_columns(change, error, message):
    columns = {"time_ns": torch.tensor([0, 1]), "position": torch.zeros(2, 3).double()}
    columns["rotation"] = torch.ones(2, 4).double()
    PoseRecord(**columns)
    with pytest.raises(error, match=message):
        PoseRecord(**(columns | change))


# Stamps


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1305031098.6659", 1305031098665900000),
        ("1520530308.189679", 1520530308189679000),
        ("1520530308.189679351", STAMP),
        ("-0.000000001", -1),
        ("-1520530308.189679351", -STAMP),
        ("9223372036.854775807", 2**63 - 1),
        ("-9223372036.854775808", -(2**63)),
        ("1.037359e-01", 103735900),
        ("0.000000e+00", 0),
        ("0e999999", 0),
        ("1e-999999", 0),
        ("17", 17 * 10**9),
        (".5", 500000000),
        ("1305031098.66590023040771484375", 1305031098665900230),
        ("0.0000000005", 0),
        ("0.0000000015", 2),
    ],
)
def test_decimal_seconds_become_exact_nanoseconds(text, expected):
    assert parse_seconds(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "nan",
        "inf",
        "-inf",
        "",
        "1_0",
        "1.2.3",
        "0x10",
        "1e999999",
        "1e99999999999999999999",
        "9223372036.854775808",
    ],
)
def test_times_that_are_no_time(text):
    with pytest.raises(ValueError):
        parse_seconds(text)


@given(st.integers(-(2**63), 2**63 - 1))
@examples(200)
def test_seconds_as_text_round_trip(time_ns):
    assert Decimal(format_seconds(time_ns)) == Decimal(time_ns).scaleb(-9)
    assert parse_seconds(format_seconds(time_ns)) == time_ns
