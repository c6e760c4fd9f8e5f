"""The watch over readers sees what they must not do. What they do: experiments/fuzz_readers.py --smoke."""

import gzip
import random
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

pytest.importorskip("resource", reason="limits on memory are set the Unix way")


@pytest.fixture
def fuzzing(monkeypatch):
    """The parts of the experiment, imported as it imports them."""
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))
    from fuzzing import mutate, watch

    return watch, mutate


def test_a_reader_that_misbehaves_is_found_out(fuzzing, tmp_path):
    watch, _ = fuzzing
    seen = tmp_path / "seen"
    seen.write_text("")

    def read(path):
        number = len(seen.read_text())
        seen.write_text("x" * (number + 1))
        if number == 2:
            raise ValueError(f"{path}: no")
        if number == 4:
            raise KeyError("x")
        if number == 6:
            time.sleep(60)
        if number == 8:
            bytearray(2**30)
        if number == 10:
            raise ValueError("two\nlines")
        if number == 12:
            import os

            os._exit(9)

    samples = [watch.Sample("x.txt", b"1 2 3\n" * 10)]
    outcome = watch.watch("test", read, samples, tmp_path, 16, 0, 3.0, 2**28)
    found = [(x.index, x.kind) for x in outcome.findings]
    assert found == [(4, "crash"), (6, "hang"), (8, "memory"), (10, "message"), (12, "crash")]
    assert "KeyError" in outcome.findings[0].detail
    assert "status 9" in outcome.findings[4].detail
    # What was read or refused since the last report of a process that is killed is lost from these counts.
    assert outcome.refused >= 1
    assert outcome.read >= 5


def test_damage_is_damage_and_the_same_again(fuzzing):
    watch, mutate = fuzzing
    samples = [
        watch.Sample("x.txt.gz", gzip.compress(b"1.5 2 3\n" * 20, mtime=0)),
        watch.Sample("y", b"a: 1\n" * 20),
    ]
    inputs = [watch.damaged(samples, 3, "reader", i) for i in range(200)]
    assert inputs == [watch.damaged(samples, 3, "reader", i) for i in range(200)]
    assert inputs != [watch.damaged(samples, 4, "reader", i) for i in range(200)]
    assert sum(content != sample.content for sample, content in inputs) > 190
    for damage in mutate.SIMPLE:  # on nothing, too
        assert isinstance(damage(b"", random.Random(0)), bytes)


def test_bombs_are_refused_before_they_fill_the_memory(fuzzing, tmp_path):
    import resource

    import torchspline.io as io

    _, mutate = fuzzing
    tum = b"1.5 1 2 3 0 0 0 1\n"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    packed = gzip.compress(tum * (2**26 // len(tum)), 1)
    (tmp_path / "x.txt").write_bytes(packed)
    with pytest.raises(ValueError, match=r"x.txt: expected gzipped text, got \d+ bytes that hold more than"):
        io.read_poses(tmp_path / "x.txt")
    aliases = mutate.aliases(random.Random(0))
    (tmp_path / "x.yaml").write_bytes(aliases)
    with pytest.raises(ValueError, match=r"x.yaml: expected YAML of settings, got more than 100000 entries"):
        io.read_imu_parameters(tmp_path / "x.yaml")
    unit = 1 if sys.platform == "darwin" else 1024
    assert unit * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < 2**28
