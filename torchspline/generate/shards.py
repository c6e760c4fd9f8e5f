"""Data sets on disk: Parquet shards that are there in full or not at all, whoever is killed when."""

import glob
import hashlib
import importlib.metadata
import json
import operator
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import torch
from torch.utils.data import Dataset

from torchspline import checks
from torchspline.generate.blocks import Column, compute_block, items_per_block, rows
from torchspline.generate.processes import rank_and_world
from torchspline.generate.recipe import Recipe
from torchspline.io.yaml import short
from torchspline.kernels import mode
from torchspline.kernels.build import available

FORMAT = "torchspline items 1"
MANIFEST = "dataset.json"
#: Keys of the metadata of a shard.
_DATASET, _SHARD = b"torchspline.dataset", b"torchspline.shard"


class Written(NamedTuple):
    """What `write` did in this process: shards and items that it wrote, and shards that were there already."""

    shards: int
    items: int
    kept: int


def write(
    recipe: Recipe,
    folder: str | PathLike[str],
    seed: int,
    items: int,
    items_per_shard: int = 256,
    progress: Callable[[int, int], None] | None = None,
) -> Written:
    """Write the items 0 to `items - 1` as Parquet files, and go on where an earlier call was interrupted.

    Under `torchrun` every process writes the shards whose number, divided by the number of processes, leaves its rank.
    A file appears under its name once it is complete and on disk, so a process may be killed at any time. The same
    recipe, seed and versions of the libraries make the same bytes on the same kind of processor, whatever the number of
    processes and interruptions.

    Args:
        recipe: what items are drawn from. seed: of all random numbers, 0 or more.
        folder: where the files go; made if it is not there.
        items: how many. items_per_shard: items of a file; best a multiple of `items_per_block(recipe)`.
        progress: called with the items done and all items of this process.
    Raises:
        ModuleNotFoundError: without pyarrow, `pip install 'torchspline[generate]'`.
        TypeError, ValueError: a wrong type or value, or a folder that holds another data set.
    """
    checks.instance("recipe", recipe, Recipe, "a Recipe")
    checks.whole("seed", seed, 0)
    checks.whole("items", items, 1)
    checks.whole("items_per_shard", items_per_shard, 1)
    pyarrow()
    folder = _path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rank, world = rank_and_world()
    manifest = _manifest(recipe, seed, items, items_per_shard)
    _agree(folder, manifest)
    if rank == 0:
        _remove_leftovers(folder, MANIFEST)
        if not (folder / MANIFEST).exists():
            with _whole_file(folder / MANIFEST) as file:
                file.write(_text(manifest).encode())

    mine = range(rank, manifest["shards"], world)
    total = sum(_count(manifest, shard) for shard in mine)
    done = written = kept = added = 0
    for shard in mine:
        _remove_leftovers(folder, shard_name(shard))
        count = _count(manifest, shard)
        if _is_complete(folder / shard_name(shard), manifest, shard):
            kept += 1
        else:
            with _whole_file(folder / shard_name(shard)) as file:
                _write_shard(file, recipe, manifest, shard)
            written, added = written + 1, added + count
        done += count
        if progress:
            progress(done, total)
    return Written(written, added, kept)


def read(folder: str | PathLike[str]) -> "ShardedDataset":
    """A data set that `write` made, checked to be complete.

    Raises:
        ModuleNotFoundError: without pyarrow. FileNotFoundError: no data set there, or shards are missing.
        ValueError: a shard that belongs to another data set or is damaged.
    """
    return ShardedDataset(folder)


class ShardedDataset(Dataset):
    """Items of a data set on disk, as `GeneratedDataset` makes them, by index; see `read`.

    Neighbouring items are read together, so going through them in order is fastest.

    Attributes:
        manifest: recipe, seed, number of items and versions.
        files: the Parquet files, in the order of the items.
    """

    def __init__(self, folder: str | PathLike[str]):
        pyarrow()
        folder = _path(folder)
        if not (folder / MANIFEST).is_file():
            raise FileNotFoundError(f"folder: expected {MANIFEST} in it, found none in {folder}")
        self.manifest = _read_manifest(folder)
        numbers = range(self.manifest["shards"])
        self.files = [folder / shard_name(shard) for shard in numbers]
        missing = [path.name for path in self.files if not path.is_file()]
        if missing:
            raise FileNotFoundError(
                f"folder: expected {len(self.files)} shards in {folder}, {len(missing)} are missing "
                f"({', '.join(missing[:3])}{', ...' if len(missing) > 3 else ''}); generate again to complete it"
            )
        for shard, path in enumerate(self.files):
            if not _is_complete(path, self.manifest, shard):
                raise ValueError(f"folder: {path} is damaged; remove it and generate again to replace it")
        self._held: tuple[int, int, dict[str, Column]] | None = None

    def __len__(self) -> int:
        return self.manifest["items"]

    def __getitem__(self, index: int) -> dict[str, Any]:
        try:
            index = operator.index(index)
        except TypeError:
            raise TypeError(f"index: expected a whole number, got {type(index).__name__}") from None
        if not -len(self) <= index < len(self):
            raise IndexError(f"index: expected one below {len(self)}, got {index}")
        index %= len(self)
        if self._held is None or not self._held[0] <= index < self._held[1]:
            self._held = self._load(index)
        first, _, columns = self._held
        return {name: x[index - first] for name, x in columns.items()}

    def _load(self, index: int) -> tuple[int, int, dict[str, Column]]:
        """The row group of an item: its first and last index, and its columns."""
        parquet = pyarrow().parquet
        shard = index // self.manifest["items_per_shard"]
        first = shard * self.manifest["items_per_shard"]
        try:
            with parquet.ParquetFile(self.files[shard], page_checksum_verification=True) as file:
                group = 0
                while index >= first + (size := file.metadata.row_group(group).num_rows):
                    first, group = first + size, group + 1
                table = file.read_row_group(group)
            columns = {name: _column(table[name]) for name in table.column_names}
        except (OSError, TypeError, ValueError, LookupError, pyarrow().ArrowException) as error:
            raise ValueError(f"folder: {self.files[shard]} is damaged: {short(error)}") from None
        return first, first + size, columns


def pyarrow() -> Any:
    """The library that reads and writes Parquet."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{error.name} reads and writes Parquet files: pip install 'torchspline[generate]'",
            name=error.name,
        ) from None
    return pyarrow


def shard_name(shard: int) -> str:
    return f"shard-{shard:06d}.parquet"


# ---------------------------------------------------------------------- parts


def _path(folder: str | PathLike[str]) -> Path:
    if not isinstance(folder, (str, PathLike)):
        raise TypeError(f"folder: expected a path, got {type(folder).__name__}")
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise ValueError(f"folder: expected a folder, got the file {path}")
    return path


def _manifest(recipe: Recipe, seed: int, items: int, items_per_shard: int) -> dict[str, Any]:
    """All that determines the bytes."""
    versions = {name: importlib.metadata.version(name) for name in ("torchspline", "torch", "pyarrow")}
    compiled = mode.current() != "reference" and available()
    return {
        "format": FORMAT,
        "recipe": recipe.as_dict(),
        "seed": seed,
        "items": items,
        "items_per_shard": items_per_shard,
        "shards": -(-items // items_per_shard),
        "kernels": "fused" if compiled else "reference",
        "versions": versions,
    }


def _text(manifest: dict[str, Any]) -> str:
    return json.dumps(manifest, indent=2) + "\n"


def _read_manifest(folder: Path) -> dict[str, Any]:
    """What `_text` wrote, of a size that agrees with itself."""
    path = folder / MANIFEST
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # neither JSON nor text
        raise ValueError(f"folder: {path} is damaged: {short(error)}; choose another folder") from None
    name = found.get("format") if isinstance(found, dict) else found
    if name != FORMAT:
        got = short(repr(name))
        raise ValueError(f"folder: expected a data set of format {FORMAT!r} in {folder}, got {got}")
    try:
        for name in ("items", "items_per_shard", "shards"):
            checks.whole(name, found.get(name), least=1)
    except (TypeError, ValueError) as error:
        raise ValueError(f"folder: {path} is damaged: {short(error)}") from None
    if found["shards"] != -(-found["items"] // found["items_per_shard"]):
        raise ValueError(
            f"folder: {path} is damaged: shards: expected as many as items need, got {found['shards']}"
        )
    return found


def _agree(folder: Path, manifest: dict[str, Any]) -> None:
    if not (folder / MANIFEST).exists():
        return
    there = _read_manifest(folder)
    different = [name for name in manifest | there if manifest.get(name) != there.get(name)]
    if different:
        name = different[0]
        raise ValueError(
            f"folder: {folder} holds another data set, with other {', '.join(different)} "
            f"({name}: expected {manifest.get(name)!r}, got {there.get(name)!r}); choose another folder"
        )


def _count(manifest: dict[str, Any], shard: int) -> int:
    size = manifest["items_per_shard"]
    return min(size, manifest["items"] - shard * size)


def _is_complete(path: Path, manifest: dict[str, Any], shard: int) -> bool:
    """Whether the shard is there and readable; an error if it belongs to another data set."""
    if path.exists() and not path.is_file():
        raise ValueError(f"folder: expected {path} to be a file, got a folder; remove it")
    if not path.is_file():
        return False
    library = pyarrow()
    try:
        found = library.parquet.read_metadata(path)
    except (library.ArrowException, OSError, ValueError):  # names that are no text, too
        return False
    metadata = found.metadata or {}
    if (metadata.get(_DATASET), metadata.get(_SHARD)) != (_digest(manifest), str(shard).encode()):
        raise ValueError(f"folder: {path} belongs to another data set than {MANIFEST}; choose another folder")
    return found.num_rows == _count(manifest, shard)


def _digest(manifest: dict[str, Any]) -> bytes:
    return hashlib.sha256(_text(manifest).encode()).hexdigest().encode()


def _write_shard(file: BinaryIO, recipe: Recipe, manifest: dict[str, Any], shard: int) -> None:
    library = pyarrow()
    size, block = manifest["items_per_shard"], items_per_block(recipe)
    start = shard * size
    stop = start + _count(manifest, shard)
    writer = None
    try:
        for number in range(start // block, -(-stop // block)):
            columns = rows(
                compute_block(recipe, manifest["seed"], number),
                max(start - number * block, 0),
                stop - number * block,
            )
            table = library.table({name: _array(x) for name, x in columns.items()})
            if writer is None:
                about = {_DATASET: _digest(manifest), _SHARD: str(shard).encode()}
                writer = library.parquet.ParquetWriter(
                    file, table.schema.with_metadata(about), compression="zstd", use_dictionary=False,
                    write_statistics=False, write_page_checksum=True,
                )  # fmt: skip
            writer.write_table(table.replace_schema_metadata(writer.schema.metadata))
    finally:
        if writer is not None:
            writer.close()


def _array(x: Column) -> Any:
    library = pyarrow()
    if isinstance(x, list):
        return library.array(x, library.string())
    numbers = x.contiguous().numpy()
    if numbers.ndim == 1:
        return library.array(numbers)
    # The strides of a single item may be anything, in which Arrow finds fault: those of a flat array are not.
    return library.FixedShapeTensorArray.from_numpy_ndarray(numbers.reshape(-1).reshape(numbers.shape))


def _column(x: Any) -> Column:
    library = pyarrow()
    x = x.combine_chunks()
    if library.types.is_string(x.type):
        return x.to_pylist()
    if isinstance(x, library.ExtensionArray):
        return torch.from_numpy(x.to_numpy_ndarray().copy())
    return torch.from_numpy(x.to_numpy(zero_copy_only=False).copy())


@contextmanager
def _whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file that appears under its name when all of it is on disk."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if os.name == "posix":  # the name is on disk, too, when its folder is
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _remove_leftovers(folder: Path, name: str) -> None:
    """What a killed process left of a file."""
    for path in folder.glob(f".{glob.escape(name)}.*.tmp"):
        path.unlink(missing_ok=True)
