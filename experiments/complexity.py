"""Counts the operations of spline derivatives: [S20] Table 4, and the component arithmetic of this library.

`counting.matrices` runs earlier work's algorithm and the paper's on matrices that count, `counting.conventions`
fits formulas in the order k and compares them with the paper's, `counting.scalars` runs this library's recurrences
on numbers that count.
"""

from pathlib import Path
from typing import Any

from common import Table, run, save, show
from counting.conventions import CONVENTIONS, SCALAR_COST, closed_form, compare, differs, totals
from counting.matrices import Counts, count_matrices
from counting.scalars import KINDS, scalar_rows
from matplotlib.figure import Figure


def pretty(formula: object) -> str:
    text = "-" if formula is None else str(formula)
    return text.replace("**2", "²").replace("**3", "³").replace("*", "").replace(" ", "")


def matrix_tables(counts: dict[str, Counts], cells: list[dict[str, Any]]) -> list[Table]:
    comparison, disagreements, forms = [], [], []
    for c in cells:
        formulas = (c["column"], c["kind"], *(pretty(c[name]) for name in ("table", "text", "counted_form")))
        at_4 = (c["at_4"], c["counted"].get(4, "-"))
        by_any = len(c["table_by"]) == len(CONVENTIONS[c["column"]])
        table_by = "any" if by_any else "; ".join(c["table_by"]) or "none"
        comparison.append((*formulas, *at_4, "yes" if c["table_agrees"] else "NO", table_by))
        if differs(c):
            disagreements.append((*formulas, "; ".join(c["text_by"]) or "-", c["why"]))
    for column in CONVENTIONS.values():
        for name, (algorithm, without) in column.items():
            found = totals(counts[algorithm], without).values()
            forms.append((algorithm, name, *(pretty(closed_form(c)) for c in found)))
    heading = ("column", "kind", "table", "text", "counted")
    return [
        Table(
            "[S20] Table 4 and what was counted",
            (*heading, "table, k=4", "counted, k=4", "same", "the table counts"),
            comparison,
        ),
        Table("Where table, text and count differ", (*heading, "the text counts", "why"), disagreements),
        Table(
            "All that was counted ('scalar': for 3x3 matrices, without exponentials)",
            ("algorithm", "what counts", *SCALAR_COST, "all additions", "scalar"),
            forms,
        ),
    ]


def scalar_table(rows: list[dict[str, Any]], order: int) -> Table:
    kinds = [kind for kind in KINDS if any(any(r["counts"][kind].values()) for r in rows)]
    cells = []
    for r in rows:
        numbers = (r["counts"][kind][order] for kind in (*kinds, "all"))
        cells.append((r["group"], r["derivatives"], r["sweep"], *numbers, pretty(r["forms"]["all"])))
    title = f"Scalar operations of the component arithmetic, k = {order} (reverse: beyond the forward sweep)"
    return Table(title, ("group", "derivatives", "sweep", *kinds, "all", "all, any k"), cells)


STYLES = {
    "product rule, X''": "C3o-",
    "product rule, X'": "C1s-",
    "product rule, recursive": "C4v--",
    "recursion, X''": "C0o-",
    "recursion, X'', SO(3)": "C9^-",
    "recursion, X'": "C2s-",
}


def draw(counts: dict[str, Counts], rows: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, style in STYLES.items():
        scalars = totals(counts[name])["scalar"]
        left.plot(scalars.keys(), scalars.values(), style, label=name)
    left.set_title("SO(3) as 3x3 matrices (recursion: with X)")
    left.legend(fontsize=8, loc="upper left")

    derivatives = min(2, max(r["derivatives"] for r in rows))
    chosen = [r for r in rows if r["derivatives"] == derivatives]
    for i, r in enumerate(chosen):  # two sweeps of each group
        scalars, style = r["counts"]["all"], "o-" if r["sweep"] == "forward" else "s--"
        right.plot(scalars.keys(), scalars.values(), f"C{i // 2}{style}", label=f"{r['group']}, {r['sweep']}")
    right.set_title(f"Component arithmetic, {derivatives} derivatives")
    right.legend(fontsize=8, loc="lower right", ncols=2)
    for axes in (left, right):
        axes.set(xlabel="order k of the spline", ylabel="scalar operations", yscale="log")
        axes.set_xticks(sorted(scalars))
        axes.grid(True, which="both", alpha=0.25)
    return figure


def experiment(
    out: Path, orders: list[int], groups: list[str], derivatives: list[int], short: bool, u: float, seed: int
) -> dict[str, Any]:
    """Counts matrix operations ([S20] Table 4) and scalar operations of spline derivatives, by order.

    Args:
        orders: orders k of the splines, five or more, so that a cubic count shows as one.
        groups: groups whose component arithmetic is counted.
        derivatives: numbers of derivatives, 0 to 3.
        short: whether steps promise a rotation of at most pi, as those of B-splines do.
        u: where in the segment the derivatives are taken, inside (0, 1).
        seed: of the random control points.
    """
    counts, worst = count_matrices(orders, u, seed)
    cells = compare(counts)
    rows = scalar_rows(groups, orders, derivatives, short, seed)
    show(out, [*matrix_tables(counts, cells), scalar_table(rows, 4 if 4 in orders else orders[0])])
    print(f"largest relative difference between the derivatives and finite differences: {worst:.1e}")
    save(draw(counts, rows), out / "complexity.png")
    return {
        "table_4": cells,
        "disagreements": [f"{c['column']}, {c['kind']}" for c in cells if differs(c)],
        "matrix_operations": counts,
        "scalar_operations": rows,
        "largest_difference": worst,
    }


if __name__ == "__main__":
    run(experiment, smoke={"orders": [2, 3, 4, 5, 6], "groups": ["SO3", "R3"], "derivatives": [0, 2]})
