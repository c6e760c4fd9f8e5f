"""What a command has to say, for people and for scripts."""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass
class Report:
    """Printed as a table, or as one line of JSON."""

    title: str
    #: What scripts read: names with units, plain values.
    values: dict[str, Any]
    #: Rows of the table: what, value, unit, unless `columns` says otherwise.
    rows: Sequence[tuple[str, ...]] = ()
    #: Things a careful user wants to know, in words.
    notes: list[str] = field(default_factory=list)
    #: What was written.
    files: list[Path] = field(default_factory=list)
    #: Whether what was checked is as it should be.
    passed: bool = True
    #: Printed as it is, before all else; scripts find it in the values.
    text: str = ""
    columns: tuple[str, ...] = ("", "value", "unit")
    #: Whether standard output has the data, and this goes to standard error.
    aside: bool = False

    def print(self) -> None:
        """On standard output, or aside."""
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text

        if self.text:
            print(self.text)
        console = Console(stderr=self.aside)
        if self.rows:
            table = Table(*self.columns, title=self.title)
            for row in self.rows:
                table.add_row(*map(Text, row))  # units in brackets are no markup
            console.print(table)
        for note in self.notes:
            console.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)
        if self.files:
            folders = {path.parent for path in self.files}
            if len(folders) == 1:
                names = " ".join(path.name for path in self.files)
                console.print(f"written to {folders.pop()}: {names}", markup=False, soft_wrap=True)
            else:
                console.print(f"written: {' '.join(map(str, self.files))}", markup=False, soft_wrap=True)

    def print_json(self, command: str) -> None:
        """One line, there as well; numbers that are not finite are null."""
        stream = sys.stderr if self.aside else sys.stdout
        print(json.dumps(self.as_dict(command), allow_nan=False), file=stream, flush=True)

    def as_dict(self, command: str) -> dict[str, Any]:
        """Everything as plain values."""
        return {
            "command": command,
            "passed": self.passed,
            **{name: plain(x) for name, x in self.values.items()},
            "notes": list(self.notes),
            "files": [str(path) for path in self.files],
        }


def plain(x: Any) -> Any:
    """As JSON can say it."""
    if isinstance(x, dict):
        return {str(key): plain(y) for key, y in x.items()}
    if isinstance(x, (list, tuple)):
        return [plain(y) for y in x]
    if isinstance(x, Path):
        return str(x)
    if isinstance(x, float) and not math.isfinite(x):
        return None
    return x
