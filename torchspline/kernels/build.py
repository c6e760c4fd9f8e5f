"""Compiling generated source with Numba, once a machine: the result is kept in the user's cache folder."""

import hashlib
import importlib.util
import os
import platform
import sys
import tempfile
import warnings
from collections.abc import Callable
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

    Numba keeps machine code beside the source, in a file of its own for each processor and version. Where that
    folder cannot be written (read-only, full) or holds something broken, the kernel lives in memory only.
    """
    text = source.replace("{signature}", signature)
    try:
        return _from_file(name, text.replace("{cache}", "True"))
    except (OSError, EOFError, ImportError, RuntimeError, ValueError, AttributeError):
        namespace: dict = {}
        exec(compile(text.replace("{cache}", "False"), f"<torchspline {name}>", "exec"), namespace)
        return namespace[name]


def _from_file(name: str, text: str) -> Callable:
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:20]
    path = folder / f"{name}_{digest}.py"
    if not path.exists() or path.read_text(encoding="utf-8") != text:
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
    """Keyed by the versions that decide what the machine code looks like; Numba itself adds the processor."""
    import numba

    given = os.environ.get(CACHE_VARIABLE)
    if given:
        root = Path(given)
    else:
        from platformdirs import user_cache_path

        root = user_cache_path("torchspline")
    return root / f"kernels-numba{numba.__version__}-python{platform.python_version()}"


def _write(path: Path, text: str) -> None:
    """All or nothing, however many processes do it at once."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
