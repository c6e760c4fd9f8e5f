"""YAML files of settings: plain data only, of a size that settings have, however it is written."""

import importlib
from pathlib import Path
from typing import Any

#: Larger files are no settings (bytes), nor are those with more entries once their aliases are written out.
_LARGEST, _MOST_ENTRIES = 2**18, 100_000


def read_yaml(path: Path, names: str) -> dict[Any, Any]:
    """The mapping at the top of a YAML file; nothing in it is executed.

    OpenCV's first line `%YAML:1.0` is understood. Aliases are, too, as long as what they stand for has a bounded size.

    Args:
        names: what is expected at its top, for messages, such as "keys such as rate".
    Raises:
        FileNotFoundError: no such file.
        ValueError: a folder, a file that is too large, no YAML, or no mapping at its top; one line names the file and,
            where there is one, the line.
    """
    yaml = importlib.import_module("yaml")
    if path.is_dir():
        raise ValueError(f"{path}: expected a file, got a folder")
    try:
        size = path.stat().st_size
        if size > _LARGEST:
            raise ValueError(f"{path}: expected YAML of at most {_LARGEST} bytes, got {size}")
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: expected a file, there is none (no such file)") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: expected a YAML file, got bytes that are no text: {error}") from None
    if text.startswith("%YAML:"):  # OpenCV writes a directive that YAML does not know
        text = text.partition("\n")[2]
    content: Any = None
    try:
        loader = yaml.SafeLoader(text)
        try:
            root = loader.get_single_node()
            if root is not None:
                if _entries(root, {}) > _MOST_ENTRIES:
                    raise ValueError(f"more than {_MOST_ENTRIES} entries")
                content = loader.construct_document(root)
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        where = getattr(error, "problem_mark", None)
        line = f", line {where.line + 1}" if where else ""
        problem = short(getattr(error, "problem", None) or error)
        raise ValueError(f"{path}{line}: expected YAML, got {problem}") from None
    except RecursionError:
        raise ValueError(f"{path}: expected YAML of settings, got entries nested too deeply") from None
    except (ValueError, TypeError, AttributeError, LookupError, OverflowError) as error:
        # Dates that are none, whole numbers of thousands of digits: the library lets such errors through.
        raise ValueError(f"{path}: expected YAML of settings, got {short(error)}") from None
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{path}: expected {names}, got {type(content).__name__}")
    return content


def short(x: Any, most: int = 200) -> str:
    """For messages: text in one line, cut. Of what `read_yaml` gives, the text is never longer than the memory."""
    text = " ".join(str(x).split())
    return text if len(text) <= most else f"{text[: most - 3]}..."


def _entries(node: Any, known: dict[int, float]) -> float:
    """How many there are with aliases written out; infinitely many where one is inside of what it stands for."""
    if id(node) in known:
        return known[id(node)]
    known[id(node)] = float("inf")
    value = node.value if isinstance(node.value, list) else []
    inside = (child for item in value for child in (item if isinstance(item, tuple) else (item,)))
    known[id(node)] = 1 + sum(_entries(child, known) for child in inside)
    return known[id(node)]
