"""The tracer, without compiling: what it writes down, what it leaves out, and that nothing changes on the way."""

import math
import random
from itertools import pairwise

import pytest
import torch
from batteries import GROUPS

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.recurrence import forward, reverse
from torchspline.arithmetic.scalar import cos, sin, sqrt, where
from torchspline.groups import R3, SE3, SO3
from torchspline.kernels.emit import emit_rows
from torchspline.kernels.programs import forward_program, pairs_program, pairs_reverse, reverse_program
from torchspline.kernels.trace import SPELLING, Trace, trace
from torchspline.splines.basis import cumulative_matrix

each_group = pytest.mark.parametrize("group", GROUPS, ids=str)
float64, float32 = torch.float64, torch.float32


def traced(function, inputs, dtype=float64):
    """The trace of a function of `inputs` numbers that returns one number."""
    return trace(lambda v: [function(*v)], [inputs], dtype)


def evaluate(program: Trace, arguments):
    """The trace as plain Python, on floats."""
    body, outputs = program.lines(lambda i: f"X[{i}]", repr)
    source = "\n".join(
        ["def run(X):", *(f"    {line}" for line in body), f"    return [{', '.join(outputs)}]"]
    )
    names = {"math": math}
    exec(source, names)
    return names["run"](list(arguments))


def kinds(program: Trace) -> dict[str, int]:
    """Operations without the inputs."""
    return {kind: count for kind, count in program.counts().items() if kind != "input"}


def total(program: Trace) -> int:
    return sum(kinds(program).values())


# ---------------------------------------------------------------------- what is written down


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda x, y: (x + y) * (x + y), {"add": 1, "mul": 1}),
        (lambda x, y: (x + y) * (y + x), {"add": 1, "mul": 1}),
        (lambda x, y: x * y + y * x, {"mul": 1, "add": 1}),
        (lambda x, y: (x - y) * (y - x), {"sub": 2, "mul": 1}),
        (lambda x, y: (2.0 * x) * (x * 2.0), {"mul": 2}),
        (lambda x, y: sqrt(x * y) + sqrt(y * x), {"mul": 1, "sqrt": 1, "add": 1}),
        (lambda x, y: sin(x) * cos(x) + sin(x), {"sin": 1, "cos": 1, "mul": 1, "add": 1}),
    ],
)
def test_equal_operations_are_numbered_alike(function, expected):
    assert kinds(traced(function, 2)) == expected


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x + 0.0,
        lambda x: 0.0 + x,
        lambda x: x - 0.0,
        lambda x: x * 1.0,
        lambda x: 1.0 * x,
        lambda x: x / 1.0,
        lambda x: x + 0,
        lambda x: -1.0 * -x,
        lambda x: 0.0 - -x,
        lambda x: x + 0.0 * sin(x),
    ],
)
def test_what_changes_nothing_is_left_out(function):
    program = traced(function, 1)
    assert kinds(program) == {}
    assert evaluate(program, [3.5]) == [3.5]


def test_zero_times_anything_is_a_constant():
    program = trace(lambda v: [v[0] * 0.0, 0.0 * sin(v[1]), 7.0], [2], float64)
    assert program.operations == []
    assert evaluate(program, [2.0, 3.0]) == [0.0, 0.0, 7.0]


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda x, y: x + -y, {"sub": 1}),
        (lambda x, y: -x + y, {"sub": 1}),
        (lambda x, y: x - -y, {"add": 1}),
        (lambda x, y: -x - y, {"neg": 1, "sub": 1}),
        (lambda x, y: -x + -y, {"neg": 1, "sub": 1}),
        (lambda x, y: -1.0 * x + y, {"sub": 1}),
        (lambda x, y: 0.0 - x * y, {"mul": 1, "neg": 1}),
        (lambda x, y: 1.0 - -x, None),
        (lambda x, y: -x * -y, None),
    ],
)
def test_signs(function, expected):
    program = traced(function, 2)
    if expected is not None:
        assert kinds(program) == expected
    for arguments in ((2.5, 7.25), (-1.5, 0.375)):
        assert evaluate(program, arguments) == [function(*arguments)]


def test_dead_code_is_removed():
    def function(v):
        x, y, _unused = v
        waste = sin(x)
        for _ in range(50):
            waste = waste * y + x
        return [x * y]

    program = trace(function, [3], float64)
    assert program.counts() == {"input": 2, "mul": 1}
    assert program.inputs == 3, "positions of inputs do not move when some are not used"
    assert evaluate(program, [2.0, 5.0, math.nan]) == [10.0]


def test_order_of_operations_and_inputs():
    """Single assignment: every value is written once, before it is read; arguments are numbered across vectors."""
    program = trace(lambda a, b: [a[0] * b[1] - a[1] * b[0], b[2]], [2, 3], float64)
    body, outputs = program.lines(lambda i: f"X[{i}]", repr)
    seen: set[str] = set()
    for line in body:
        name, text = line.split(" = ")
        assert name not in seen
        assert {word for word in text.split() if word.startswith("v")} <= seen
        seen.add(name)
    assert set(outputs) <= seen
    assert evaluate(program, [2.0, 3.0, 5.0, 7.0, 11.0]) == [2.0 * 7.0 - 3.0 * 5.0, 11.0]


def test_an_output_may_be_an_input_twice_or_a_constant():
    program = trace(lambda v: [v[1], v[1], v[0], -0.5, 1 / 3], [2], float64)
    assert evaluate(program, [2.0, 3.0]) == [3.0, 3.0, 2.0, -0.5, 1 / 3]
    assert trace(lambda v: [], [0], float64) == Trace(0, [], [])


@pytest.mark.parametrize("x", [-2.0, -0.0, 0.0, 1.0, 3.0])
def test_where(x):
    def both(v):
        return [where(v < 0.0, -v, v), where(v > 1.0, 0.0, v), where((v == 0.0) | (v > 2), v, 5.0)]

    def gate(v):
        return where((v > 0.5) & (v < 2.0), 2.0 * v, 0.0)

    program = trace(lambda v: [*both(v[0]), gate(v[0])], [1], float64)
    assert evaluate(program, [x]) == [*both(x), gate(x)]
    assert program.counts()["where"] == 4


def test_near_path():
    """`x > constant` is assumed not to hold; a last output says where that was wrong."""

    def function(v):
        x, y = v
        far = x > 2.0
        return [where(far, sin(x), x * y), where(y > 1.0, 0.0, y)]

    near, whole = (trace(function, [2], float64, near=near) for near in (True, False))
    assert near.guarded
    assert not whole.guarded
    assert kinds(near) == {"mul": 1, "gt": 2, "or": 1, "where": 1}
    for x, y in ((1.0, 0.5), (2.0, 1.0), (-5.0, -3.0)):
        assert evaluate(near, [x, y]) == [*evaluate(whole, [x, y]), 0.0]
    for x, y in ((2.5, 0.0), (0.0, 1.5), (3.0, 3.0), (math.inf, 0.0)):
        assert evaluate(near, [x, y])[-1] == 1.0
    without = trace(lambda v: [v[0] * v[1]], [2], float64, near=True)
    assert not without.guarded
    assert len(without.outputs) == 1


@each_group
def test_near_path_of_the_exponential(group):
    """Within pi it needs no square root and gives the very same numbers; beyond pi it says so."""
    algebra, source = group.arithmetic, random.Random(1)
    near, whole = (
        trace(lambda x: list(algebra.exp(x)), [algebra.tangent_size], float64, near=near)
        for near in (True, False)
    )
    assert near.guarded == ("sqrt" in kinds(whole)) == (len(algebra.unit_blocks) > 0)
    assert not {"sqrt", "sin", "cos"} & set(kinds(near))
    for size in (1e-9, 0.1, 0.7):
        x = [source.gauss(0.0, size) for _ in range(algebra.tangent_size)]
        assert evaluate(near, x)[: algebra.point_size] == evaluate(whole, x)
        assert not near.guarded or evaluate(near, x)[-1] == 0.0
    assert not near.guarded or evaluate(near, [4.0] * algebra.tangent_size)[-1] == 1.0


@pytest.mark.parametrize("constant", [0.1, 1 / 3, -7e-300, 5e-324, 1.7976931348623157e308, 123456789.0, 3])
def test_constants_keep_every_bit(constant):
    program = traced(lambda x: x * constant, 1)
    assert evaluate(program, [1.0]) == [float(constant)]
    single = trace(lambda v: [v[0] * constant, 0.0], [1], float32)
    assert f"real({float(constant)!r})" in emit_rows("f", single, None, [1], [], [1], float32)


def test_a_symbol_has_no_truth_value():
    """Control flow that depends on a value cannot be written down; it must not pass unnoticed."""

    def absolute(v):
        return [-v[0] if v[0] < 0.0 else v[0]]

    with pytest.raises(TypeError, match="where"):
        trace(absolute, [1], float64)
    with pytest.raises(TypeError, match="unhashable"):
        trace(lambda v: [{v[0]: 1.0}[v[0]]], [1], float64)


def test_precision_chooses_the_polynomials():
    """Symbols carry the dtype, by which the series pick their shorter tables."""
    counts = [total(trace(lambda x: SO3.arithmetic.exp(x, short=True), [3], d)) for d in (float32, float64)]
    assert counts[0] < counts[1]


@each_group
def test_every_operation_has_a_spelling(group):
    for program in programs(group.arithmetic, 3, 3, float64):
        assert set(kinds(program)) <= set(SPELLING)


# ---------------------------------------------------------------------- nothing changes on the way


def primitives(algebra: GroupArithmetic):
    """Name -> (function, letters of its arguments: Point, Tangent, Acted on)."""
    named = {
        "P": "normalize inverse log",
        "PP": "compose between pull extract",
        "T": "exp",
        "PT": "adjoint adjoint_inverse coadjoint_inverse push embed",
        "TT": "bracket cobracket left_jacobian left_jacobian_transpose left_jacobian_inverse "
        "left_jacobian_inverse_transpose right_jacobian right_jacobian_transpose right_jacobian_inverse "
        "right_jacobian_inverse_transpose",
        "PA": "act",
        "PATA": "act_tangent",
    }
    cases = {
        name: (getattr(algebra, name), kinds) for kinds, names in named.items() for name in names.split()
    }
    for name in ("exp", "left_jacobian", "left_jacobian_inverse", "left_jacobian_inverse_transpose"):
        function, letters = cases[name]
        cases[f"{name} short"] = (lambda *v, function=function: function(*v, short=True), letters)
    cases["to_matrix"] = (lambda X: [c for row in algebra.to_matrix(X) for c in row], "P")
    return cases


@each_group
@pytest.mark.parametrize("name", primitives(SO3.arithmetic))
def test_primitives(group, name):
    """The trace of every primitive gives the very floats that the arithmetic itself gives."""
    algebra = group.arithmetic
    function, letters = primitives(algebra)[name]
    length = {"P": algebra.point_size, "T": algebra.tangent_size, "A": algebra.act_size}
    sizes = [length[letter] for letter in letters]
    program = trace(lambda *v: list(function(*v)), sizes, float64)
    source = random.Random(f"{group}{name}")
    for size in (1e-9, 0.3, 1.2, 40.0):
        if size > 2.0 and (name.endswith("short") or "inverse" in name):
            continue
        vectors = [tuple(source.gauss(0.0, size) for _ in range(n)) for n in sizes]
        expected = list(function(*vectors))
        assert evaluate(program, [x for v in vectors for x in v]) == expected


def programs(algebra: GroupArithmetic, order: int, derivatives: int, dtype: torch.dtype):
    rows = cumulative_matrix(order)[1:]
    yield forward_program(algebra, rows, derivatives, dtype)
    yield reverse_program(algebra, rows, derivatives, dtype)
    yield pairs_program(algebra, dtype)
    yield trace(lambda d, g: pairs_reverse(algebra, d, g), [algebra.tangent_size] * 2, dtype)
    yield trace(algebra.embed, [algebra.point_size, algebra.tangent_size], dtype)


@each_group
@pytest.mark.parametrize("derivatives", range(4))
def test_forward_program(group, derivatives):
    """Weights by Horner's rule, steps, scales: the whole program against the recurrence on floats."""
    algebra, order = group.arithmetic, 4
    rows, source = cumulative_matrix(order)[1:], random.Random(derivatives)
    program = forward_program(algebra, rows, derivatives, float64)
    u, scales = 0.37, [source.uniform(0.5, 2.0) for _ in range(derivatives)]
    start = algebra.normalize(tuple(source.gauss(0, 1) for _ in range(algebra.point_size)))
    steps = [tuple(source.gauss(0, 0.4) for _ in range(algebra.tangent_size)) for _ in rows]
    polynomials, weights = [list(map(float, row)) for row in rows], []
    for _ in range(derivatives + 1):
        weights.append([sum(c * u**n for n, c in enumerate(row)) for row in polynomials])
        polynomials = [[n * c for n, c in enumerate(row)][1:] for row in polynomials]
    value, sweep = forward(algebra, start, steps, weights, derivatives, short=True)
    expected = [*value, *(s * c for s, r in zip(scales, sweep[-1].rates, strict=True) for c in r)]
    assert evaluate(program, [u, *start, *(c for d in steps for c in d), *scales]) == pytest.approx(
        expected, rel=1e-13, abs=1e-14
    )


# ---------------------------------------------------------------------- how much is written down


@each_group
def test_traces_are_reproducible(group):
    """The compiled code is found again by a digest of the source, so that may not depend on anything else."""
    for ours, again in zip(*(list(programs(group.arithmetic, 4, 2, float64)) for _ in range(2)), strict=True):
        assert ours == again


@each_group
@pytest.mark.parametrize("derivatives", [0, 2, 3])
def test_operations_grow_linearly_with_the_order(group, derivatives):
    """Each further step costs the same, forward and in reverse; only the polynomials of the basis have more terms."""
    algebra = group.arithmetic
    P, D = algebra.point_size, algebra.tangent_size

    def sweeps(count):
        def run(start, steps, weights, value_g, rates_g):
            steps = [steps[i : i + D] for i in range(0, len(steps), D)]
            table = [weights[i : i + count] for i in range(0, len(weights), count)]
            cotangents = [rates_g[i : i + D] for i in range(0, len(rates_g), D)]
            value, sweep = forward(algebra, start, steps, table, derivatives, short=True)
            start_g, steps_g, _ = reverse(algebra, steps, table, sweep, value_g, cotangents, short=True)
            return [*value, *start_g, *(c for g in steps_g for c in g)]

        sizes = [P, count * D, (derivatives + 1) * count, D, derivatives * D]
        return total(trace(run, sizes, float64))

    counts = [sweeps(count) for count in range(4, 10)]
    assert len({after - before for before, after in pairwise(counts)}) == 1


@pytest.mark.parametrize(
    ("group", "most"), [(R3, (80, 137)), (SO3, (440, 1061)), (SE3, (1037, 2705))], ids=str
)
def test_operations_of_the_cubic_spline(group, most):
    """A ceiling for pose, velocity and acceleration; a rise means that something is computed twice."""
    both = list(programs(group.arithmetic, 4, 2, float64))[:2]
    for program, limit in zip(both, most, strict=True):
        assert total(program) <= limit
        assert not {"sin", "cos", "sqrt", "div", "where"} & set(kinds(program)), "no branches"
