"""Pages as notebooks: the same text and code, run, with the outputs of that run.

`python experiments/documentation.py` writes them beside the pages of `torchspline/docs/stories`, and a test holds them
in step with those. Jupytext makes cells of a page, nbclient runs them.
"""

import os
import re
from pathlib import Path

import jupytext
from nbclient import NotebookClient
from nbformat import NotebookNode
from nbformat import write as write_json
from nbformat.v4 import new_code_cell, new_markdown_cell

from pages import DOCS

STORIES = sorted((DOCS / "stories").glob("*.md"))

_OUTPUT = re.compile(r"^(```\n)\n?```text\n.*?^```\n", re.S | re.M)
_PICTURE = re.compile(r"^!\[[^\]]*\]\([^)]+\)\n", re.M)
_LINK = re.compile(r"^\[[^\]]*\]\(\w+\.ipynb\)[^\n]*\n", re.M)
_SAVE = re.compile(r"^figure\.savefig\([^\n]*\)$", re.M)


def notebook(page: Path) -> NotebookNode:
    """The cells of a page, not yet run. What the page shows as output is left out, figures are shown and not saved."""
    text = page.read_text(encoding="utf-8")
    for what, instead in ((_OUTPUT, r"\1"), (_PICTURE, ""), (_LINK, ""), (_SAVE, "figure")):
        text = what.sub(instead, text)
    found = jupytext.reads(text, fmt="md")
    root = DOCS.parents[1]
    name = page.relative_to(root).as_posix() if page.is_relative_to(root) else page.name
    found.cells.insert(1, new_markdown_cell(f"Made from `{name}`. It needs torchspline and matplotlib."))
    found.cells.insert(2, new_code_cell("%matplotlib inline"))
    for i, cell in enumerate(found.cells):
        cell.id = f"cell-{i}"  # the same in every run
        cell.metadata = NotebookNode()
        if cell.source.startswith("%%sh\n"):  # commands to read, on files that are not there
            found.cells[i] = new_markdown_cell(f"```sh\n{cell.source[5:]}\n```", id=cell.id)
    found.metadata = NotebookNode(
        kernelspec={"display_name": "Python 3", "language": "python", "name": "python3"},
        language_info={"name": "python"},
    )
    found.nbformat, found.nbformat_minor = 4, 5
    return found


def run_notebook(cells: NotebookNode, folder: Path) -> NotebookNode:
    """Runs all cells in a new kernel, in that folder, in one thread as the pages; they get their outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed; the message has its traceback.
    """
    information = cells.metadata.language_info
    client = NotebookClient(
        cells,
        timeout=300,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute(env={**os.environ, "OMP_NUM_THREADS": "1"})
    cells.metadata.language_info = information  # not the version of this Python
    return cells


def printed(cell: NotebookNode) -> str:
    """What a cell printed."""
    return "".join(x.text for x in cell.outputs if x.output_type == "stream" and x.name == "stdout")


def write(page: Path, folder: Path) -> Path:
    """Runs a page as a notebook and writes it to a folder."""
    path = folder / f"{page.stem}.ipynb"
    write_json(run_notebook(notebook(page), folder), path)
    return path
