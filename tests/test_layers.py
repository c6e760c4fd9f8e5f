"""The layers of the package: imports go downward only, and no file grows beyond 500 lines."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = "torchspline"
ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted((ROOT / PACKAGE).rglob("*.py"))

# From the bottom to the top; those of one row stand side by side and do not import each other.
LAYERS = [
    {"checks", "errors", "units"},
    {"arithmetic"},
    {"kernels"},
    {"groups"},
    {"splines"},
    {"imu"},
    {"fit"},
    {"functional", "robot", "people", "io", "plot"},
    {"generate", "calibrate", "view", "explore"},
    {"cli"},
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
# The same within `fit`, whose `__init__` stands above all of it. Those of one row may import each other.
FIT_LAYERS = [
    {"losses", "variables"},
    {"residual"},
    {"residuals", "solving"},
    {"result", "smoothness"},
    {"problem"},
    {"alignment", "batch", "online", "poses"},
    {"approximation"},
]
FIT_RANK = {name: rank for rank, names in enumerate(FIT_LAYERS) for name in names}
# The public names: what `import torchspline` may bring in. Nothing in the package imports this.
TOP = ""
TOP_MAY_IMPORT = {name for name, rank in RANK.items() if rank <= RANK["fit"]} | {"functional"}
OUTSIDE = {"tests", "experiments", "conftest"}
UNCLEAR = "<relative>"
DYNAMIC_IMPORTS = {"import_module", "__import__"}


def imported(tree: ast.AST, package: list[str]) -> Iterator[tuple[int, str]]:
    """Line and dotted name of all that `tree` imports, a module in `package` (its dotted path).

    `from a import b` gives `a.b`, whether `b` is a module or a name in one.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            keep = len(package) + 1 - node.level
            base = [] if not node.level else package[:keep] if keep > 0 else [UNCLEAR]
            base = base + node.module.split(".") if node.module else base
            yield from ((node.lineno, ".".join([*base, alias.name])) for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in DYNAMIC_IMPORTS:
            name = node.args[0].value if node.args and isinstance(node.args[0], ast.Constant) else ""
            if isinstance(name, str):
                yield node.lineno, UNCLEAR if name.startswith(".") else name


def objection(own: str, name: str) -> str | None:
    """Why a module of layer `own` (TOP: the public names) must not import `name` (dotted); None if it may."""
    first, target = [*name.split("."), ""][:2]
    if first in OUTSIDE:
        return "stands above the package"
    if first == UNCLEAR:
        return "cannot be told"
    if first != PACKAGE or own == target != TOP:
        return None
    if target not in RANK:
        return "comes from the package top level, or else: add it to the layer table"
    if own == TOP:
        return None if target in TOP_MAY_IMPORT else f"{target} is not below the public names"
    if RANK[target] == RANK[own]:
        return f"{target} and {own} stand side by side"
    return f"{target} is above {own}" if RANK[target] > RANK[own] else None


def violations(source: str, module: str) -> list[str]:
    """What is wrong with the imports of `source`, the text of `module` (a package: `x.__init__`)."""
    parts = module.split(".")
    own = TOP if parts[1] == "__init__" else parts[1]
    if own != TOP and own not in RANK:
        return [f"{module}: unknown layer {own!r}: add it to the layer table"]
    checked = ((line, name, objection(own, name)) for line, name in imported(ast.parse(source), parts[:-1]))
    return [f"{module}, line {line}: {name}: {why}" for line, name, why in checked if why]


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def test_there_is_something_to_check():
    assert {"torchspline.io.records", "torchspline.io.__init__"} <= set(map(dotted, MODULES))


@pytest.mark.parametrize("path", MODULES, ids=dotted)
def test_imports_go_downward(path):
    problems = violations(path.read_text(encoding="utf-8"), dotted(path))
    assert not problems, "\n".join(problems)


def upward_in_fit(source: str, module: str) -> list[str]:
    """Imports of `module` (`torchspline.fit.x`) from layers of `fit` above its own."""
    parts, found = module.split("."), []
    for line, name in imported(ast.parse(source), parts[:-1]):
        package, layer, target = [*name.split("."), "", ""][:3]
        if (package, layer) == (PACKAGE, "fit") and FIT_RANK[target] > FIT_RANK[parts[2]]:
            found.append(f"{module}, line {line}: {target} is above {parts[2]}")
    return found


@pytest.mark.parametrize("path", [p for p in MODULES if dotted(p).count(".fit.")], ids=dotted)
def test_imports_within_fit_go_downward(path):
    if dotted(path) != f"{PACKAGE}.fit.__init__":
        assert upward_in_fit(path.read_text(encoding="utf-8"), dotted(path)) == []


def test_upward_imports_within_fit_are_found():
    source = "from torchspline.fit.variables import Variable\nfrom ..problem import Problem"
    (problem,) = upward_in_fit(source, f"{PACKAGE}.fit.solving.x")
    assert problem == f"{PACKAGE}.fit.solving.x, line 2: problem is above solving"


@pytest.mark.parametrize("path", MODULES, ids=dotted)
def test_files_stay_short(path):
    count = len(path.read_text(encoding="utf-8").splitlines())
    assert count <= 500, f"{dotted(path)} has {count} lines; split it"


@pytest.mark.parametrize(
    ("module", "source", "message"),
    [
        ("groups.so3", "import torchspline.splines.bspline", "splines is above groups"),
        ("groups.so3", "import torchspline.splines as s", "splines is above groups"),
        ("groups.so3", "from torchspline import splines", "splines is above groups"),
        ("groups.so3", "from torchspline.splines import BSpline", "splines is above groups"),
        ("groups.so3", "from torchspline.fit.problem import Problem", "fit is above groups"),
        ("groups.so3", "from ..splines import BSpline", "splines is above groups"),
        ("groups.so3", "from .. import splines", "splines is above groups"),
        ("groups.__init__", "from .. import splines", "splines is above groups"),
        ("groups.a.b", "from ...splines import x", "splines is above groups"),
        (
            "groups.so3",
            "def f():\n    if x:\n        import torchspline.splines",
            "line 3: .*splines is above",
        ),
        ("groups.so3", "import math, torchspline.cli", "cli is above groups"),
        ("kernels.x", "importlib.import_module('torchspline.groups')", "groups is above kernels"),
        ("kernels.x", "importlib.import_module('.groups', x)", "cannot be told"),
        ("checks", "from torchspline.arithmetic import series", "arithmetic is above checks"),
        ("checks", "from torchspline import errors", "errors and checks stand side by side"),
        ("io.tum", "from torchspline import plot", "plot and io stand side by side"),
        ("robot", "from .io import read_imu", "io and robot stand side by side"),
        ("io.tum", "import torchspline", "from the package top level"),
        ("io.tum", "from torchspline import SO3", "from the package top level"),
        ("io.tum", "from torchspline import *", "from the package top level"),
        ("io.tum", "from .. import __version__", "from the package top level"),
        ("cli", "from . import SO3", "from the package top level"),
        ("functional", "from torchspline import SO3", "from the package top level"),
        ("functional", "from torchspline.cli import main", "cli is above functional"),
        ("__init__", "from torchspline.cli import main", "cli is not below the public names"),
        ("__init__", "from .io import read_imu", "io is not below the public names"),
        ("__init__", "import torchspline", "from the package top level"),
        ("fit.x", "from tests.conftest import y", "stands above the package"),
        ("fit.x", "import experiments.frequency", "stands above the package"),
        ("fit.x", "from .... import y", "cannot be told"),
        ("fit.x", "from torchspline.novelty import y", "add it to the layer table"),
        ("novelty", "import math", "unknown layer 'novelty': add it to the layer table"),
        ("novelty.__init__", "", "unknown layer 'novelty': add it to the layer table"),
    ],
)
def test_upward_imports_are_found(module, source, message):
    (problem,) = violations(source, f"{PACKAGE}.{module}")
    assert re.search(message, problem)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("splines.bspline", "import torchspline.groups\nfrom torchspline import kernels, arithmetic"),
        ("splines.bspline", "from . import basis\nfrom .basis import matrix\nfrom ..groups.so3 import SO3"),
        ("splines.__init__", "from .bspline import BSpline\nfrom torchspline.splines import basis"),
        ("arithmetic.so3", "from torchspline import checks\nfrom torchspline.errors import DomainError"),
        ("cli", "from torchspline import io, plot, robot, functional\nfrom .fit import fit"),
        ("functional", "from torchspline.fit import solve"),
        (
            "__init__",
            "from . import functional\nfrom torchspline.splines import BSpline\nfrom .fit import fit",
        ),
        ("io.tum", "import torch\nimport torchsplines\nfrom testing import x"),
    ],
)
def test_downward_imports_are_not(module, source):
    assert violations(source, f"{PACKAGE}.{module}") == []
