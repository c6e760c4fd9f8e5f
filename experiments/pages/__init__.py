"""The code in the pages of the documentation: found, run, and compared with what the pages show.

The Python blocks of a page run in order in one namespace. A block of text right behind one is what it prints: its
numbers agree to the digits that are shown, or nearly (see `same_output`). Blocks in other languages do not run.
"""

import contextlib
import io
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch

DOCS = Path(__file__).resolve().parents[2] / "torchspline" / "docs"

_BLOCK = re.compile(r"^```python\n(.*?)^```\n(?:\n?```text\n(.*?)^```)?", re.S | re.M)
_IMAGE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?", re.I)


class Block(NamedTuple):
    code: str
    output: str | None
    line: int


def pages() -> list[Path]:
    """All pages of the documentation."""
    return sorted(DOCS.rglob("*.md"))


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    return [Block(m[1], m[2], text.count("\n", 0, m.start()) + 2) for m in _BLOCK.finditer(text)]


def images(page: Path) -> list[Path]:
    """The pictures a page shows."""
    return [(page.parent / name).resolve() for name in _IMAGE.findall(page.read_text(encoding="utf-8"))]


def run_page(page: Path) -> Iterator[tuple[Block, str, dict]]:
    """Runs a page block by block; each with what it printed and the namespace so far.

    Figures go to the current folder. Tracebacks name the page and the line in it. One thread: the tensors
    are small, and threads of several processes would wait for each other.
    """
    torch.manual_seed(0)
    names: dict = {"__name__": "page"}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for block in blocks(page):
            printed = io.StringIO()
            code = compile("\n" * (block.line - 1) + block.code, str(page), "exec")
            with contextlib.redirect_stdout(printed):
                exec(code, names)
            yield block, printed.getvalue(), names
    finally:
        torch.set_num_threads(threads)


def same_output(printed: str, shown: str, relative: float = 0.05) -> bool:
    """Whether two outputs have the same words, and numbers that agree to a part in twenty or to one of the last digit
    shown; those below 1e-9 in size, which are rounding errors, need only both be so."""

    def words(text: str) -> list[str]:
        return _NUMBER.sub("#", text).split()

    if words(printed) != words(shown):
        return False
    for one, other in zip(_NUMBER.findall(printed), _NUMBER.findall(shown), strict=True):
        a, b = float(one), float(other)
        digit = 10.0 ** -len(other.lower().partition("e")[0].partition(".")[2])
        last = 1.01 * digit * (10.0 ** float(other.lower().partition("e")[2] or 0))
        if not (abs(a - b) <= last or math.isclose(a, b, rel_tol=relative) or max(abs(a), abs(b)) < 1e-9):
            return False
    return True
