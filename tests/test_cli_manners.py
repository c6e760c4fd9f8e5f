"""How all commands behave in a shell: interrupts, pipes, examples, results that are whole or not there."""

import os
import shlex
import stat
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from test_cli import torchspline
from test_cli_commands import GOOD, filled, places, reference  # noqa: F401  # fixtures

from torchspline import cli
from torchspline.cli.arguments import STATUS, parse
from torchspline.io.archive import replacing, write_bytes

#: Which commands write files, that is.
WRITING = [name for name, words in GOOD.items() if "{out}" in " ".join(words)]


@pytest.mark.parametrize("name", WRITING)
def test_whoever_interrupts_finds_no_half_of_a_file(name, places, tmp_path, monkeypatch):  # noqa: F811
    """Ctrl-C when the first file is written, but is not yet what it is to be called."""
    if name == "generate":
        pytest.importorskip("pyarrow")
    written = []

    def interrupted(part, target):
        written.append(part.stat().st_size)
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    done = torchspline(*name.split(), *filled(GOOD[name], places, tmp_path))
    assert done.returncode == 130
    assert written[0] > 0
    left = [path.name for path in tmp_path.rglob("*") if path.is_file()]
    # The data set of `generate` has a lock and what it is made of, and goes on where it was.
    assert not [x for x in left if name != "generate" or x.endswith((".parquet", ".tmp"))]


def test_files_are_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "x.txt"
    path.write_text("before")
    path.chmod(0o640)
    (tmp_path / "link.txt").symlink_to(path)
    with pytest.raises(ZeroDivisionError), replacing(path) as part:  # noqa: PT012
        part.write_text("half")
        1 / 0  # noqa: B018
    assert path.read_text() == "before"
    write_bytes(tmp_path / "link.txt", b"after")
    assert path.read_text() == "after"
    assert (tmp_path / "link.txt").is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert sorted(x.name for x in tmp_path.iterdir()) == ["link.txt", "x.txt"]
    with pytest.raises(FileNotFoundError, match="make it first"):
        write_bytes(tmp_path / "none" / "x.txt", b"")
    with pytest.raises(FileExistsError, match=str(path)), replacing(path) as part:
        raise FileExistsError(17, "File exists", str(part))  # blamed on the file, not on its part


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_pipes_are_written_to_and_stay(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_bytes(pipe, b"content")
        assert os.read(reader, 100) == b"content"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_reader_that_has_enough_is_no_error():
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "from torchspline import cli; cli.main(['kernels', 'show', 'SO3', '--order', '2'])",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    with process.stderr:
        said = process.stderr.read()
    assert (process.wait(60), said) == (0, b"")


def examples():
    for name, command in cli.COMMANDS.items():
        for line in import_module(command.module).EXAMPLES.strip().splitlines():
            for part in shlex.split(line, comments=True) and line.split("|"):
                words = shlex.split(part, comments=True)
                if words and words[0] == "torchspline":
                    yield name, words[1:]
                else:
                    assert line.split()[0] in ("torchspline", "gunzip", "python", "torchrun"), line


@pytest.mark.parametrize(
    ("name", "words"), examples(), ids=lambda x: x if isinstance(x, str) else " ".join(x)
)
def test_examples_are_understood(name, words, tmp_path, monkeypatch):
    monkeypatch.chdir(Path(cli.__file__).parent.parent.parent)  # where the configurations are
    words = words[: words.index(">")] if ">" in words else words
    command = cli.COMMANDS[name]
    if name == "calibrate camera-imu":
        monkeypatch.chdir(tmp_path)
        (tmp_path / "config.yaml").write_text("cam0: {}\n")
    count = len(name.split())
    assert words[:count] == name.split()
    call, _ = parse(name, getattr(import_module(command.module), command.function), words[count:])
    given = [str(x) for x in call.keywords.values()]  # the file that comes first is what the command works on
    assert not words[count:] or words[count].startswith("-") or words[count] in given


def test_exit_statuses_are_the_same_and_said_everywhere():
    assert f"E{STATUS[1:]}" in torchspline("--help").stdout
    for name in cli.COMMANDS:
        assert torchspline(*name.split(), "--help").stdout.rstrip().endswith(STATUS)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fit", "{poses}", "--spacing", "1e300"), "spacing: expected a number above zero (ms)"),
        (("fit", "{poses}", "--start", "1e300"), "start: expected seconds, zero or more, got 1e+300"),
        (("fit", "{poses}", "--duration=-1e300"), "duration: expected seconds above zero"),
        (("fit", "{poses}", "--gap", "0"), "gap: expected milliseconds above zero"),
        (("kernels", "show", "SO3", "--order", "99999999999"), "order: expected at most 20"),
        (("imu", "{poses}", "--margin", "1e300"), "margin: expected seconds, zero or more"),
        (
            ("demo", "--duration", "1e18", "--out", "{out}"),
            "duration: expected at most 100000 s",
        ),
    ],
)
def test_numbers_at_the_edge(words, message, places, tmp_path):  # noqa: F811
    done = torchspline(*filled(words, places, tmp_path))
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_trajectory_goes_into_a_device(places):  # noqa: F811
    done = torchspline("fit", places["poses"], "--spacing", "500", "--order", "4", "--out", "/dev/null")
    assert done.returncode == 0, done.stderr
    assert not Path("/dev/null").is_file()
