"""The command line. `COMMANDS` lists the commands; a new one is a module beside this one and a line in it."""

import errno
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from io import TextIOWrapper
from typing import NamedTuple

from torchspline.cli.arguments import STATUS, Mistake, parse
from torchspline.cli.report import Report


class Command(NamedTuple):
    """Where a command is, and what it is for."""

    #: Module that holds the function and, if there are any, `EXAMPLES` for its help.
    module: str
    function: str
    summary: str


_HERE = "torchspline.cli"
COMMANDS: dict[str, Command] = {
    "demo": Command(
        f"{_HERE}.demo", "demo", "a known motion, noisy poses of it, a fit, its IMU signal, checked"
    ),
    "fit": Command(f"{_HERE}.fit", "fit", "a spline through a file of poses"),
    "imu": Command(f"{_HERE}.imu", "imu", "IMU readings from a file of poses, compared with a recording"),
    "body": Command(f"{_HERE}.body", "body", "IMU readings on every joint of a captured motion (BVH)"),
    "generate": Command(
        f"{_HERE}.generate", "generate", "random motions and IMUs on them, as data to train on"
    ),
    "calibrate camera-imu": Command(
        f"{_HERE}.calibrate", "camera_imu", "where cameras sit on an IMU, from images of a board"
    ),
    "bench": Command(f"{_HERE}.bench", "bench", "how long the main calls take on this machine"),
    "view": Command(f"{_HERE}.view", "view", "a page with an interactive 3D view of a file"),
    "explore": Command(f"{_HERE}.explore", "explore", "compare interpolation methods in the browser"),
    "convert": Command(f"{_HERE}.convert", "convert", "between file formats of poses and IMU readings"),
    "info": Command(f"{_HERE}.info", "info", "what is in a file"),
    "kernels show": Command(f"{_HERE}.kernels", "show", "the source of a compiled loop"),
}
_EXPECTED = (TypeError, ValueError, OSError, MemoryError, ImportError)
#: What to do about a file, by what the system says of it.
_ADVICE = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "make room or choose another place"),
    **dict.fromkeys(
        (errno.EACCES, errno.EPERM, errno.EROFS), "change its permissions or choose another place"
    ),
    errno.EISDIR: "name a file in it",
    errno.ENAMETOOLONG: "choose a shorter one",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `torchspline` command: exits with what `run` returns."""
    if sys.stdout is None:  # closed
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # units have characters that some terminals have not
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(words: Sequence[str]) -> int:
    """Run the command that `words` say and return its exit status: 0, 1 if a check failed, 2 on bad input, 130."""
    try:
        status = _run(words)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # whoever read has enough; what is left goes nowhere
        _drop_output()
        return 0
    except OSError as error:
        _drop_output()
        return _refuse(_said(error))
    except KeyboardInterrupt:
        return 130


def _run(words: Sequence[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print(_overview())
        return 0 if words else 2
    if words[0] == "--version":
        from importlib.metadata import version

        print(version("torchspline"))
        return 0
    name = next((x for x in (" ".join(words[:2]), words[0]) if x in COMMANDS), None)
    if name is None:
        inner = [x for x in COMMANDS if x.split()[0] == words[0]]
        if inner and words[1:2] in ([], ["-h"], ["--help"]):
            print(_overview(inner))
            return 0 if words[1:] else 2
        return _refuse(
            f"{' '.join(words[:2])!r} is no command; expected one of {', '.join(inner or COMMANDS)}"
        )
    command = COMMANDS[name]
    try:
        module = import_module(command.module)
        call, as_json = parse(
            f"torchspline {name}", getattr(module, command.function), words[len(name.split()) :],
            getattr(module, "EXAMPLES", ""),
        )  # fmt: skip
        found = call()
        if not isinstance(found, Report):
            return int(found)
        found.print_json(name) if as_json else found.print()
        return 0 if found.passed else 1
    except Mistake as mistake:
        return _refuse(f"{mistake} (torchspline {name} --help says more)")
    except BrokenPipeError:
        raise
    except _EXPECTED as error:
        return _refuse(_said(error))


def _drop_output() -> None:
    """What is still to be printed goes nowhere, so that ending does not try again."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _said(error: BaseException) -> str:
    if isinstance(error, MemoryError) and not str(error):
        return "there is not enough memory for this; take a part of it, or a machine that has more"
    if not isinstance(error, OSError) or error.strerror is None:
        return str(error) or type(error).__name__
    said = f"{error.strerror[:1].lower()}{error.strerror[1:]}"
    if error.filename is not None:
        said = f"{os.fsdecode(error.filename)}: {said}"
    return f"{said}; {_ADVICE[error.errno]}" if error.errno in _ADVICE else said


def _refuse(message: str) -> int:
    # Names in files are repeated, and could hold what moves the cursor or colours the terminal.
    shown = "".join(x if x.isprintable() else repr(x)[1:-1] for x in " ".join(message.split()))
    print(f"torchspline: {shown}", file=sys.stderr)
    return 2


def _overview(names: Sequence[str] = tuple(COMMANDS)) -> str:
    width = max(map(len, names)) + 2
    lines = [f"  {name:<{width}}{COMMANDS[name].summary}" for name in names]
    return "\n".join(
        [
            "usage: torchspline COMMAND ...",
            "",
            "Continuous-time motion: splines on Lie groups.",
            "",
            *lines,
            "",
            "torchspline COMMAND --help shows arguments and examples; --json makes a command print one line of JSON.",
            f"E{STATUS[1:]}.",
        ]
    )
