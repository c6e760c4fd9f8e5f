"""What only a new process can tell: the time of an import and of a first call."""

import json
import os
import statistics
import subprocess
import sys
import tempfile
from typing import Any

_IMPORT = """
import json, time
import torch
start = time.perf_counter()
import torchspline
print(json.dumps({"import": time.perf_counter() - start}))
"""

# As a user's program: the module, 200 queries, value and two derivatives, then the gradients.
_FIRST_CALL = """
import json, time
import torch, torchspline as ts
points = ts.SO3.exp(0.3 * torch.randn(20, 3, dtype=torch.float64).cumsum(0))
t = torch.linspace(0.0, 1.7, 200, dtype=torch.float64)
with ts.use_kernels("MODE"):
    start = time.perf_counter()
    state = ts.BSpline(points, group=ts.SO3, order=4, dt=0.1).evaluate(t)
    forward = time.perf_counter() - start
    sum(x.sum() for x in state if x is not None).backward()
    print(json.dumps({"forward": forward, "forward and backward": time.perf_counter() - start}))
"""


def _run(code: str, **environment: str) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    if done.returncode != 0:
        raise RuntimeError(f"a new process failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def imports(rounds: int) -> list[float]:
    """Seconds of `import torchspline` after `import torch`."""
    return [_run(_IMPORT)["import"] for _ in range(rounds)]


def first_calls(rounds: int, kernels: str = "fused") -> dict[str, list[float]]:
    """Seconds of the first call in a process: cold, with an empty cache folder of kernels, then with it filled."""
    code = _FIRST_CALL.replace("MODE", kernels)
    with tempfile.TemporaryDirectory() as folder:
        runs = [_run(code, TORCHSPLINE_CACHE=folder) for _ in range(1 + rounds)]
    return {
        f"first {what}, {state}": [run[what] for run in chosen]
        for state, chosen in (("cold", runs[:1]), ("cached", runs[1:]))
        for what in runs[0]
    }


def summary(samples: dict[str, list[float]]) -> list[dict[str, Any]]:
    return [
        {"what": what, "seconds_min": min(s), "seconds_median": statistics.median(s), "runs": len(s)}
        for what, s in samples.items()
    ]
