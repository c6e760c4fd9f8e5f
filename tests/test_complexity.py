"""The operation counts of `experiments/complexity.py`: [S20] Table 4 where it holds, and linear cost."""

import importlib
import itertools
import sys
from pathlib import Path

import pytest
import sympy

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
ORDERS = range(2, 8)


@pytest.fixture(scope="module")
def complexity():
    sys.path.insert(0, str(EXPERIMENTS))
    try:
        yield importlib.import_module("complexity")
    finally:
        sys.path.remove(str(EXPERIMENTS))


@pytest.fixture(scope="module")
def counts(complexity):
    """Counting checks by itself that derivatives equal finite differences and that counts suit every group."""
    counts, worst = complexity.count_matrices(ORDERS, u=0.37, seed=0)
    assert worst < 1e-8
    return counts


@pytest.fixture(scope="module")
def cells(complexity, counts):
    return {(c["column"], c["kind"]): c for c in complexity.compare(counts)}


def test_table_has_every_cell_once(complexity, cells):
    assert len(cells) == len(complexity.TABLE_4) == 15


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


def test_every_disagreement_is_explained_and_nothing_else(complexity, cells):
    assert all(bool(c["why"]) == complexity.differs(c) for c in cells.values())


def test_additions_of_the_product_rule_are_quadratic(complexity, counts):
    for convention in complexity.CONVENTIONS["X'' baseline"]:
        added = complexity.totals(convention, counts)["add"]
        assert all(n < k * k for k, n in added.items())


@pytest.mark.parametrize("name", ["recursion, X'", "recursion, X''", "recursion, X'', SO(3)"])
def test_recursion_is_linear(complexity, counts, name):
    for kind, by_order in complexity.totals(complexity.Convention("all", name), counts).items():
        assert sympy.degree(complexity.closed_form(by_order), complexity.K) <= 1, kind


def test_too_few_orders_for_a_closed_form_are_refused(complexity):
    with pytest.raises(AssertionError, match="more orders"):
        complexity.closed_form({2: 2, 3: 9, 4: 24})


@pytest.mark.parametrize("group", ["SO3", "SE3", "R3", "R3xSO3"])
@pytest.mark.parametrize("short", [True, False])
def test_component_arithmetic_is_linear(complexity, group, short):
    rows = complexity.scalar_rows([group], ORDERS, [0, 1, 2, 3], short, seed=0)
    assert len(rows) == 8
    for row in rows:
        totals = [row["counts"]["all"][k] for k in ORDERS]
        slopes = {b - a for a, b in itertools.pairwise(totals)}
        assert len(slopes) == 1
        assert totals[0] > 0


def test_short_steps_need_no_division_or_function(complexity):
    counts = complexity.count_components("SE3", 4, 2, short=True, seed=0)
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
def test_counting_scalars_count_and_compute(complexity, expression, expected):
    counts = complexity.Counter()
    result = expression(complexity.CountingScalar(3.0, counts))
    assert result.value == expression(3.0)
    assert counts == expected


def test_range_reduction_counts_both_sides_of_its_choice(complexity):
    forward = complexity.count_components("SO3", 4, 0, short=False, seed=0)["forward"]
    exponentials = 3
    assert (forward["cos"], forward["sin"]) == (exponentials, exponentials)
    assert forward["select"] >= 2 * exponentials


def test_counting_scalars_count_functions(complexity):
    counts = complexity.Counter()
    x = complexity.CountingScalar(4.0, counts)
    assert complexity.scalar.sqrt(x).value == 2.0
    assert complexity.scalar.where(x > 5, 1.0, x).value == 4.0
    assert counts == {"sqrt": 1, "select": 1}
