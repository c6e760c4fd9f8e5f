"""Tables of numbers in text files: reading with errors that name the line, exact stamps, writing."""

import io
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_EVEN, Context, Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchspline.io.archive import read_bytes, write_bytes
from torchspline.units import SECOND

_INTEGER = re.compile(r"[+-]?[0-9]+")
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_EXACT = Context(prec=1000)
_INT64 = range(-(2**63), 2**63)


def parse_nanoseconds(field: str) -> int:
    """An integer number of nanoseconds, exactly; `ValueError` for anything else."""
    if not _INTEGER.fullmatch(field):
        raise ValueError("an integer number of nanoseconds")
    return _checked(int(field))


def parse_seconds(field: str) -> int:
    """Nanoseconds from decimal seconds, exactly; digits past the ninth are rounded, half to even.

    The text never passes through a float. Raises `ValueError` for anything that is not a finite number.
    """
    if not _DECIMAL.fullmatch(field):
        raise ValueError("a finite number of seconds")
    try:
        seconds = Decimal(field)
    except ArithmeticError:  # an exponent of twenty digits
        return _checked(_INT64.stop)
    if seconds and seconds.adjusted() > 10:  # before an exponent such as 1e999999 becomes an integer
        return _checked(_INT64.stop)
    return _checked(int(seconds.scaleb(9, _EXACT).to_integral_value(ROUND_HALF_EVEN)))


def format_seconds(time_ns: int) -> str:
    """Decimal seconds with nine digits, exactly."""
    whole, fraction = divmod(abs(time_ns), SECOND)
    return f"{'-' if time_ns < 0 else ''}{whole}.{fraction:09d}"


def _checked(time_ns: int) -> int:
    if time_ns not in _INT64:
        raise ValueError("a time within the range of int64 nanoseconds (292 years)")
    return time_ns


@dataclass(frozen=True)
class Table:
    """The rows of a text file split into fields, comments and header set apart, nothing converted yet.

    Attributes:
        path: the file.
        head: the comments and the header, one a line.
        lines: the line number of each row in the file, counted from 1.
        rows: the fields of each row.
        commas: whether commas separate the fields (else white space).
    """

    path: Path
    head: str
    lines: Sequence[int]
    rows: Sequence[list[str]]
    commas: bool

    @property
    def columns(self) -> int:
        """The number of fields that most rows have."""
        return Counter(map(len, self.rows)).most_common(1)[0][0]

    @property
    def unit_of_time(self) -> str | None:
        """ "ns" or "s" for the first column, or None where the text does not tell."""
        stamps = [row[0] for row in self.rows]
        if 2 * sum(_INTEGER.fullmatch(stamp) is not None for stamp in stamps) < len(stamps):
            return "s"
        if "[ns]" in self.head:
            return "ns"
        epoch = any(len(stamp) >= 13 for stamp in stamps)  # as seconds, 30,000 years
        if epoch != self.commas:
            return None
        return "ns" if epoch else "s"

    def error(self, row: int, got: str, expected: str) -> ValueError:
        """A `ValueError` that names the file, the line, what came and what was expected."""
        got = got if len(got) <= 120 else f"{got[:117]}..."
        return ValueError(f"{self.path}, line {self.lines[row]}: expected {expected}, got {got}")

    def excerpt(self, row: int) -> str:
        """The row as it came, quoted and cut to a length that suits a message."""
        text = (", " if self.commas else " ").join(self.rows[row])
        return repr(text if len(text) <= 80 else text[:77] + "...")

    def check_columns(self, names: Sequence[str], more: bool = False) -> None:
        """Refuse rows that do not have the columns `names` (`more`: others may follow)."""
        count = len(names)
        for row, fields in enumerate(self.rows):
            if len(fields) != count and not (more and len(fields) > count):
                wanted = f"{'at least ' if more else ''}{count} columns ({' '.join(names)})"
                raise self.error(row, f"{len(fields)}: {self.excerpt(row)}", wanted)

    def stamps(self, parse: Callable[[str], int]) -> NDArray[np.int64]:
        """The first column as int64 nanoseconds, (N,), each field read by `parse`."""
        result = np.empty(len(self.rows), np.int64)
        for row, fields in enumerate(self.rows):
            try:
                result[row] = parse(fields[0])
            except ValueError as reason:
                raise self.error(row, repr(fields[0]), f"{reason} in column 1") from None
        return result

    def values(self, start: int, stop: int) -> NDArray[np.float64]:
        """The columns `start` to `stop - 1` as float64, (N, stop - start); NaN and infinity pass."""
        flat = [field for fields in self.rows for field in fields[start:stop]]
        try:
            if "_" in "".join(flat):  # float() takes 1_000
                raise ValueError
            numbers = list(map(float, flat))
        except ValueError:
            at = next(i for i, field in enumerate(flat) if not _is_number(field))
            row, column = divmod(at, stop - start)
            raise self.error(row, repr(flat[at]), f"a number in column {start + column + 1}") from None
        return np.array(numbers).reshape(-1, stop - start)

    def quaternions(self, start: int, order: str) -> NDArray[np.float64]:
        """Four columns from `start`, stored in `order` ("wxyz", "xyzw"), as [w, x, y, z]; refuses zeros."""
        stored = self.values(start, start + 4)
        zero = ~stored.any(axis=1)
        if zero.any():
            row = int(zero.argmax())
            raise self.error(row, self.excerpt(row), f"a quaternion {order}, not zero")
        return stored[:, [order.index(component) for component in "wxyz"]]


def read_table(path: Path) -> Table:
    """Split a text file, plain or gzipped, into the fields of its rows.

    Commas or white space separate fields. Lines that start with `#`, blank lines, a header without any number
    in it, a byte order mark and the line endings of any system are understood.

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged gzip, or a file without any row.
    """
    # Bytes that are no text become fields that are no numbers, and those are reported with their line.
    text = read_bytes(path).decode("utf-8-sig", errors="replace")
    head: list[str] = []
    lines: list[int] = []
    rows: list[list[str]] = []
    header = commas = False
    for number, line in enumerate(io.StringIO(text, newline=None), 1):  # a line in memory at a time
        line = line.strip()
        if not line:
            continue
        if line[0] == "#":
            head.append(line)
        elif not rows and not header and not any(map(_is_number, re.split(r"[,\s]+", line))):
            head.append(line)
            header = True  # a second line of words is an error, reported with its number
        else:
            fields = line.rstrip(",").split(",") if "," in line else line.split()
            fields[0] = fields[0].rstrip()
            lines.append(number)
            rows.append(fields)
            commas = commas or "," in line
    if not rows:
        raise ValueError(f"{path}: expected rows of numbers, got a file without any")
    return Table(path, "\n".join(head), lines, rows, commas)


def write_table(
    path: Path, head: str, stamps: Iterable[str], values: NDArray[np.float64], separator: str
) -> None:
    """Write a header, if there is one, then a stamp and numbers a line, with digits that give back the same float64.

    Without stamps, numbers alone.

    Gzipped when the name ends with .gz. Raises `FileNotFoundError` where the folder does not exist.
    """
    numbers = (separator.join(map(repr, row)) for row in values.tolist())
    first = list(stamps)
    rows = map(separator.join, zip(first, numbers, strict=True)) if first else numbers
    write_bytes(path, "\n".join([*([head] if head else []), *rows, ""]).encode())


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return "_" not in field
