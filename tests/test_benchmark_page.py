"""The page of the benchmark is made of `experiments/benchmark.json`, and of nothing else."""

import copy
import json
import re
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parent.parent / "experiments"))

from bench import document
from bench.sections import SECTIONS
from bench.tables import TABLES


@pytest.fixture(scope="module")
def runs():
    return json.loads(document.RECORD.read_text(encoding="utf-8"))["runs"]


def test_the_page_is_that_of_the_record(runs):
    again = "python experiments/benchmark.py --publish true measures and writes both"
    assert document.PAGE.read_text(encoding="utf-8") == document.document(runs), again


def test_every_section_has_tables_and_figures(runs):
    assert list(SECTIONS) == list(TABLES)
    assert set(TABLES) <= {name for run in runs for name in run["figures"]}
    for run in runs:
        assert run["config"]["shrink"] == 1
        assert run["machine"]["processor"] in document.document([run])


def test_goals_are_met_or_not_as_the_page_says(runs):
    rows = next(run["figures"]["goals"] for run in reversed(runs) if "goals" in run["figures"])
    bounded = [row for row in rows if row["bound"] is not None]
    assert len(bounded) > 10
    for row in bounded:
        reached = row["median"] >= row["bound"] if row["at_least"] else row["median"] <= row["bound"]
        assert (row["met"] == "yes") == reached, row["goal"]


def test_figures_of_the_record_are_those_of_the_page(runs):
    changed = copy.deepcopy(runs)
    row = changed[0]["figures"]["groups"][0]
    row["ns_per_query_min"] = 98765.4
    page = document.document(changed)
    assert "98765 (" in page
    assert "98765" not in document.document(runs)
    changed[0]["figures"]["queries"] = changed[0]["figures"]["queries"][:1]
    assert document.document(changed).count("\n") < page.count("\n")


def test_a_later_run_replaces_its_sections_and_says_so(runs, tmp_path):
    first = {**runs[0], "figures": {**runs[0]["figures"], "jacobians": runs[-1]["figures"]["jacobians"]}}
    slower = [{**row, "seconds_min": 7.0, "seconds_median": 8.0} for row in first["figures"]["processes"]]
    part = {
        **first,
        "figures": {"processes": slower, "deviations": [], "notes": [], "peers": {}},
        "machine": {**first["machine"], "processor": "Another"},
    }
    record, page = tmp_path / "benchmark.json", tmp_path / "benchmark.md"
    for run, count in ((first, 1), (part, 2), (part, 2), (first, 1)):
        document.publish(run, record, page)
        assert len(json.loads(record.read_text(encoding="utf-8"))["runs"]) == count
        text = page.read_text(encoding="utf-8")
        if count == 2:
            assert re.search(r"## New processes: seconds\n\nFrom a later run: Another, .*\n\n\|", text)
            assert "| import beyond torch | 7.000 | 8.000 |" in text
            assert text.count("From a later run") == 1
        else:
            assert text == document.document([first])
            assert "From a later run" not in text
