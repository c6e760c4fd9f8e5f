"""Bad arguments of every public function: the error names the argument, what came and what was expected."""

import inspect
import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from error_arguments import ACCEPTED, FOLDER, TOGETHER, Case

import torchspline
import torchspline.io as records

#: Every `error_NAME.py` beside this file. Each enters its functions with `accept`, yields `cases()` and says what is
#: `NOT_APPLICABLE`; and where there is need, `ROOTS` to look for public functions in, `RESULTS` that the library makes
#: and hands out and nobody is meant to call, methods that are `UNTRIED` and parameters that are `FREE`.
FILES = [
    import_module(path.stem)
    for path in sorted(Path(__file__).parent.glob("error_*.py"))
    if path.stem != "error_arguments"
]
CASES = [case for file in FILES for case in file.cases()]


def entries(table: str) -> list[Any]:
    """All that the files say in a table that not every one has."""
    return [entry for file in FILES for entry in getattr(file, table, ())]


def explained(table: str) -> dict[str, str]:
    """All that the files excuse in a table, with the reasons."""
    return {name: reason for file in FILES for name, reason in getattr(file, table, {}).items()}


def label(case: Case) -> str:
    return f"{case.function}-{case.argument}-{case.category}-{case.came}".replace(FOLDER.name, "")


@pytest.mark.parametrize("case", CASES, ids=label)
def test_the_message_says_what_is_wrong(case):
    function, good = ACCEPTED[case.function]
    wrong_type = case.category in ("type", "dtype", "mixed dtype")
    with pytest.raises(TypeError if wrong_type else (ValueError, FileNotFoundError)) as caught:
        function(**{**good, **case.changes})
    message = str(caught.value)
    # Two arguments that do not go together are named in the order of the check; else the culprit comes first.
    named = re.escape(case.named)
    if case.category in TOGETHER:
        assert re.search(rf"\b{named}\b", message), message
    else:
        assert re.match(rf"({named}\b|.*\b{named}\b[^:]*: )", message), message
    assert case.came in message, message
    assert case.expected in message, message


# ---------------------------------------------------------------------- nothing is left out


def public() -> dict[str, Callable[..., Any]]:
    """Functions, constructors and methods by qualified name, found by walking what the package exports."""
    found: dict[str, Callable[..., Any]] = {}

    def visit(x: Any) -> None:
        if isinstance(x, ModuleType):
            names = getattr(x, "__all__", None) or [
                name
                for name, y in vars(x).items()
                if inspect.isfunction(y) and y.__module__ == x.__name__ and not name.startswith("_")
            ]
            for name in names:
                visit(getattr(x, name))
        elif inspect.isclass(x):
            if not inspect.isabstract(x) and x.__name__ not in RESULTS:
                found[x.__name__] = x
            for name, method in inspect.getmembers(x, inspect.isfunction):
                own = method.__module__.startswith("torchspline.") and not hasattr(tuple, name)
                if own and not name.startswith("_") and not getattr(method, "__isabstractmethod__", False):
                    found[method.__qualname__] = method
        elif callable(x) and not isinstance(x, torchspline.Group):
            found[x.__name__] = x

    for root in (torchspline, records, *entries("ROOTS")):
        visit(root)
    return found


RESULTS = set(entries("RESULTS"))

#: Methods that are public by name alone, with nothing to get wrong.
UNTRIED = explained("UNTRIED")

#: Parameters that take anything.
FREE = {
    **dict.fromkeys(
        ("validate", "learnable", "degrees", "progress"), "a truth value, and everything has one"
    ),
    "device": "goes straight to PyTorch, which lists the devices there are",
    "source": "goes into messages as it is",
    "name": "goes into messages as it is",
    "options": "those of BSpline or of a scheme, tried one by one",
    "arguments": "those of the residual, tried one by one",
    "index": "for arguments of the residual, tried with one",
    **explained("FREE"),
}

#: The kinds of mistakes every function is tried with, where they can be made.
CATEGORIES = ("shape", "dtype", "device", "nan", "zero quaternion", "count", "time")

#: What counts as a case of the categories above.
COUNTS_AS = {"batch": "shape", "mixed dtype": "dtype"}


def test_every_public_function_is_tried_with_every_mistake():
    functions = public()
    assert set(functions) == set(ACCEPTED) | set(UNTRIED)
    tried = {(case.function, COUNTS_AS.get(case.category, case.category)) for case in CASES}
    excused = {
        (function, category)
        for file in FILES
        for category, reasons in file.NOT_APPLICABLE.items()
        for names in reasons.values()
        for function in names.split()
    }
    assert {function for function, _ in excused} <= set(ACCEPTED)
    needed = {(function, category) for function in ACCEPTED for category in CATEGORIES}
    assert needed - tried == excused


def test_every_parameter_is_tried():
    tried = {(case.function, argument) for case in CASES for argument in case.changes}
    parameters = {
        (name, parameter)
        for name, function in public().items()
        if name not in UNTRIED
        for parameter in inspect.signature(function).parameters
        if parameter != "self" and parameter not in FREE
    }
    assert parameters <= tried, sorted(parameters - tried)


@pytest.mark.parametrize("function", ACCEPTED)
def test_arguments_are_accepted_when_nothing_is_wrong(function):
    call, good = ACCEPTED[function]
    call(**good)
