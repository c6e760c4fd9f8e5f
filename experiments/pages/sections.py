"""What the reference pages need of docstrings: an empty line above each section, which Griffe asks for."""

import re
from typing import Any

import griffe

_TITLE = re.compile(
    r"(?<!\n\n)^(?=(?:Args|Arguments|Returns|Raises|Yields|Examples|Attributes|Differentiable\b[^\n]*):?)",
    re.M,
)


class Sections(griffe.Extension):
    """Puts empty lines where the sections of a docstring follow each other without."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = _TITLE.sub("\n", obj.docstring.value)
