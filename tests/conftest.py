"""What every test may use: the folder of real recordings, and one torch thread per parallel worker.

Tests run the reference implementation unless they ask for kernels (`torchspline.use_kernels`), since
compiling a kernel for every group, order and precision they touch would take most of their time.
"""

import os
from pathlib import Path

import pytest
import torch

os.environ.setdefault("TORCHSPLINE_KERNELS", "reference")

if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; the test is skipped where there is none."""
    default = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    folder = Path(os.environ.get("TORCHSPLINE_DATA") or default)
    if not folder.is_dir():
        pytest.skip(f"real recordings not found at {folder}; point TORCHSPLINE_DATA to them")
    return folder
