"""What the reference pages need of docstrings: an empty line above each section, which Griffe asks for, a line of its
own for each of several parameters that are described together, and the fields of classes, which comments describe.
"""

import re
from pathlib import Path
from typing import Any

import griffe

_TITLE = re.compile(
    r"(?<!\n\n)^(?=(?:Args|Arguments|Returns|Raises|Yields|Examples|Attributes|Differentiable\b[^\n]*):?)",
    re.M,
)
_ARGUMENTS = re.compile(r"^Arg(?:ument)?s:\n((?:[ \t]+[^\n]*\n?|\n)+)", re.M)
#: Some names, their description and the lines that go on with it, which stand further in.
_TOGETHER = re.compile(r"^( {4})(\w+), (\w+(?:, \w+)*): ([^\n]*(?:\n {5,}[^\n]*|\n(?= *\n {5,}))*)", re.M)
#: A line of a section on errors that goes on with the one before, as far in as that.
_ERRORS = re.compile(r"^Raises:\n((?:[ \t]+[^\n]*\n?|\n)+)", re.M)
_GOES_ON = re.compile(r"^    (?=\S)(?!\w+(?:, \w+)*:)", re.M)
#: Where another parameter or error begins on the same line.
_NEXT_ARGUMENT = re.compile(r"(?<=[.;]) (?=(?:[a-z]\w*|T_\w+): )")
_NEXT_ERROR = re.compile(r"(?<=\.) (?=\w+Error: )")


def _apart(found: re.Match[str]) -> str:
    indent, first, others, text = found.groups()
    rest = "".join(f"\n{indent}{name}: see `{first}`." for name in others.split(", "))
    return f"{indent}{first}: {text}{rest}"


def fields(lines: list[str], numbers: dict[str, int]) -> dict[str, str]:
    """Of each field, by its name, what the comment `#:` above it says; fields below one another share it.

    Args:
        lines: of the file.
        numbers: line of each field, from 1, in their order.
    """
    found: dict[str, str] = {}
    described: tuple[str, int] | None = None  # a field with a comment, and the line of the last one below it
    for name, number in numbers.items():
        start = number - 1
        while start > 0 and lines[start - 1].strip().startswith("#:"):
            start -= 1
        comment = [line.strip().removeprefix("#:").strip() for line in lines[start : number - 1]]
        if comment:
            found[name] = "\n        ".join(comment)
            described = (name, number)
        elif described and number == described[1] + 1:
            found[name] = f"see `{described[0]}`."
            described = (described[0], number)
    return found


def divided(text: str) -> str:
    """A docstring with a line for each parameter and error, and empty lines above its sections."""
    text = _ARGUMENTS.sub(lambda found: _TOGETHER.sub(_apart, _NEXT_ARGUMENT.sub("\n    ", found[0])), text)
    text = _ERRORS.sub(lambda found: _GOES_ON.sub("        ", _NEXT_ERROR.sub("\n    ", found[0])), text)
    return _TITLE.sub("\n", text)


class Sections(griffe.Extension):
    """Sets sections, and parameters that share a description, apart; makes a table of fields."""

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        numbers = {
            name: x.lineno
            for name, x in cls.members.items()
            if x.is_attribute and x.lineno and not x.docstring and not name.startswith("_")
        }
        assert isinstance(cls.filepath, Path)
        found = fields(cls.filepath.read_text(encoding="utf-8").splitlines(), numbers)
        if found and "Attributes:\n" not in (cls.docstring.value if cls.docstring else ""):
            table = "Attributes:\n" + "\n".join(f"    {name}: {text}" for name, text in found.items())
            if cls.docstring is None:
                cls.docstring = griffe.Docstring("", parent=cls)
            cls.docstring.value = f"{cls.docstring.value}\n\n{table}"

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = divided(obj.docstring.value)
