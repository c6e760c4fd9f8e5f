"""What the reference pages need of docstrings: an empty line above each section, which Griffe asks for, and a line of
its own for each of several parameters that are described together.
"""

import re
from typing import Any

import griffe

_TITLE = re.compile(
    r"(?<!\n\n)^(?=(?:Args|Arguments|Returns|Raises|Yields|Examples|Attributes|Differentiable\b[^\n]*):?)",
    re.M,
)
_ARGUMENTS = re.compile(r"^Args:\n((?:[ \t]+[^\n]*\n?|\n)+)", re.M)
#: Some names, their description and the lines that go on with it, which stand further in.
_TOGETHER = re.compile(r"^( {4})(\w+), (\w+(?:, \w+)*): ([^\n]*(?:\n {5,}[^\n]*|\n(?= *\n {5,}))*)", re.M)


def _apart(found: re.Match[str]) -> str:
    indent, first, others, text = found.groups()
    rest = "".join(f"\n{indent}{name}: see `{first}`." for name in others.split(", "))
    return f"{indent}{first}: {text}{rest}"


class Sections(griffe.Extension):
    """Sets sections, and parameters that share a description, apart."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring:
            text = _ARGUMENTS.sub(lambda found: _TOGETHER.sub(_apart, found[0]), obj.docstring.value)
            obj.docstring.value = _TITLE.sub("\n", text)
