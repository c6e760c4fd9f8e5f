"""IMU readings synthesised from fitted poses, against the IMUs that were there."""

import pytest
import torch

from torchspline import fit_poses
from torchspline.imu import measure
from torchspline.io import read_imu, read_poses

#: RMSE of gyroscope [rad/s] and accelerometer [m/s^2] at knot spacings in ms, of a SciPy least-squares spline of
#: order 6 through the same poses: the table in the README of the recordings.
YARDSTICK = {
    "tum_vi/room1": {20: (0.0746, 0.942), 40: (0.0363, 0.223), 80: (0.0304, 0.142), 160: (0.0675, 0.207)},
    "tum_vi/room4": {20: (0.0828, 1.149), 40: (0.0392, 0.241), 80: (0.0313, 0.128), 160: (0.0595, 0.175)},
    "euroc/V1_02_medium": {20: (0.0277, 0.882), 40: (0.0340, 0.886), 80: (0.0407, 0.892), 160: (0.0503, 0.897)},
    "euroc/V1_03_difficult": {20: (0.0496, 1.217), 40: (0.0556, 1.218), 80: (0.0598, 1.224), 160: (0.0659, 1.229)},
}  # fmt: skip


def longest_stretch(time_ns):
    """Where the poses follow each other within 30 ms for longest, at most 60 s of it."""
    breaks = (torch.nonzero(time_ns.diff() > 30_000_000).flatten() + 1).tolist()
    pieces = [time_ns[i:j] for i, j in zip([0, *breaks], [*breaks, len(time_ns)], strict=True)]
    longest = max(pieces, key=lambda piece: (piece[-1] - piece[0]).item())
    return longest[0].item(), min(longest[-1].item(), longest[0].item() + 60_000_000_000)


@pytest.mark.realdata
@pytest.mark.parametrize("recording", YARDSTICK)
def test_synthesised_readings_meet_the_yardstick(shared_data, recording, monkeypatch):
    monkeypatch.setenv("TORCHSPLINE_KERNELS", "auto")  # compiled once, a tenth of the time of the reference
    poses, samples = read_poses(shared_data / recording), read_imu(shared_data / recording)
    start, stop = longest_stretch(poses.time_ns)
    window = poses.window(start, stop)
    samples = samples.window(start + 300_000_000, stop - 300_000_000)
    assert 39e9 < stop - start <= 60e9
    assert len(samples) > 7500
    best = tuple(min(x) for x in zip(*YARDSTICK[recording].values(), strict=True))
    ratios = {}
    for spacing, limits in {**YARDSTICK[recording], "auto": best}.items():
        dt = spacing if spacing == "auto" else 1e-3 * spacing
        fit = fit_poses(
            window.time_ns, torch.cat([window.position, window.rotation], -1), dt=dt, progress=False
        )
        reading = measure(fit.trajectory, samples.time_ns)
        for name, limit, got in zip(("gyroscope", "accelerometer"), limits, reading, strict=True):
            error = getattr(samples, name) - got.detach()
            rmse = (error - error.mean(dim=0)).square().mean().sqrt().item()
            ratios[spacing, name] = rmse / limit
    # Without alignment: the clocks are some tenths of a millisecond apart.
    auto = [ratios.pop(("auto", name)) for name in ("gyroscope", "accelerometer")]
    assert max(auto) < 1.02, auto
    assert max(ratios.values()) <= 1.1, ratios
    assert min(ratios.values()) > 0.9, ratios  # much better would mean that something else was compared
