"""The figures of the documentation, and what its pages print."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
from common import Table, run, show
from pages import DOCS, blocks, figures, run_page, same_output


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def experiment(out: Path, pages: list[str], publish: bool, seed: int) -> dict[str, Any]:
    """Draws the pictures of the conventions, runs pages of the documentation, and puts their figures in their place.

    Args:
        out: folder for the results.
        pages: names of pages below `torchspline/docs`, or `all` for those with code.
        publish: whether figures replace those in `torchspline/docs/figures`.
        seed: recorded; pages set their own.
    """
    names = pages
    if pages == ["all"]:
        names = [p.relative_to(DOCS).as_posix() for p in sorted(DOCS.rglob("*.md")) if blocks(p)]
    matplotlib.use("agg")
    drawn = figures.draw(out)
    rows: list[list[Any]] = []
    for name in names:
        (out / "figures").mkdir(exist_ok=True)
        with _inside(out):
            for block, printed, _ in run_page(DOCS / name):
                shown = block.output is not None
                same = same_output(printed, block.output or "") if shown else "-"
                rows.append([name, block.line, "yes" if same is True else "NO" if shown else "-"])
                if same is False:
                    print(f"{name}, line {block.line} prints:\n{printed}")
    drawn += sorted((out / "figures").glob("*.png")) if (out / "figures").is_dir() else []
    if publish:
        for path in drawn:
            shutil.copy(path, DOCS / "figures" / path.name)
    rows += [[path.name, "-", "-"] for path in drawn]
    show(out, [Table("Pages and figures", ["page or figure", "line", "prints what it shows"], rows)])
    return {"figures": [path.name for path in drawn], "blocks": len(rows) - len(drawn), "seed": seed}


if __name__ == "__main__":
    run(experiment, smoke={"pages": [], "publish": False})
