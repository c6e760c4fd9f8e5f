"""What an MJCF file may ask for: MuJoCo's compiler spends time and memory on what a few words say, without a limit."""

import math
from collections.abc import Mapping
from pathlib import Path
from xml.parsers import expat

#: Elements, written out, and numbers of a grid or picture beyond which a file is taken for something else.
_MOST_ELEMENTS, _MOST_NUMBERS, _DEEPEST = 100_000, 10_000_000, 400
#: Attributes that multiply: of elements, and of numbers.
_MADE = {"composite": ("count",), "flexcomp": ("count",)}
_STORED = {"hfield": ("nrow", "ncol"), "texture": ("width", "height")}


def check_mjcf(text: bytes) -> None:
    """Refuse XML whose size is not that of its text, before anything is made of it.

    Raises:
        ValueError: no XML, entities of its own, elements that go deeper than 400, more than 100,000 elements with
            their copies, a grid or picture of more than 1e7 numbers, or a file to include that is none (a device).
    """
    copies: list[int] = [1]
    made = 0

    def doctype(*_: object) -> None:
        raise ValueError("a document type with entities of its own; expected none")

    def start(tag: str, attributes: Mapping[str, str]) -> None:
        nonlocal made
        if len(copies) > _DEEPEST:
            raise ValueError(f"elements that go deeper than {_DEEPEST}")
        factor = _product(attributes, ("count",)) if tag == "replicate" else 1
        copies.append(copies[-1] * factor)
        made += copies[-1] * _product(attributes, _MADE.get(tag, ()))
        if made > _MOST_ELEMENTS:
            raise ValueError(f"more than {_MOST_ELEMENTS} elements with all copies, at <{tag}>")
        if _product(attributes, _STORED.get(tag, ())) > _MOST_NUMBERS:
            raise ValueError(f"a <{tag}> of more than {_MOST_NUMBERS} numbers")
        file = Path(attributes.get("file", "."))
        if "file" in attributes and file.exists() and not file.is_file() and not file.is_dir():
            raise ValueError(f"a <{tag}> from {str(file)[:80]!r}, which is no regular file")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = doctype
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: copies.pop()
    try:
        parser.Parse(text, True)
    except expat.ExpatError as reason:
        raise ValueError(f"XML Error: {reason}") from None


def _product(attributes: Mapping[str, str], names: tuple[str, ...]) -> int:
    """Of the whole numbers in these attributes; what is no number is for MuJoCo to refuse."""
    found = 1
    for word in " ".join(attributes.get(name, "1") for name in names).split():
        try:
            x = float(word)
        except ValueError:
            continue
        found *= max(1, int(min(x, 1e12))) if not math.isnan(x) else 1
    return found
