"""The gradient contract: what is promised, which tests keep it, and the page of the documentation that says so.

A promise is a property of one argument of one function, in one precision and one regime of control points. Tests name
the promises they keep with a marker, in which `{name}` stands for a parameter of the test:

    @pytest.mark.contract(function="{case}", properties="first second")

Without them, all arguments and all regimes are meant, and float64.

`TORCHSPLINE_CONTRACT=FOLDER pytest` records which of them passed, one file a worker, and
`python tests/contract.py FOLDER` says whether that is all there is to keep, and that the page is up to date;
with `--write` it writes the page.
"""

import argparse
import importlib
import itertools
import json
import os
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch

PAGE = Path(__file__).resolve().parent.parent / "torchspline" / "docs" / "gradients.md"
#: Where tests carry the marker.
MODULES = (
    "test_group_gradients",
    "test_bspline_gradients",
    "test_convert",
    "test_contract",
    "test_hermite",
    "test_fit_implicit",
)

REGIMES = {
    "identity": "all control points the same, or the identity",
    "small": "1e-12 to 1e-4 rad between neighbours",
    "general": "about one radian between neighbours",
    "near pi": "1e-6 rad short of a half-turn between neighbours",
}
PROPERTIES = {
    "finite": "first derivatives are finite",
    "first": "first derivatives are those of finite differences (`gradcheck`), float64",
    "second": "so are second derivatives (`gradgradcheck`), float64",
    "forward": "forward mode is the transpose of reverse mode to 1e-9, float64",
    "vmap": "`vmap` equals a loop, float64",
    "compile": "`torch.compile(fullgraph=True)` equals eager, gradients included, float64",
    "single": "float32 derivatives are those of float64 at the same numbers, to a few hundred rounding errors",
}
#: Both precisions for these, one for the others.
DTYPES = {"finite": ("float32", "float64"), "single": ("float32",)}

GROUP_OPERATIONS: dict[str, tuple[str, ...]] = {
    "exp": ("tangent",), "log": ("point",), "compose": ("first", "second"), "inverse": ("point",),
    "between": ("first", "second"), "act": ("point", "vector"),
    "interpolate": ("start", "end", "s"), "power": ("point", "exponent"),
    "retract": ("point", "tangent"), "retract right": ("point", "tangent"), "normalize": ("point",),
    "adjoint": ("point",), "adjoint_act": ("point", "tangent"), "bracket": ("first", "second"),
    "left_jacobian": ("tangent",), "right_jacobian": ("tangent",), "left_jacobian_inverse": ("tangent",),
    "right_jacobian_inverse": ("tangent",), "to_matrix": ("point",), "from_matrix": ("matrix",),
}  # fmt: skip
SPLINES: dict[str, tuple[str, ...]] = {
    "bspline": ("control_points", "t", "dt", "t0"),
    "nonuniform_bspline": ("control_points", "t", "knots"),
    "hermite (product)": ("values", "velocities", "accelerations", "t", "times"),
    "hermite (logarithm)": ("values", "velocities", "accelerations", "t", "times"),
    "interpolate (geodesic)": ("keyframes", "times", "t"),
    "interpolate (squad)": ("keyframes", "times", "t"),
    "interpolate (cumulative_bspline)": ("keyframes", "times", "t"),
    "geodesic_product": ("start", "steps", "weights"),
    "Trajectory.kinematics": ("control_points", "t"),
    "Trajectory.mounted": ("control_points", "t", "T_body_sensor"),
    "imu.measure": (
        "control_points", "t", "gravity", "gyroscope_bias", "accelerometer_bias", "T_body_imu",
    ),
}  # fmt: skip
INERTIAL: dict[str, tuple[str, ...]] = {
    "imu.Imu": (
        "control_points", "gyroscope_bias", "accelerometer_bias", "gyroscope_scale", "accelerometer_scale",
        "T_body_imu", "gravity",
    ),
    "imu.increments": ("control_points", "t"),
    "imu.integrate_gyroscope": ("gyroscope", "t", "start"),
    "imu.strapdown": ("angle", "velocity", "t"),
}  # fmt: skip
SOLVERS = {"Problem.solve (differentiable)": ("measurements", "times", "sigma", "covariance", "arguments")}
FUNCTIONS = {**GROUP_OPERATIONS, **SPLINES, **INERTIAL, "conversions": ("input",), **SOLVERS}
#: Why a promise is not made, where one might expect it.
EXCEPTIONS: dict[tuple[str, str, str], str] = {
    **{
        (name, "single", "near pi"): "on which side of pi they are, numbers in single precision cannot tell"
        for name in (*SPLINES, *INERTIAL)
    },
    (
        "interpolate (cumulative_bspline)",
        "compile",
        "general",
    ): "it is compiled as `nonuniform_bspline`, which it is",
    ("interpolate (squad)", "compile", "general"): "it does, but compiling its many operations takes minutes",
}
SECTIONS = {
    "Group operations": (GROUP_OPERATIONS, "Methods of `Group`, on every group."),
    "Splines, trajectories, readings": (
        SPLINES,
        "Value and two derivatives, on SE3 and order 4; B-splines also on every group, in orders 2 to 7 and with jerk.",
    ),
    "Inertial data": (
        INERTIAL,
        "On SE3 and order 4, or for samples that turn as far from one to the next; without noise. Filters, clocks and "
        "random processes are tested with the sensor model.",
    ),
    "Conversions": ({"conversions": ("input",)}, "Each function of `torchspline.convert`."),
    "Solutions of fits": (SOLVERS, "The control points that `Problem.solve(differentiable=True)` returns."),
}


class Promise(NamedTuple):
    function: str
    argument: str
    dtype: str
    regime: str
    property: str


def promises() -> list[Promise]:
    """All that are made."""
    made = []
    for function, arguments in FUNCTIONS.items():
        for name in _properties(function):
            for argument, dtype, regime in itertools.product(
                arguments, DTYPES.get(name, ("float64",)), _regimes(function, name)
            ):
                if (function, name, regime) not in EXCEPTIONS:
                    made.append(Promise(function, argument, dtype, regime, name))
    return made


def _properties(function: str) -> tuple[str, ...]:
    if function == "conversions":
        return ("first", "second", "vmap", "compile")
    if function in INERTIAL:
        return tuple(name for name in PROPERTIES if name != "compile")
    return ("first",) if function in SOLVERS else tuple(PROPERTIES)


def _regimes(function: str, name: str) -> tuple[str, ...]:
    """Compiling does not look at values, except for group operations, which are small enough to try all."""
    if function in GROUP_OPERATIONS or ((function in SPLINES or function in INERTIAL) and name != "compile"):
        return tuple(REGIMES)
    return ("general",)


# ---------------------------------------------------------------------- what tests claim


def claims(marks: Iterable[pytest.Mark], parameters: Mapping[str, Any]) -> Iterator[Promise]:
    """What the markers of one run of a test say, given the parameters it runs with."""

    known = {
        name: str(x).removeprefix("torch.") if isinstance(x, torch.dtype) else x
        for name, x in parameters.items()
    }

    for mark in marks:
        wanted = mark.kwargs
        function = wanted["function"].format_map(known)
        arguments = wanted.get("arguments", "*")
        every = FUNCTIONS[function] if arguments == "*" else tuple(arguments.split())
        dtypes = wanted.get("dtypes", "float64").format_map(known).split()
        regimes = wanted.get("regimes", ", ".join(REGIMES)).split(", ")
        for name in wanted["properties"].split():
            for argument, dtype, regime in itertools.product(every, dtypes, regimes):
                promise = Promise(function, argument, dtype, regime, name)
                if argument not in FUNCTIONS[function] or regime not in REGIMES or name not in PROPERTIES:
                    raise ValueError(f"contract: there is no promise like {promise}")
                yield promise


def claimed() -> dict[Promise, set[str]]:
    """The tests that claim each promise, read off the markers without running them."""
    found: dict[Promise, set[str]] = defaultdict(set)
    for module in MODULES:
        for name, function in vars(importlib.import_module(module)).items():
            marks = [m for m in getattr(function, "pytestmark", ()) if name.startswith("test_")]
            ours = [m for m in marks if m.name == "contract"]
            if ours:
                for parameters in _parameters(marks):
                    for promise in claims(ours, parameters):
                        found[promise].add(f"{module}.py::{name}")
    return dict(found)


def _parameters(marks: Iterable[pytest.Mark]) -> Iterator[dict[str, Any]]:
    axes = []
    for mark in marks:
        if mark.name == "parametrize" and isinstance(mark.args[0], str) and "," not in mark.args[0]:
            axes.append([(mark.args[0], getattr(x, "values", (x,))[0]) for x in mark.args[1]])
    return (dict(row) for row in itertools.product(*axes))


# ---------------------------------------------------------------------- what a run of the tests says


class Recorder:
    """Collects, in one worker, which promises its tests kept, and which they broke."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.kept: dict[Promise, set[str]] = defaultdict(set)
        self.broken: dict[Promise, set[str]] = defaultdict(set)

    def note(self, item: pytest.Item, passed: bool) -> None:
        marks = list(item.iter_markers("contract"))
        if not marks:
            return
        parameters = item.callspec.params if hasattr(item, "callspec") else {}
        test = item.nodeid.rpartition("/")[2].partition("[")[0]
        for promise in claims(marks, parameters):
            (self.kept if passed else self.broken)[promise].add(test)

    def write(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        worker = os.environ.get("PYTEST_XDIST_WORKER", "main")
        with (self.folder / f"{worker}.jsonl").open("w", encoding="utf-8") as file:
            for passed, found in ((True, self.kept), (False, self.broken)):
                for promise, tests in found.items():
                    row = {**promise._asdict(), "passed": passed, "tests": sorted(tests)}
                    file.write(json.dumps(row) + "\n")


def recorded(folder: Path) -> dict[Promise, set[str]]:
    """The promises that passed in every test that tried them, over all workers."""
    kept: dict[Promise, set[str]] = defaultdict(set)
    broken = set()
    for path in sorted(folder.glob("*.jsonl")):
        for line in path.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            promise = Promise(*(row[field] for field in Promise._fields))
            if row["passed"]:
                kept[promise].update(row["tests"])
            else:
                broken.add(promise)
    return {promise: tests for promise, tests in kept.items() if promise not in broken}


# ---------------------------------------------------------------------- the page

_HEAD = """# The gradient contract

Derivatives are part of the interface. For each function and each differentiable argument, the tables say what
holds where, and which tests keep it. `python tests/contract.py` writes this page from a run of the tests; the suite
fails when a promise has no test.

"""
_TAIL = """## What is not promised

* At exactly pi between neighbours the logarithm jumps. Its value is deterministic there, and its gradient is finite:
  that of one side.
* Derivatives of order k - 1 and above jump at the knots of a B-spline of order k.
* At the ends of the domain derivatives by time are one-sided.
* Repeated knots have finite gradients, but curves of different smoothness meet there.
* Near pi, single precision cannot tell on which side neighbours are: gradients are finite, but may be those of the
  other way round.
"""


def render(ticks: Mapping[Promise, set[str]]) -> str:
    """The page. Each cell names the regimes by their letters: Identity, Small, General, Near pi."""
    lines = [_HEAD, "| property | what it says |\n|---|---|\n"]
    lines += [f"| {name} | {text} |\n" for name, text in PROPERTIES.items()]
    lines += ["\n| letter | regime |\n|---|---|\n"]
    lines += [f"| {name[0].upper()} | {text} |\n" for name, text in REGIMES.items()]
    lines.append("\nA letter stands where the tests show it; in `finite` for both precisions.\n")
    made = set(promises())
    for title, (functions, text) in SECTIONS.items():
        names = [n for n in PROPERTIES if any(n in _properties(f) for f in functions)]
        lines.append(f"\n## {title}\n\n{text}\n\n| function | argument | {' | '.join(names)} |\n")
        lines.append("|---|---|" + "---|" * len(names) + "\n")
        tests: dict[str, set[str]] = defaultdict(set)
        for function, arguments in functions.items():
            for argument in arguments:
                cells = []
                for name in names:
                    cell = ""
                    for regime in REGIMES:
                        wanted = [
                            Promise(function, argument, d, regime, name)
                            for d in DTYPES.get(name, ("float64",))
                        ]
                        if all(p in made and p in ticks for p in wanted):
                            cell += regime[0].upper()
                            tests[name].update(*(ticks[p] for p in wanted))
                    cells.append(cell)
                lines.append(f"| `{function}` | {argument} | {' | '.join(cells)} |\n")
        lines.append("\nKept by:\n\n")
        lines += [f"* {name}: {', '.join(f'`{t}`' for t in sorted(tests[name]))}\n" for name in names]
    lines.append("\n" + _TAIL)
    reasons: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for (function, name, regime), reason in EXCEPTIONS.items():
        reasons[name, regime, reason].append(f"`{function}`")
    lines += [f"* {name}, {regime}: {', '.join(f)}: {why}.\n" for (name, regime, why), f in reasons.items()]
    return "".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description="Compares a run of the tests with the gradient contract.")
    parser.add_argument("folder", type=Path, help="what TORCHSPLINE_CONTRACT named during the run")
    parser.add_argument("--write", action="store_true", help="write the page")
    given = parser.parse_args()
    ticks = recorded(given.folder)
    missing = [p for p in promises() if p not in ticks]
    for promise in missing:
        print("not kept:", *promise, sep="  ")
    page = render(ticks)
    if given.write:
        PAGE.write_text(page, encoding="utf-8")
    elif page != PAGE.read_text(encoding="utf-8"):
        print(f"{PAGE.name} is not what this run says; write it with --write")
        return 1
    print(f"{len(promises()) - len(missing)} of {len(promises())} promises kept")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
