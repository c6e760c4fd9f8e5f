"""Runs a reader on damaged files in a process of its own, with limits on its memory and time."""

import json
import multiprocessing
import os
import random
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fuzzing.mutate import mutate

#: What readers may answer with; anything else is a crash.
DOCUMENTED = (ValueError, TypeError, OSError)
_POLL = 0.05


class Sample(NamedTuple):
    """A valid file: what it is called, its content, and files that have to lie beside it."""

    name: str
    content: bytes
    beside: tuple[tuple[str, bytes], ...] = ()


class Finding(NamedTuple):
    """What a reader must not do: "crash", "hang", "memory", or "message" (many lines, or none that names the file)."""

    kind: str
    index: int
    detail: str


class Outcome(NamedTuple):
    read: int
    refused: int
    findings: list[Finding]
    #: The longest that one file took, s, and by how much the process grew, bytes.
    slowest: float
    grown: int


def damaged(samples: Sequence[Sample], seed: int, name: str, index: int) -> tuple[Sample, bytes]:
    """Input number `index` for the reader `name`: the same whenever it is asked for."""
    rng = random.Random(f"{seed} {name} {index}")
    sample = rng.choice(samples)
    return sample, mutate(sample.content, rng)


def watch(
    name: str,
    read: Callable[[Path], Any],
    samples: Sequence[Sample],
    folder: Path,
    count: int,
    seed: int,
    time_limit: float,
    memory_limit: int,
) -> Outcome:
    """Gives `count` damaged files to a reader.

    Args:
        read: takes the path of a file. samples: valid files, to be damaged.
        folder: where the files are written, one after another.
        time_limit: for one file, s. memory_limit: by how much the address space of the process may grow, bytes.
    """
    context = multiprocessing.get_context("fork")
    done = context.Value("q", 0)
    report = folder / "report.jsonl"
    report.unlink(missing_ok=True)
    findings: list[Finding] = []
    start = 0
    while start < count:
        done.value = start
        process = context.Process(
            target=_work, args=(name, read, samples, folder, start, count, seed, memory_limit, done, report)
        )
        process.start()
        at, since = start, time.monotonic()
        while process.is_alive():
            process.join(_POLL)
            if done.value != at:
                at, since = done.value, time.monotonic()
            elif time.monotonic() - since > time_limit and process.is_alive():
                process.kill()
                process.join()
                findings.append(Finding("hang", at, f"more than {time_limit:g} s"))
        if process.exitcode != 0 and (not findings or findings[-1].index != done.value):
            findings.append(Finding("crash", done.value, f"the process ended with status {process.exitcode}"))
        start = count if process.exitcode == 0 else done.value + 1
    counts: Counter[str] = Counter()
    slowest, grown = 0.0, 0
    for line in report.read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        counts.update(record["counts"])
        findings += [Finding(*x) for x in record["findings"]]
        slowest, grown = max(slowest, record["slowest"]), max(grown, record["grown"])
    return Outcome(counts["read"], counts["refused"], sorted(findings, key=lambda x: x.index), slowest, grown)


def _work(
    name: str,
    read: Callable[[Path], Any],
    samples: Sequence[Sample],
    folder: Path,
    start: int,
    count: int,
    seed: int,
    memory_limit: int,
    done: Any,
    report: Path,
) -> None:
    """In the process of its own: reads from `start` on, and reports every now and then."""
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115  # parsers of other packages talk
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    size = pages * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + memory_limit, size + memory_limit))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    counts: Counter[str] = Counter()
    findings: list[Finding] = []
    slowest = 0.0

    def write() -> None:
        grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
        record = {"counts": counts, "findings": findings, "slowest": slowest, "grown": grown}
        with report.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
        counts.clear()
        findings.clear()

    for index in range(start, count):
        sample, content = damaged(samples, seed, name, index)
        for other, whole in sample.beside:
            (folder / other).write_bytes(whole)
        path = folder / sample.name
        path.write_bytes(content)
        del content
        done.value = index
        begun = time.monotonic()
        kind, finding = _try(read, path, index)
        slowest = max(slowest, time.monotonic() - begun)
        counts[kind] += 1
        findings += finding
        if index % 100 == 99 or finding:
            write()
    write()


def _try(read: Callable[[Path], Any], path: Path, index: int) -> tuple[str, list[Finding]]:
    try:
        read(path)
    except DOCUMENTED as error:
        message = str(error)
        if "\n" in message or str(path.parent) not in message or len(message) > 2000:
            return "refused", [Finding("message", index, f"{type(error).__name__}: {message[:300]!r}")]
        return "refused", []
    except MemoryError as error:
        return "memory", [Finding("memory", index, repr(error)[:300])]
    except BaseException as error:
        return "crash", [Finding("crash", index, repr(error)[:300])]
    return "read", []
