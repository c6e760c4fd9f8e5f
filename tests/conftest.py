"""What every test may use: the folder of real recordings, and one torch thread per parallel worker.

Tests run the reference implementation unless they ask for kernels (`torchspline.use_kernels`), since
compiling a kernel for every group, order and precision they touch would take most of their time.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from contract import Recorder
from hypothesis import settings

os.environ.setdefault("TORCHSPLINE_KERNELS", "reference")

# The same examples in every run and on every machine, however slow; `--hypothesis-profile=explore` searches on.
settings.register_profile("steady", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile("steady")

RECORDER = pytest.StashKey[Recorder]()

if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def same_draws() -> None:
    """`gradgradcheck` and whatever else draws from the global generator draws the same in any order of tests."""
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def compiled() -> Iterator[None]:
    """Compiled loops wherever they pay, as for users: whole fits take several times as long without."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHSPLINE_KERNELS", "auto")
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; the test is skipped where there is none."""
    default = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    folder = Path(os.environ.get("TORCHSPLINE_DATA") or default)
    if not folder.is_dir():
        pytest.skip(f"real recordings not found at {folder}; point TORCHSPLINE_DATA to them")
    return folder


def pytest_configure(config: pytest.Config) -> None:
    """`TORCHSPLINE_CONTRACT` names a folder for what the tests show of the gradient contract."""
    folder = os.environ.get("TORCHSPLINE_CONTRACT")
    if folder:
        config.stash[RECORDER] = Recorder(Path(folder))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo) -> Iterator[None]:
    outcome = yield
    report = outcome.get_result()
    if report.when == "call" and not report.skipped and RECORDER in item.config.stash:
        item.config.stash[RECORDER].note(item, report.passed)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Of several processes each worker writes its own file; the one that hands out the tests has none to write."""
    recorder = session.config.stash.get(RECORDER, None)
    if recorder is not None and (recorder.kept or recorder.broken):
        recorder.write()
