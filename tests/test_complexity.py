"""The operation counts of `experiments/complexity.py`: [S20] Table 4 where it holds, and linear cost."""

import itertools
import sys
from collections import Counter
from pathlib import Path

import pytest
import sympy

from torchspline.arithmetic import scalar

sys.path.append(str(Path(__file__).resolve().parent.parent / "experiments"))

from counting import conventions, matrices, scalars

ORDERS = range(2, 8)


@pytest.fixture(scope="module")
def counts():
    """Counting checks by itself that derivatives equal finite differences and that counts suit every group."""
    counts, worst = matrices.count_matrices(ORDERS, u=0.37, seed=0)
    assert worst < 1e-8
    return counts


@pytest.fixture(scope="module")
def cells(counts):
    return {(c["column"], c["kind"]): c for c in conventions.compare(counts)}


def test_table_has_every_cell_once(cells):
    assert len(cells) == len(conventions.TABLE_4) == 15


def test_formulas_give_the_numbers_printed_for_cubic_splines(cells):
    assert all(sympy.sympify(c["table"]).subs("k", 4) == c["at_4"] for c in cells.values())


def test_equation_39_simplifies_as_claimed(cells):
    cell = cells["X'' baseline", "m-m"]
    assert sympy.simplify(f"{cell['text']} - ({cell['table']})") == 0


def test_every_cell_but_one_is_reproduced(cells):
    assert [key for key, c in cells.items() if not c["table_by"]] == [("X'' baseline", "add")]


def test_columns_of_x_second_are_reproduced_whole_by_known_velocities(cells):
    for column in ("X'' ours, any L", "X'' ours, SO(3)"):
        for kind in ("m-m", "m-v", "add"):
            assert "X, velocities known" in cells[column, kind]["table_by"]


def test_text_for_so3_includes_the_velocities(cells):
    cell = cells["X'' ours, SO(3)", "m-v"]
    assert "X known" in cell["text_by"]
    assert "X known" not in cell["table_by"]


def test_every_disagreement_is_explained_and_nothing_else(cells):
    assert all(bool(c["why"]) == conventions.differs(c) for c in cells.values())


def test_additions_of_the_product_rule_are_quadratic(counts):
    for algorithm, without in conventions.CONVENTIONS["X'' baseline"].values():
        added = conventions.totals(counts[algorithm], without)["add"]
        assert all(n < k * k for k, n in added.items())


@pytest.mark.parametrize("name", ["recursion, X'", "recursion, X''", "recursion, X'', SO(3)"])
def test_recursion_is_linear(counts, name):
    for kind, by_order in conventions.totals(counts[name]).items():
        assert sympy.degree(conventions.closed_form(by_order), conventions.K) <= 1, kind


def test_too_few_orders_for_a_closed_form_are_refused():
    with pytest.raises(AssertionError, match="more orders"):
        conventions.closed_form({2: 2, 3: 9, 4: 24})


@pytest.mark.parametrize("group", ["SO3", "SE3", "R3", "R3xSO3"])
@pytest.mark.parametrize("short", [True, False])
def test_component_arithmetic_is_linear(group, short):
    rows = scalars.scalar_rows([group], ORDERS, [0, 1, 2, 3], short, seed=0)
    assert len(rows) == 8
    for row in rows:
        totals = [row["counts"]["all"][k] for k in ORDERS]
        slopes = {b - a for a, b in itertools.pairwise(totals)}
        assert len(slopes) == 1
        assert totals[0] > 0


def test_short_steps_need_no_division_or_function():
    counts = scalars.count_components("SE3", 4, 2, short=True, seed=0)
    for sweep in counts.values():
        assert set(sweep) <= {"multiply", "add", "negate"}


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (lambda x: 2.0 * x + 1.0 - x, {"multiply": 1, "add": 2}),
        (lambda x: -(1.0 - x) / x, {"negate": 1, "add": 1, "divide": 1}),
        (lambda x: 1.0 / x, {"divide": 1}),
    ],
)
def test_counting_scalars_count_and_compute(expression, expected):
    counts = Counter()
    result = expression(scalars.CountingScalar(3.0, counts))
    assert result.value == expression(3.0)
    assert counts == expected


def test_range_reduction_counts_both_sides_of_its_choice():
    forward = scalars.count_components("SO3", 4, 0, short=False, seed=0)["forward"]
    exponentials = 3
    assert (forward["cos"], forward["sin"]) == (exponentials, exponentials)
    assert forward["select"] >= 2 * exponentials


def test_counting_scalars_count_functions():
    counts = Counter()
    x = scalars.CountingScalar(4.0, counts)
    assert scalar.sqrt(x).value == 2.0
    assert scalar.where(x > 5, 1.0, x).value == 4.0
    assert counts == {"sqrt": 1, "select": 1}
