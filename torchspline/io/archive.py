"""Archives of arrays (npz), bounded decompression: what a file promises is checked before memory is spent on it.

And files that are written whole or not at all.
"""

import gzip
import io
import math
import secrets
import shutil
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Compressed files may grow to this (bytes), or to this many times their size, whichever is more. Numbers as text
#: shrink to a tenth at best; what grows a thousandfold was made to fill the memory.
_ALWAYS, _FACTOR = 2**23, 20
#: Arrays in an archive beyond which it is taken for something else.
_MOST_ARRAYS = 1000
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    OverflowError,
    # Of the parser of headers, which are written as Python:
    tokenize.TokenError,
    SyntaxError,
    TypeError,
    LookupError,
)
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class _NoNumbersError(ValueError):
    """An array that is none of plain numbers, or is not as large as its header says."""


def allowed_size(stored: int) -> int:
    """How many bytes a compressed file of `stored` bytes may hold."""
    return max(_ALWAYS, _FACTOR * stored)


def read_bytes(path: Path) -> bytes:
    """The content of a file, unpacked if it is gzipped.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a folder, damaged gzip, or one that holds far more than text of numbers could shrink to.
    """
    if path.is_dir():
        raise ValueError(f"{path}: expected a file, got a folder")
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except OSError as reason:
        raise OSError(reason.errno, reason.strerror, str(path)) from None  # which reading alone does not say
    if not content.startswith(b"\x1f\x8b"):
        return content
    most = allowed_size(len(content))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as stream:
            unpacked = stream.read(most + 1)
    except (OSError, EOFError, zlib.error) as reason:
        raise ValueError(f"{path}: expected gzipped text, got damaged data ({reason})") from None
    if len(unpacked) > most:
        raise ValueError(
            f"{path}: expected gzipped text, got {len(content)} bytes that hold more than {most}; unpack it yourself "
            "if it is to be trusted"
        )
    return unpacked


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an npz archive by name, plain numbers only: nothing in it is executed.

    Headers are believed only where they agree with the size of what is stored, checksums are looked at.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such archive, a damaged one, one with objects in it, or one that holds far more than its size
            allows for; the message names the file and the array.
    """
    if path.is_dir():
        raise ValueError(f"{path}: expected a file, got a folder")
    try:
        stored = path.stat().st_size
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            total = sum(info.file_size for info in members)
            if len(members) > _MOST_ARRAYS or total > allowed_size(stored):
                raise ValueError(
                    f"{len(members)} arrays of {total} bytes in {stored}, more than such a file can hold"
                )
            if sum(info.compress_size for info in members) > stored:  # reserved before it is read
                raise ValueError(f"arrays that are longer than the file of {stored} bytes")
            return {info.filename.removesuffix(".npy"): _array(archive, info) for info in members}
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except _NoNumbersError as reason:
        raise ValueError(f"{path}: {reason}") from None
    except _DAMAGED as reason:
        text = " ".join(str(reason).split())[:200]
        raise ValueError(
            f"{path}: expected an npz archive of numbers, got a damaged or truncated file ({text})"
        ) from None


def write_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write an npz archive under exactly this name. Raises `FileNotFoundError` where the folder does not exist."""
    packed = io.BytesIO()  # archives go back to their beginning, which pipes cannot
    np.savez(packed, **arrays)  # type: ignore[arg-type]
    with replacing(path) as part:
        part.write_bytes(packed.getbuffer())


def check_folder(path: Path) -> None:
    """`FileNotFoundError` if the folder that `path` is to stand in does not exist."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; make it first")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name in the folder of `path` to write to; it becomes `path` when the block ends, and is gone if that fails.

    Whoever is interrupted in between leaves the file that was there, and no half of another. What is no regular file
    (a pipe, /dev/stdout) is written to directly.

    Raises:
        FileNotFoundError: the folder does not exist. IsADirectoryError: `path` is a folder.
        OSError: as the system says, of `path`.
    """
    check_folder(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected the name of a file, got a folder")
    direct = path.exists() and (not path.is_file() or path.is_relative_to("/dev"))
    target = path if direct else path.resolve()  # a link stays one
    part = path if direct else target.with_name(f".{secrets.token_hex(4)}{target.suffix}")
    try:
        yield part
        if not direct:
            with suppress(FileNotFoundError):
                shutil.copymode(target, part)
            part.replace(target)
    except OSError as reason:
        # A full disk comes without a name, and nobody has heard of the part.
        if reason.errno is not None and reason.filename in (None, str(part), part):
            raise OSError(reason.errno, reason.strerror, str(path)) from None
        raise
    finally:
        if not direct:
            with suppress(OSError):
                part.unlink()


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, gzipped when its name ends with .gz. Raises as `replacing`."""
    with replacing(path) as part:
        part.write_bytes(gzip.compress(content, 6, mtime=0) if path.suffix == ".gz" else content)


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    file = io.BytesIO(archive.read(info))  # the whole of it: only then is its checksum looked at
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"{info.filename}: version {version} of NumPy's format")
    shape, column_major, dtype = _HEADERS[version](file)
    promised = math.prod(shape) * dtype.itemsize
    if dtype.kind not in "biuf" or min(shape, default=0) < 0 or file.tell() + promised != info.file_size:
        name, got = info.filename.removesuffix(".npy")[:40], f"{dtype} of shape {shape}"[:80]
        raise _NoNumbersError(
            f"{name}: expected an array of plain numbers, got {got} in {info.file_size} bytes"
        )
    flat = np.frombuffer(file.getbuffer()[file.tell() :], dtype=dtype.newbyteorder("="))
    if not dtype.isnative:
        flat = flat.byteswap()
    return flat.reshape(shape, order="F" if column_major else "C").copy(order="C")
