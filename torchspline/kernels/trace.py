"""A tracer: numbers that write down what is done to them.

The arithmetic of a group runs once on `Symbol`s; what remains is a list of operations in single assignment, equal
ones numbered alike, constants folded, from which `emit.py` writes a loop. Nothing here knows about groups.
"""

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import NamedTuple

import torch

from torchspline.arithmetic.scalar import namespace

#: Operations a trace consists of, and how each is written in Python.
SPELLING: dict[str, str] = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "neg": "-{0}",
    "sqrt": "math.sqrt({0})",
    "sin": "math.sin({0})",
    "cos": "math.cos({0})",
    "lt": "{0} < {1}",
    "gt": "{0} > {1}",
    "eq": "{0} == {1}",
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "where": "{1} if {0} else {2}",
}
_SYMMETRIC = {"add", "mul", "eq", "and", "or"}


class Operation(NamedTuple):
    """`kind` of numbered values or constants; an input has kind "input" and its position."""

    kind: str
    operands: tuple


class Graph:
    """All operations of a trace in order; a `Symbol` is a position in it."""

    def __init__(self, dtype: torch.dtype, near: bool = False):
        self.dtype = dtype
        #: Whether `x > constant` is taken to be False; what was assumed is kept, so that it can be tested for.
        self.near, self.assumed = near, list[Symbol]()
        self.operations: list[Operation] = []
        self._numbers: dict[Operation, int] = {}

    def input(self, position: int) -> "Symbol":
        return self._append(Operation("input", (position,)))

    def inputs(self, count: int, first: int = 0) -> tuple["Symbol", ...]:
        return tuple(self.input(first + i) for i in range(count))

    def record(self, kind: str, *operands: "Symbol | float") -> "Symbol":
        keys = tuple(x if isinstance(x, Symbol) else float(x) for x in operands)
        numbered = tuple(("v", x.number) if isinstance(x, Symbol) else ("c", x.hex()) for x in keys)
        if kind in _SYMMETRIC:
            numbered = tuple(sorted(numbered, key=str))
        return self._append(Operation(kind, numbered))

    def _append(self, operation: Operation) -> "Symbol":
        if operation not in self._numbers:
            self._numbers[operation] = len(self.operations)
            self.operations.append(operation)
        return Symbol(self, self._numbers[operation])


class Symbol:
    """A number that is not known yet."""

    __slots__ = ("graph", "number")

    def __init__(self, graph: Graph, number: int):
        self.graph, self.number = graph, number

    @property
    def dtype(self) -> torch.dtype:
        """Chooses the length of polynomials, see `scalar.is_single`."""
        return self.graph.dtype

    def _negated(self) -> "Symbol | None":
        """x if this is -x."""
        kind, operands = self.graph.operations[self.number]
        return Symbol(self.graph, operands[0][1]) if kind == "neg" else None

    def __add__(self, other: "Symbol | float") -> "Symbol":
        if _is(other, 0.0):
            return self
        if isinstance(other, Symbol):
            inner = other._negated()
            if inner is not None:
                return self - inner
            inner = self._negated()
            if inner is not None:
                return other - inner
        return self.graph.record("add", self, other)

    def __radd__(self, other: float) -> "Symbol":
        return self + other

    def __sub__(self, other: "Symbol | float") -> "Symbol":
        if _is(other, 0.0):
            return self
        if isinstance(other, Symbol):
            inner = other._negated()
            if inner is not None:
                return self + inner
        return self.graph.record("sub", self, other)

    def __rsub__(self, other: float) -> "Symbol":
        return -self if _is(other, 0.0) else self.graph.record("sub", other, self)

    def __mul__(self, other: "Symbol | float") -> "Symbol | float":
        if _is(other, 0.0):
            return 0.0
        if _is(other, 1.0):
            return self
        if _is(other, -1.0):
            return -self
        return self.graph.record("mul", self, other)

    def __rmul__(self, other: float) -> "Symbol | float":
        return self * other

    def __truediv__(self, other: "Symbol | float") -> "Symbol":
        return self if _is(other, 1.0) else self.graph.record("div", self, other)

    def __rtruediv__(self, other: float) -> "Symbol":
        return self.graph.record("div", other, self)

    def __neg__(self) -> "Symbol":
        inner = self._negated()
        return self.graph.record("neg", self) if inner is None else inner

    def __lt__(self, other: "Symbol | float") -> "Symbol":
        return self.graph.record("lt", self, other)

    def __gt__(self, other: "Symbol | float") -> "Symbol | bool":  # type: ignore[misc]
        exceeds = self.graph.record("gt", self, other)
        if self.graph.near and not isinstance(other, Symbol):
            self.graph.assumed.append(exceeds)
            return False
        return exceeds

    def __eq__(self, other: object) -> "Symbol":  # type: ignore[override]
        assert isinstance(other, (Symbol, float, int))
        return self.graph.record("eq", self, other)

    def __and__(self, other: "Symbol") -> "Symbol":
        return self.graph.record("and", self, other)

    def __or__(self, other: "Symbol") -> "Symbol":
        return self.graph.record("or", self, other)

    def __bool__(self) -> bool:
        raise TypeError("a number being traced has no truth value: choose with `where` instead of `if`")

    __hash__ = None  # type: ignore[assignment]


def _is(x: object, constant: float) -> bool:
    return isinstance(x, (int, float)) and x == constant


def _where(condition: "Symbol | bool", yes: "Symbol | float", no: "Symbol | float") -> "Symbol | float":
    if isinstance(condition, bool):
        return yes if condition else no
    return condition.graph.record("where", condition, yes, no)


namespace.register(
    Symbol,
    lambda x: SimpleNamespace(
        sqrt=lambda x: x.graph.record("sqrt", x),
        sin=lambda x: x.graph.record("sin", x),
        cos=lambda x: x.graph.record("cos", x),
        where=_where,
    ),
)


def indicator(condition: Symbol) -> Symbol:
    """1 where the condition holds, else 0."""
    return condition.graph.record("where", condition, 1.0, 0.0)


class Trace(NamedTuple):
    """What a function does to its inputs: the operations its outputs need, in order."""

    inputs: int
    operations: list[tuple[int, Operation]]
    #: Number of a value, or a constant, for each output.
    outputs: list[tuple[str, int | str]]
    #: Whether the last output is 1 where the trace does not hold, because a number was larger than assumed.
    guarded: bool = False

    def lines(
        self,
        load: Callable[[int], str],
        constant: Callable[[float], str],
        spelling: Mapping[str, str] = SPELLING,
    ) -> tuple[list[str], list[str]]:
        """Assignments in Python, and the expression of each output.

        Args:
            load: how input i is written; constant: how a number is; spelling: how operations are.
        """

        def name(operand: tuple) -> str:
            return f"v{operand[1]}" if operand[0] == "v" else constant(float.fromhex(operand[1]))

        body = []
        for number, (kind, operands) in self.operations:
            if kind == "input":
                text = load(operands[0])
            else:
                text = spelling[kind].format(*map(name, operands))
            body.append(f"v{number} = {text}")
        return body, [name(output) for output in self.outputs]

    def counts(self) -> dict[str, int]:
        """How many operations of each kind."""
        totals: dict[str, int] = {}
        for _, (kind, _operands) in self.operations:
            totals[kind] = totals.get(kind, 0) + 1
        return totals


def trace(
    function: Callable[..., Sequence], sizes: Sequence[int], dtype: torch.dtype, near: bool = False
) -> Trace:
    """Run `function` on tuples of symbols of the given sizes; it returns the outputs as one flat sequence.

    Args:
        near: follow the side of every `x > constant` on which x is small, and add an output that says where that was
            wrong; range reductions then leave no trace.
    """
    graph = Graph(dtype, near)
    arguments, first = [], 0
    for size in sizes:
        arguments.append(graph.inputs(size, first))
        first += size
    results = list(function(*arguments))
    guarded = len(graph.assumed) > 0
    if guarded:
        wrong = graph.assumed[0]
        for exceeds in graph.assumed[1:]:
            wrong = wrong | exceeds
        results.append(indicator(wrong))
    outputs: list[tuple[str, int | str]] = [
        ("v", x.number) if isinstance(x, Symbol) else ("c", float(x).hex()) for x in results
    ]
    needed: set[int] = set()
    waiting = [int(number) for kind, number in outputs if kind == "v"]
    while waiting:
        number = waiting.pop()
        if number in needed:
            continue
        needed.add(number)
        kind, operands = graph.operations[number]
        if kind != "input":
            waiting += [operand[1] for operand in operands if operand[0] == "v"]
    kept = [(n, graph.operations[n]) for n in sorted(needed)]
    return Trace(first, kept, outputs, guarded)
