"""Every experiment runs small, from its configuration, and leaves its figures, versions, machine and plots."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
EXPERIMENTS = sorted(path for path in (ROOT / "experiments").glob("*.py") if path.stem != "common")
KEYS = {"figures", "config", "seed", "versions", "machine", "wall_time_s"}
#: Whole calibrations, which take three times as long without compiled loops.
COMPILED = {"camera_imu"}
PNG_SIGNATURE = b"\x89PNG"


def test_there_are_experiments():
    assert EXPERIMENTS


@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)
def test_experiment_has_a_config(path):
    assert (ROOT / "configs" / f"{path.stem}.yaml").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)
def test_experiment_runs(path, tmp_path):
    kernels = {"TORCHSPLINE_KERNELS": "auto"} if path.stem in COMPILED else {}
    done = subprocess.run(
        [sys.executable, str(path), "--smoke", "--out", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, **kernels, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout.strip()

    results = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert set(results) >= KEYS
    assert results["figures"]
    assert {"python", "torch", "numpy", "scipy", "torchspline"} <= set(results["versions"])
    assert {"processor", "cores"} <= set(results["machine"])
    assert results["wall_time_s"] > 0

    if path.stem == "benchmark":  # what the README links to
        document = (tmp_path / "benchmark.md").read_text(encoding="utf-8")
        assert f"Machine: {results['machine']['processor']}" in document
        assert (tmp_path / "table.md").read_text(encoding="utf-8") in document

    plots = list(tmp_path.glob("*.png"))
    assert plots
    assert all(plot.read_bytes().startswith(PNG_SIGNATURE) for plot in plots)
