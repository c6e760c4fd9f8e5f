"""What the guide says of schemes is what is measured, and what `experiments/survey.py` decides."""

import re
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parent.parent
GUIDE = ROOT / "torchspline" / "docs" / "guides" / "choosing.md"
sys.path.append(str(ROOT / "experiments"))

from interpolation.choose import NEEDS, choices, page  # noqa: E402
from interpolation.figures import figure_5_drawn  # noqa: E402
from interpolation.measure import properties  # noqa: E402
from interpolation.orders import FAMILIES, family_order, needs, order  # noqa: E402

from torchspline.splines.interpolation import SURVEY  # noqa: E402


@pytest.fixture(scope="module")
def measured():
    return {name: properties(name, seed=3) for name in SURVEY}


def rows() -> dict[str, tuple[list[str], str]]:
    """Of the guide's table of schemes: names and reasons by need."""
    found = {}
    for line in GUIDE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and cells[0] in NEEDS:
            found[cells[0]] = (re.findall(r'`"([^"]+)"`', cells[1]), cells[2])
    return found


def test_table_of_the_guide(measured):
    told = rows()
    assert {need: names for need, (names, _) in told.items()} == choices(measured)
    for names, reason in told.values():
        (smooth,), (expected,) = re.findall(r"C(\d)", reason), re.findall(r"order (\d)", reason)
        segments = re.findall(r"moves (\d) segments", reason)
        for name in names:
            case = measured[name]
            assert case["continuous_derivatives"] == int(smooth)
            assert segments == [str(case["segments_moved_by_a_key"])] if case["local"] else not segments
        # One of each row is enough here; the experiment measures all.
        assert abs(order(names[-1], seed=1) - int(expected)) < 0.3


def test_hermite_orders():
    for kind, expected in (("product", 3), ("logarithm", 6)):
        assert abs(family_order(f'HermiteSpline "{kind}", SE3', seed=1) - expected) < 0.3


def test_page(measured):
    """Names the best of what it is given, whatever that is."""
    cases = {name: {**x, "order": 2.0} for name, x in measured.items()}
    slow = {"numbers": 70, "ns": 30.0, "order": 2.0}
    families = {
        "a": slow,
        "b": {**slow, "numbers": 60},
        "c": {**slow, "ns": 20.0},
        "d": {**slow, "order": 5.0},
    }
    text = page(cases, dict.fromkeys(cases, 1.0), families, 1e-3)
    for pattern in (
        r"fewest numbers \| b \| 60 numbers",
        r"fastest \| c \| 20 ns",
        r"nearer \| d \| order 5\.0",
    ):
        assert re.search(pattern, text), pattern


def test_needs():
    found = needs('HermiteSpline "logarithm", SE3', 1e-2, batch=10, repetitions=1, seed=0)
    assert found["numbers"] % 20 == 0  # 7 + 6 + 6 + 1 a knot
    assert found["ns"] > 0
    assert set(FAMILIES)


def test_figure_5_as_its_caption_says(tmp_path):
    """The first two frames of DLB before those of SE3Up, the last two after."""
    with torch.no_grad():
        found = figure_5_drawn(tmp_path)
    ahead = [x for name, x in found.items() if name.startswith("angle_of_DLB")]
    assert [x > 0 for x in ahead] == [False, False, True, True]
    assert (tmp_path / "figure_5.png").is_file()
