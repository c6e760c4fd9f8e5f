"""The documentation: its code runs and prints what the pages say, its pictures exist, and no public name is missing."""

import contextlib
import doctest
import importlib
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib
import pytest
import torch

import torchspline
from torchspline import calibrate, convert, functional, generate, imu, io, people, plot, robot, view

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
    drawn = {path.name for path in tmp_path.glob("*.png")}
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


#: Modules whose public names the reference has to have, and those names where there is no `__all__`.
PUBLIC: dict[ModuleType, list[str] | None] = {
    torchspline: None, torchspline.fit: None, calibrate: None, functional: None, generate: None, imu: None, io: None,
    plot: None, robot: None, view: None,
    imu.earth: ["earth_rate", "normal_gravity", "dipole_field", "standard_pressure"],
    people: ["fit_body", "response", "Response"],
}  # fmt: skip


def reference() -> dict[str, Any]:
    """What stands in the reference, by the path it is given by, and the names in its text."""
    text = "".join(path.read_text(encoding="utf-8") for path in sorted((DOCS / "reference").glob("*.md")))
    found = {name: resolved(name) for name in re.findall(r"^::: (\S+)", text, re.M)}
    return found | dict.fromkeys(re.findall(r"`(torchspline\.[\w.]+)`", text))


def resolved(path: str) -> Any:
    """What is at a path of modules and names."""
    parts = path.split(".")
    for count in range(len(parts), 0, -1):
        with contextlib.suppress(ImportError):
            target: Any = importlib.import_module(".".join(parts[:count]))
            for part in parts[count:]:
                target = getattr(target, part)
            return target
    raise ImportError(path)


@pytest.mark.parametrize("module", PUBLIC, ids=lambda module: module.__name__)
def test_every_public_name_is_in_the_reference(module):
    found = reference()
    there = {id(x) for x in found.values() if x is not None}
    names = PUBLIC[module] or module.__all__
    public = {name: getattr(module, name) for name in names if not name.startswith("__")}
    missing = [
        name
        for name, x in public.items()
        if id(x) not in there and f"{module.__name__}.{name}" not in found and not isinstance(x, ModuleType)
    ]
    assert not missing, f"not in torchspline/docs/reference: {missing}"


def test_table_of_residuals():
    text = (DOCS / "reference" / "fit.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| \(N, (\w)\) \|", text, re.M))
    residuals = {
        name: x
        for name, x in vars(torchspline.fit).items()
        if isinstance(x, type)
        and issubclass(x, torchspline.fit.Residual)
        and x is not torchspline.fit.Residual
    }
    assert set(rows) == set(residuals), "a line for each residual"
    for name, kind in residuals.items():
        of_group = "P" if name == "StateValue" else "D"
        assert rows[name] == (of_group if kind.measured_size is None else str(kind.measured_size)), name


def test_the_reference_says_what_things_are():
    for path, x in reference().items():
        if x is None:
            continue
        assert x.__doc__, f"{path} has no docstring"
        module, name = getattr(x, "__module__", ""), getattr(x, "__qualname__", "")
        if module.endswith(f".{name}"):  # Griffe would take the module of that name
            assert path == f"{module}.{name}"


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
