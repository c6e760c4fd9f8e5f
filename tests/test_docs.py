"""The documentation: its code runs and prints what the pages say, its pictures exist, and no public name is missing."""

import doctest
import importlib
import re
import sys
from pathlib import Path

import matplotlib
import pytest
import torch

import torchspline
from torchspline import convert, functional, generate, imu, io, people, robot

sys.path.append(str(Path(__file__).resolve().parent.parent / "experiments"))

from pages import DOCS, blocks, images, pages, run_page, same_output

PAGES = [page.relative_to(DOCS).as_posix() for page in pages()]
WITH_CODE = [name for name in PAGES if blocks(DOCS / name)]


def test_there_are_pages():
    assert {"index.md", "tutorial.md", "conventions.md", "reference/fit.md"} <= set(PAGES)


@pytest.mark.parametrize("name", WITH_CODE)
def test_code_runs_and_prints_what_is_shown(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["page"])
    matplotlib.use("agg")
    figures = tmp_path / "figures"
    figures.mkdir()
    seed = torch.get_rng_state()
    try:
        for block, printed, _ in run_page(DOCS / name):
            if block.output is not None:
                assert same_output(printed, block.output), (
                    f"{name}, line {block.line}: printed\n{printed}\nbut shows\n{block.output}"
                )
    finally:
        torch.set_rng_state(seed)
    shown = {path.name for path in images(DOCS / name)}
    drawn = {path.name for path in figures.iterdir()}
    assert drawn <= shown, f"{name} draws {drawn - shown}, which it does not show"


@pytest.mark.parametrize("name", PAGES)
def test_pictures_exist(name):
    missing = [path for path in images(DOCS / name) if not path.is_file()]
    assert not missing, f"missing; python experiments/documentation.py draws them: {missing}"


def test_every_picture_is_shown():
    shown = {path for name in PAGES for path in images(DOCS / name)}
    assert {path.resolve() for path in (DOCS / "figures").iterdir()} == shown


def test_outputs_are_compared():
    assert same_output("a 1.0001 b", "a 1.0  b")
    assert same_output("0.1234 rad", "0.123 rad")
    assert same_output("3e-16", "1.2e-15")
    assert not same_output("a 1.2", "a 1.0")
    assert not same_output("a 1.0", "b 1.0")
    assert not same_output("1.0 1.0", "1.0")
    assert not same_output("-2.5e-3", "2.5e-3")
    assert not same_output("nan", "1.0")


#: Where each set of public names stands; `torchspline.fit` and the rest are listed by their own page.
PUBLIC = {
    "torchspline": [n for n in torchspline.__all__ if n not in ("fit", "functional", "imu")],
    "torchspline.fit": [n for n in torchspline.fit.__all__ if n not in torchspline.__all__],
    "torchspline.functional": functional.__all__,
    "torchspline.imu": imu.__all__,
    "torchspline.imu.earth": ["earth_rate", "normal_gravity", "dipole_field", "standard_pressure"],
    "torchspline.io": io.__all__,
    "torchspline.robot": robot.__all__,
    "torchspline.people": ["fit_body", "response", "Response"],
    "torchspline.generate": generate.__all__,
}


#: Those that `import torchspline` does not bring in.
MODULES = {f"torchspline.{m.__name__.split('.')[1]}": m for m in (generate, io, people, robot)}


def reference() -> str:
    return "".join(path.read_text(encoding="utf-8") for path in sorted((DOCS / "reference").glob("*.md")))


@pytest.mark.parametrize("module", PUBLIC)
def test_every_public_name_is_in_the_reference(module):
    text = reference()
    missing = [n for n in PUBLIC[module] if not re.search(rf"{re.escape(module)}\.{n}\b", text)]
    assert not missing, f"not in torchspline/docs/reference: {missing}"


def test_the_reference_names_what_exists():
    for name in re.findall(r"^::: (\S+)", reference(), re.M):
        parts = name.split(".")
        target = MODULES.get(".".join(parts[:2]), getattr(torchspline, parts[1], None))
        for part in parts[2:]:
            target = getattr(target, part)
        assert target.__doc__, f"{name} has no docstring"


def test_conversions_have_docstrings():
    names = [name for name in vars(convert) if name.startswith(("to_", "from_", "pose_"))]
    assert len(names) > 15
    assert all(getattr(convert, name).__doc__ for name in names)


# ---------------------------------------------------------------------- examples in docstrings

PACKAGE = Path(torchspline.__file__).parent
WITH_EXAMPLES = [
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


def test_the_most_used_functions_have_examples():
    assert {"torchspline.splines.bspline", "torchspline.groups.group", "torchspline.fit.problem"} <= set(
        WITH_EXAMPLES
    )


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_in_docstrings(module):
    found = doctest.testmod(importlib.import_module(module), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert found.attempted > 0
    assert found.failed == 0
