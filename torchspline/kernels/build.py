"""Compiling generated source with Numba, once a machine: the result is kept in the user's cache folder."""

import hashlib
import importlib.util
import os
import platform
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

#: Where compiled kernels are kept, if not in the user's cache folder.
CACHE_VARIABLE = "TORCHSPLINE_CACHE"


@cache
def available() -> bool:
    """Whether Numba can be imported; says so once if not."""
    try:
        import numba  # noqa: F401
    except Exception as error:  # a broken LLVM raises more than ImportError
        warnings.warn(
            f"torchspline: compiled kernels are off, everything runs through the slower reference: {error}",
            RuntimeWarning,
            stacklevel=2,
        )
        return False
    return True


@cache
def compiled(name: str, source: str, signature: str) -> Callable:
    """The function `name` of generated `source`, for argument types `signature`.

    Numba keeps machine code beside the source. Files that turn out to be broken are made again; where the folder
    cannot be written (read-only, full), the kernel lives in memory only.
    """
    text = source.replace("{signature}", signature)
    lasting = text.replace("{cache}", "True")
    with suppress(OSError):
        path = cache_folder() / f"{name}_{hashlib.sha256(lasting.encode()).hexdigest()[:20]}.py"
        try:
            return _from_file(name, path, lasting)
        except OSError:
            raise
        except Exception:  # what a damaged file raises is anybody's guess
            for damaged in (path, *(path.parent / "__pycache__").glob(f"{path.stem}.*")):
                damaged.unlink(missing_ok=True)
        with suppress(Exception):
            return _from_file(name, path, lasting)
    namespace: dict = {}
    exec(compile(text.replace("{cache}", "False"), f"<torchspline {name}>", "exec"), namespace)
    return namespace[name]


def _from_file(name: str, path: Path, text: str) -> Callable:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_bytes() != text.encode():
        _write(path, text)
    module_name = f"_torchspline_kernels.{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # Numba looks the module up by name when it pickles
    spec.loader.exec_module(module)
    return getattr(module, name)


def cache_folder() -> Path:
    """Keyed by the versions and the processor, which decide what the machine code looks like."""
    import numba

    given = os.environ.get(CACHE_VARIABLE)
    if given:
        root = Path(given)
    else:
        from platformdirs import user_cache_path

        root = user_cache_path("torchspline")
    return root / f"kernels-numba{numba.__version__}-python{platform.python_version()}-{_processor()}"


def _processor() -> str:
    """A name for what the processor can do."""
    from llvmlite import binding as llvm

    features = ""
    with suppress(RuntimeError):  # not known everywhere
        features = llvm.get_host_cpu_features().flatten()
    return hashlib.sha256(f"{llvm.get_host_cpu_name()} {features}".encode()).hexdigest()[:8]


def _write(path: Path, text: str) -> None:
    """All or nothing, however many processes do it at once."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(text.encode())
        os.utime(temporary, (0, 0))  # older versions of Numba take a new date for a new source
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
