"""The stories as notebooks: made from the pages, in step with them, and they run. Needs the extra `docs`."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parent.parent / "experiments"))

nbformat = pytest.importorskip("nbformat", reason="no Jupyter: pip install -c constraints.txt -e '.[docs]'")
notebooks = pytest.importorskip(
    "pages.notebooks", reason="no Jupyter: pip install -c constraints.txt -e '.[docs]'"
)

from pages import blocks, same_output  # noqa: E402

STORIES = pytest.mark.parametrize("page", notebooks.STORIES, ids=lambda page: page.stem)
REMAKE = "python experiments/documentation.py makes them anew"


def committed(page):
    return nbformat.read(page.with_suffix(".ipynb"), as_version=4)


def test_there_are_three_stories():
    assert {page.stem for page in notebooks.STORIES} >= {"exposure", "inertial", "calibration"}


@STORIES
def test_cells_are_those_of_the_page(page):
    there, made = committed(page), notebooks.notebook(page)
    nbformat.validate(there)
    assert [(x.cell_type, x.source) for x in there.cells] == [(x.cell_type, x.source) for x in made.cells], (
        REMAKE
    )
    assert there.metadata == made.metadata, "metadata of whoever ran it"
    code = [x.source for x in made.cells if x.cell_type == "code"]
    assert code[0] == "%matplotlib inline"
    assert len(code) == 1 + len(blocks(page))
    assert not any("savefig" in x or x.startswith("```text") for x in code)


@STORIES
def test_outputs_are_those_of_the_page(page):
    cells = [x for x in committed(page).cells if x.cell_type == "code"][1:]
    pictures = 0
    for cell, block in zip(cells, blocks(page), strict=True):
        assert cell.execution_count
        if block.output is not None:
            assert same_output(notebooks.printed(cell), block.output), (
                f"{page.name}, line {block.line}; {REMAKE}"
            )
        pictures += sum("image/png" in x.get("data", {}) for x in cell.outputs)
        assert not any(x.output_type == "error" for x in cell.outputs)
    assert pictures == page.read_text(encoding="utf-8").count("savefig(")


@STORIES
def test_notebooks_are_linked_and_small(page):
    path = page.with_suffix(".ipynb")
    assert f"({path.name})" in page.read_text(encoding="utf-8")
    assert path.stat().st_size < 200_000


def test_a_notebook_runs(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# A page\n\nText.\n\n```python\nfrom matplotlib.figure import Figure\n\nx = 2\nprint(x + 1)\n```\n"
        "```text\n3\n```\n\n```python\nfigure = Figure()\naxes = figure.subplots()\n"
        'figure.savefig("x.png")\n```\n\n![x](x.png)\n',
        encoding="utf-8",
    )
    text = page.read_text(encoding="utf-8")
    made = notebooks.notebook(page)
    assert page.read_text(encoding="utf-8") == text
    ran = notebooks.run_notebook(made, tmp_path)
    code = [x for x in ran.cells if x.cell_type == "code"]
    assert notebooks.printed(code[1]) == "3\n"
    assert any("image/png" in x.get("data", {}) for x in code[2].outputs)
    assert not (tmp_path / "x.png").exists()
    assert "![" not in "".join(x.source for x in ran.cells)


@pytest.mark.slow
def test_a_story_runs_as_a_notebook(tmp_path):
    """One of them: the others take as long, and are the same code as their pages, which tests/test_docs.py runs."""
    page = next(x for x in notebooks.STORIES if x.stem == "exposure")
    ran = notebooks.run_notebook(notebooks.notebook(page), tmp_path)
    cells = [x for x in ran.cells if x.cell_type == "code"][1:]
    for cell, block in zip(cells, blocks(page), strict=True):
        if block.output is not None:
            assert same_output(notebooks.printed(cell), block.output)
