"""Compiled kernels between processes: the folder they are kept in, forks, threads, modes, a missing Numba."""

import errno
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from batteries import generator

import torchspline
from torchspline.functional import bspline
from torchspline.groups import SO3
from torchspline.kernels import build, emit, mode, threads
from torchspline.kernels.trace import trace

numba = pytest.importorskip("numba")

TIMEOUT = 300  # seconds, on a machine that does much else
#: A spline, its gradient, and numbers that tell whether processes agree. NumPy adds up: large tensor operations, unlike
#: kernels, hang in the child of a process that has run some on several threads.
SCRIPT = """
import hashlib, json, os, sys, warnings
if "without numba" in sys.argv:
    sys.modules["numba"] = None
import torch, torchspline
from torchspline.functional import bspline

def solve(count=50):
    points = torch.linspace(-1.0, 2.0, 24, dtype=torch.float64).reshape(8, 3).sin().requires_grad_()
    t = torch.linspace(0.0, 3.5, count, dtype=torch.float64)
    state = bspline(points, t, group=torchspline.R3, order=2, dt=0.5, derivatives=1)
    value, velocity = state.value.detach(), state.velocity.detach()
    (gradient,) = torch.autograd.grad([state.value, state.velocity], points, [velocity, value])
    return [float(x.numpy().sum()) for x in (value, velocity, gradient)]
"""

SOLVE = "print(json.dumps(solve()))"


def start(code, *arguments, folder, **variables):
    """A process with a cache of its own, kernels forced, one thread, and further variables (None: not set)."""
    path = folder / f"script{len(list(folder.glob('script*')))}.py"
    path.write_text(SCRIPT + textwrap.dedent(code))
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA_", "TORCHSPLINE_"))}
    own = {"OMP_NUM_THREADS": "1", mode.VARIABLE: "fused", build.CACHE_VARIABLE: str(folder / "cache")}
    variables = {k: v for k, v in {**inherited, **own, **variables}.items() if v is not None}
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    return subprocess.Popen([sys.executable, str(path), *arguments], env=variables, **options)


def finish(process):
    """What the process printed, read as JSON."""
    try:
        out, err = process.communicate(timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)  # its children, too
        raise
    assert process.returncode == 0, err[-3000:]
    return json.loads(out.splitlines()[-1])


def run(code, *arguments, **options):
    return finish(start(code, *arguments, **options))


# ---------------------------------------------------------------------- the folder


def files(folder):
    """Date and size of everything below, Python's own cache aside."""
    found = [x for x in Path(folder).rglob("*.*") if x.suffix != ".pyc"]
    return {x.name: (x.stat().st_mtime_ns, x.stat().st_size) for x in found if x.is_file()}


def test_a_second_process_compiles_nothing(tmp_path):
    """Two at once fill an empty folder, agree, and leave nothing half-written; the next one only reads."""
    first, second = (finish(x) for x in [start(SOLVE, folder=tmp_path) for _ in range(2)])
    before = files(tmp_path / "cache")
    assert {Path(x).suffix for x in before} == {".py", ".nbi", ".nbc"}
    assert run(SOLVE, folder=tmp_path) == first == second
    assert files(tmp_path / "cache") == before


def test_a_disk_that_is_full(tmp_path):
    """Writing fails beyond the first 2500 bytes of a file."""
    pytest.importorskip("resource")
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (2500, 2500))\n"
    reference = start(SOLVE, folder=tmp_path, TORCHSPLINE_KERNELS="reference")
    assert run(limit + SOLVE, folder=tmp_path) == pytest.approx(finish(reference), rel=1e-12)
    assert max(size for _, size in files(tmp_path / "cache").values()) <= 2500


def test_sources_do_not_depend_on_the_process(tmp_path):
    """Machine code is found by a digest of the source: the order of sets must not matter."""
    code = """
    from torchspline.splines.fused import kernels_of
    kernels = [kernels_of(g, 3, 2, torch.float64, False) for g in ("R3", "SO3", "SE3", "R3xSO3")]
    text = "".join(k.forward_source() + k.reverse_source() for k in kernels)
    print(json.dumps(hashlib.sha256(text.encode()).hexdigest()))
    """
    processes = [start(code, folder=tmp_path, PYTHONHASHSEED=str(seed)) for seed in (1, 2)]
    assert len({finish(x) for x in processes}) == 1


@pytest.fixture
def compile_square(tmp_path, monkeypatch):
    """A function that compiles `x * x` anew, as another process would; the result tells by `stats` if it was loaded."""
    monkeypatch.setenv(build.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    program = trace(lambda v: [v[0] * v[0], 0.0], [1], torch.float64)
    source = emit.emit_rows("square", program, None, [1], [], [1], torch.float64)

    def compile_square():
        function = build.compiled.__wrapped__("square", source, "(float64[::1], float64[::1], int64, int64)")
        x, y = np.arange(40.0), np.zeros(40)
        function(x, y, 0, 40)
        assert np.array_equal(y, x * x)
        return function

    return compile_square


def loaded(function):
    return sum(function.stats.cache_hits.values()) == 1


def test_loading(compile_square):
    assert [loaded(compile_square()) for _ in range(3)] == [False, True, True]
    assert len(files(build.cache_folder())) == 3
    assert f"numba{numba.__version__}-python{platform.python_version()}" in build.cache_folder().name


DAMAGE = {
    "empty": lambda data: b"",
    "half": lambda data: data[: len(data) // 2],
    "end": lambda data: data[:-1],
    "garbage": lambda data: b"\x80\x05garbage",
    "shifted": lambda data: b"\xff\xfe\x00" + data,
    "foreign": lambda data: b"\x80\x04cnowhere\nnothing\n.",
}


@pytest.mark.parametrize("suffix", [".py", ".pyc", ".nbi", ".nbc"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_made_again(compile_square, suffix, damage, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.setattr(sys, "pycache_prefix", None)
    compile_square()
    (path,) = build.cache_folder().rglob(f"*{suffix}")
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    compile_square()
    assert loaded(compile_square()), "once, not in every process"


PLACES = {
    "folder": (Path, "mkdir"),
    "source": (tempfile, "mkstemp"),
    "machine code": (numba.core.caching.IndexDataCacheFile, "_save_data"),
    "index": (numba.core.caching.IndexDataCacheFile, "_save_index"),
}


@pytest.mark.parametrize("place", [*PLACES, "file in the way"])
def test_a_folder_that_cannot_be_written(compile_square, place, tmp_path, monkeypatch):
    """Kernels live in memory; as soon as there is room they are kept; what was kept is read without any."""

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(*PLACES[place], full) if place in PLACES else (tmp_path / "cache").write_text("")
        assert not any(loaded(compile_square()) for _ in range(2))
    if place not in PLACES:
        (tmp_path / "cache").unlink()
    assert not loaded(compile_square())
    for name in ("source", "machine code", "index"):
        monkeypatch.setattr(*PLACES[name], full)
    assert loaded(compile_square())


# ---------------------------------------------------------------------- modes


def test_without_numba(tmp_path):
    code = """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solutions = [solve(), solve()]
        torchspline.SO3.log(torchspline.SO3.random(10_000))
        try:
            with torchspline.use_kernels("fused"):
                solve()
        except RuntimeError as error:
            refusal = str(error)
    print(json.dumps([solutions, [str(w.message) for w in caught if "torchspline" in str(w.message)], refusal]))
    """
    reference = start(SOLVE, folder=tmp_path, TORCHSPLINE_KERNELS="reference")
    solutions, (warning,), refusal = run(code, "without numba", folder=tmp_path, TORCHSPLINE_KERNELS=None)
    assert solutions == [finish(reference)] * 2
    assert "kernels are off" in warning
    assert "no kernel serves" in refusal


def test_environment_variable(monkeypatch):
    for word in mode.MODES:
        monkeypatch.setenv(mode.VARIABLE, word)
        with torchspline.use_kernels("reference"):
            assert mode.current() == "reference"
        assert mode.current() == word
    monkeypatch.setenv(mode.VARIABLE, "fats")
    with pytest.raises(ValueError, match=r"TORCHSPLINE_KERNELS: expected one of 'auto', .* got 'fats'"):
        bspline(SO3.random(4), torch.zeros(1), group=SO3, dt=1.0)
    monkeypatch.delenv(mode.VARIABLE)
    assert mode.current() == "auto"


# ---------------------------------------------------------------------- forks

WORKERS = """
from torch.utils.data import DataLoader, Dataset
from torchspline.kernels import threads

class Solutions(Dataset):
    def __len__(self):
        return 4

    def __getitem__(self, item):
        torch.set_num_threads(2)
        return torch.tensor([*solve(20_000), threads._pool.size], dtype=torch.float64)

def check(rank, context):
    torch.set_num_threads(2)
    expected = [*solve(20_000), 1.0]
    assert threads._pool.size == 1, "one thread besides the caller's"
    rows = torch.cat(list(DataLoader(Solutions(), num_workers=2, multiprocessing_context=context)))
    assert rows.tolist() == [expected] * 4, (rows, expected)
    assert [*solve(20_000), 1.0] == expected

if __name__ == "__main__":
    check(0, "fork")
    if "spawn" in sys.argv:
        torch.multiprocessing.spawn(check, args=("fork",), nprocs=2)
    print(json.dumps("done"))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on this system")
@pytest.mark.parametrize("nested", [[], ["spawn"]], ids=["fork", "fork in spawn"])
def test_workers_of_a_process_that_has_used_threads(tmp_path, nested):
    shared = {build.CACHE_VARIABLE: os.environ.get(build.CACHE_VARIABLE)}
    assert run(WORKERS, *nested, folder=tmp_path, **shared) == "done"


# ---------------------------------------------------------------------- threads


@pytest.fixture
def set_threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def times(count, *shape):
    return (count - 3) * torch.rand(shape, generator=generator(1), dtype=torch.float64)


def solution(points, t):
    points, t = points.detach().requires_grad_(), t.detach().requires_grad_()
    with torchspline.use_kernels("fused"):
        fields = bspline(points, t, group=SO3, dt=1.0)[:3]
        return (*fields, *torch.autograd.grad(fields, (points, t), [x.cos().detach() for x in fields]))


@pytest.mark.parametrize("shapes", [((), (100_000,)), ((4,), (25_000,)), ((4,), (4, 25_000))], ids=str)
@pytest.mark.parametrize("count", [50, 20_000])
def test_results_do_not_depend_on_the_number_of_threads(set_threads, shapes, count):
    points, unsorted = SO3.random(*shapes[0], count, generator=generator(0)), times(count, *shapes[1])
    for t in (unsorted, unsorted.sort(-1).values):
        results = []
        for number in (1, 2, 3, 8):
            set_threads(number)
            results.append(solution(points, t))
        assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


def test_small_calls_start_no_threads(set_threads):
    set_threads(3)
    threads._pool.forget()
    solution(SO3.random(40, generator=generator(0)), times(40, 5000))
    assert threads._pool.executor is None


def test_calls_from_several_threads(set_threads):
    """Of different sizes, so that the pool grows while others use it."""
    points = SO3.random(400, generator=generator(0))
    calls = [times(400, n) for n in (17_000, 40_000, 90_000)] * 4
    set_threads(4)
    expected = [solution(points, t) for t in calls]
    pool = threads._Pool()
    small, _ = pool.get(1), pool.get(5)
    assert small.submit(int).result(TIMEOUT) == 0
    threads._pool.forget()
    with ThreadPoolExecutor(6) as several:
        for pair in zip(several.map(lambda t: solution(points, t), calls), expected, strict=True):
            assert all(map(torch.equal, *pair))


@pytest.mark.parametrize("number", [1, 2, 5])
def test_pool(set_threads, number):
    """Each task once, no more at a time than torch allows, errors passed on, usable afterwards."""
    set_threads(number)
    active, most, done = [], [], []

    def task(i):
        active.append(i)
        most.append(len(active))
        time.sleep(0.002)
        done.append(i)
        active.remove(i)
        assert i != 999

    threads.run([lambda i=i: task(i) for i in range(20)])
    assert (sorted(done), max(most) <= number) == (list(range(20)), True)
    for tasks in ([0, 999, 1], [999, 999], [*range(6), 999]):
        with pytest.raises(AssertionError):
            threads.run([lambda i=i: task(i) for i in tasks])
        assert active == []
    threads.run([])


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_spans(parts):
    for count in (0, 1, 31, 32, 33, 1000, 100_000):
        spans = threads.spans(count, parts, 32)
        assert len(spans) <= parts
        assert [i for a, b in spans for i in range(a, b)] == list(range(count))
        assert all(a % 32 == 0 for a, _ in spans)
