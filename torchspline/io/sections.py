"""YAML files of named sections, as calibration tools write them."""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from torchspline.io.yaml import read_yaml, short


def read_sections(path: str | PathLike[str]) -> dict[str, Any]:
    """The entries of a YAML file by name; nothing in it is executed.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no YAML, or no names at its top level.
    """
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"path: expected a path, got {type(path).__name__}")
    return read_yaml(Path(path), "sections such as cam0 and imu0")


def numbered(content: Mapping[str, Any], kind: str) -> list[str]:
    """Names of the sections of a kind: cam0, cam1, ..., in the order of their numbers."""
    found = [x for x in content if isinstance(x, str) and x.startswith(kind) and x[len(kind) :].isdecimal()]
    return sorted(found, key=lambda x: int(x[len(kind) :]))


def section_of(path: Path, content: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The section of this name.

    Raises:
        ValueError: it is no section.
    """
    section = content[name]
    if not isinstance(section, dict):
        raise ValueError(f"{path}: {name}: expected a section of entries, got {type(section).__name__}")
    return section


def number(name: str, x: Any) -> float:
    """A number of a YAML file: YAML 1.1 takes 2e-3 for a word.

    Raises:
        ValueError: no number.
    """
    try:
        if not isinstance(x, (int, float, str)) or isinstance(x, bool):
            raise ValueError
        return float(x)
    except (ValueError, OverflowError):
        raise ValueError(f"{name}: expected a number, got {short(repr(x))}") from None
