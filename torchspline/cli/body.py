"""`torchspline body`: IMUs on every joint of a captured motion."""

import math
import re
from pathlib import Path

import torch

from torchspline.cli.common import save_figure, write_report
from torchspline.cli.report import Report
from torchspline.imu import ImuReading, measure
from torchspline.io import ImuRecord, read_bvh, write_imu
from torchspline.people import fit_body, response
from torchspline.plot import imu_comparison
from torchspline.units import SECOND

EXAMPLES = """
torchspline body walk.bvh --rate 200 --out DIR
torchspline body walk.bvh --unit 0.0254 --gravity "[0, 0, -9.80665]"  # inches, z up
"""


def body(
    motion: Path,
    rate: float = 200.0,
    out: Path = Path("torchspline-body"),
    bandwidth: float = 10.0,
    unit: float = 0.01,
    gravity: tuple[float, float, float] = (0.0, -9.80665, 0.0),
    margin: float = 0.2,
) -> Report:
    """IMU readings on every joint of a BVH file, one EuRoC file a joint.

    Args:
        motion: BVH file, gzipped or not.
        rate: of the readings, Hz.
        out: folder for the results; made if it is not there.
        bandwidth: highest frequency of the motion that matters, Hz; what is above 1.5 times this is smoothed away.
        unit: of the lengths in the file, m. Centimetres are usual.
        gravity: acceleration in the world of the file, m/s². In most of them y points up.
        margin: left out at both ends, where a spline knows least, s.
    """
    if not (math.isfinite(rate) and rate > 0):
        raise ValueError(f"rate: expected a finite number above zero (Hz), got {rate}")
    if not margin >= 0:
        raise ValueError(f"margin: expected seconds, zero or more, got {margin}")
    skeleton = read_bvh(motion, unit)
    t, frames = skeleton.time, 1.0 / skeleton.interval
    span = float(t[-1]) - 2.0 * margin
    if not span > 0:
        raise ValueError(f"margin: nothing is left of {float(t[-1]):.3g} s between margins of {margin} s")
    if span * rate * len(skeleton.names) > 1e9:
        raise ValueError(
            f"rate: {rate:g} Hz over {span:g} s on {len(skeleton.names)} joints makes more than 1e9 readings"
        )
    fitted = fit_body(t, skeleton.poses(), bandwidth=bandwidth)
    times = margin + torch.arange(int(span * rate) + 1, dtype=torch.float64) / rate
    with torch.no_grad():
        made = measure(fitted, times, gravity)
    kept = response(torch.tensor([0.5 * bandwidth, bandwidth]).double(), frames, bandwidth=bandwidth)
    out.mkdir(parents=True, exist_ok=True)
    stamps = (times * SECOND).round().to(torch.int64)
    rows = []
    report = {}
    for j, name in enumerate(skeleton.names):
        reading = ImuReading(made.gyroscope[j], made.accelerometer[j])
        rms = [float(x.square().sum(-1).mean().sqrt()) for x in reading]
        file = f"imu_{j:02d}_{re.sub(r'[^A-Za-z0-9]+', '_', name)}.csv"
        write_imu(out / file, ImuRecord(stamps, *reading, name))
        rows.append((f"{name}: RMS", f"{rms[0]:.3f} / {rms[1]:.3f}", "rad/s / m/s²"))
        report[name] = {"file": file, "gyroscope_rms_rad_s": rms[0], "accelerometer_rms_m_s2": rms[1]}
    first = ImuReading(made.gyroscope[0], made.accelerometer[0])
    figure = imu_comparison((times, first), title=f"{motion.name}: IMU on {skeleton.names[0]}")
    save_figure(out / "imu.png", figure)
    summary = {
        "frames": len(t), "frame_rate_hz": frames, "bandwidth_hz": bandwidth, "rate_hz": rate,
        "acceleration_kept_at_half_and_full_bandwidth": kept.gain.tolist(), "joints": report,
    }  # fmt: skip
    write_report(out / "report.json", summary)
    notes = [
        f"{len(t)} frames at {frames:.4g} Hz, {len(times)} readings a joint at {rate:g} Hz; of accelerations at "
        f"{bandwidth:g} Hz {100 * float(kept.gain[1]):.1f} % are kept"
    ]
    files = [out / str(joint["file"]) for joint in report.values()]
    return Report(
        f"IMUs on {motion.name}", summary, rows, notes, [*files, out / "imu.png", out / "report.json"]
    )
