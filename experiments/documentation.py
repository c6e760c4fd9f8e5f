"""The figures of the documentation, what its pages print, and the stories as notebooks (extra `docs`)."""

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
    """Draws the pictures of the conventions, runs pages and stories as notebooks, and puts the results in their place.

    Args:
        out: folder for the results.
        pages: names of pages below `torchspline/docs`, or `all` for those with code.
        publish: whether figures and notebooks replace those in `torchspline/docs`.
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
        with _inside(out / "figures"):
            for block, printed, _ in run_page(DOCS / name):
                shown = block.output is not None
                same = same_output(printed, block.output or "") if shown else "-"
                rows.append([name, block.line, "yes" if same is True else "NO" if shown else "-"])
                if same is False:
                    print(f"{name}, line {block.line} prints:\n{printed}")
    drawn += sorted((out / "figures").glob("*.png")) if (out / "figures").is_dir() else []
    stories = [DOCS / name for name in names if name.startswith("stories/")]
    written = []
    if stories:
        try:
            from pages import notebooks
        except ModuleNotFoundError as error:
            raise SystemExit(
                f"pages: stories need {error.name}: pip install -c constraints.txt -e '.[docs]'"
            ) from None
        written = [notebooks.write(page, out) for page in stories]
    if publish:
        for path in drawn:
            shutil.copy(path, DOCS / "figures" / path.name)
        for path in written:
            shutil.copy(path, DOCS / "stories" / path.name)
    rows += [[path.name, "-", "-"] for path in [*drawn, *written]]
    show(
        out, [Table("Pages and figures", ["page, figure or notebook", "line", "prints what it shows"], rows)]
    )
    return {
        "figures": [path.name for path in drawn],
        "blocks": len(rows) - len(drawn) - len(written),
        "seed": seed,
    }


if __name__ == "__main__":
    run(experiment, smoke={"pages": [], "publish": False})
