"""`torchspline fit`."""

import math
from pathlib import Path
from typing import Literal

from torchspline.cli.common import check_figure, fit_report, fit_rows, save_figure
from torchspline.cli.files import PoseFormat, check_outputs, fitted, named_after, open_poses
from torchspline.cli.report import Report
from torchspline.io import save_trajectory
from torchspline.units import SECOND

EXAMPLES = """
torchspline fit poses.txt                           # writes poses.npz
torchspline fit mocap0 --spacing 80 --out motion.npz --figure residuals.png
torchspline fit drive.mcap --topic /tf --child base_link
python -c "from torchspline.io import load_trajectory; print(load_trajectory('motion.npz').domain)"
"""


def fit(
    poses: Path,
    out: Path | None = None,
    spacing: float | Literal["auto"] = "auto",
    order: int = 6,
    representation: Literal["split", "joint"] = "split",
    gap: float | None = None,
    start: float = 0.0,
    duration: float = math.inf,
    format: PoseFormat | None = None,
    times: Path | None = None,
    topic: str | None = None,
    child: str | None = None,
    figure: Path | None = None,
) -> Report:
    """A spline through a file of poses, by least squares; saved as a trajectory file.

    Args:
        poses: TUM, EuRoC, KITTI or nerfstudio file, gzipped or not, BVH (its root), or ROS bag; - is standard input.
        out: trajectory file, for torchspline.io.load_trajectory; by default named after the poses, in this folder.
        spacing: of the knots, ms; auto finds one from the data and says why.
        order: of the spline; the curve has order - 2 continuous derivatives.
        representation: split (R3 x SO3) or joint (SE3).
        gap: the longest stretch without poses that is bridged, ms; by default 30, or three median pose intervals
            if that is more. The longest stretch without a larger gap is used.
        start: offset into that stretch, s.
        duration: how much of it to use, s.
        format: of the poses; by default recognised from their content.
        times: file of times that goes with KITTI poses.
        topic: of a ROS bag; needed where it has several with poses.
        child: frame of the transforms in that topic; needed where it has several.
        figure: where to draw the residuals (png, pdf, svg).
    """
    target = out or named_after(poses, ".npz")
    check_outputs([poses, times], [("out", target), ("figure", figure)])
    if figure is not None:
        check_figure("figure", figure)
    record = open_poses(poses, format, times, topic, child)
    used, found = fitted(record, spacing, order, representation, gap, start, duration)
    save_trajectory(target, found.trajectory)
    files = [target]
    if figure is not None:
        from torchspline.plot import residuals

        save_figure(figure, residuals(found, used.time_ns, title=poses.name))
        files.append(figure)
    dt_ns = found.trajectory.dt_ns
    assert dt_ns is not None  # the stamps are in nanoseconds
    dt, span = dt_ns / SECOND, (int(used.time_ns[-1]) - int(used.time_ns[0])) / SECOND
    rows = [("poses used", f"{len(used)} of {len(record)} over {span:.2f} s", ""), *fit_rows(found, dt)]
    values = {"poses_used": len(used), "duration_s": span, **fit_report(found, dt)}
    values.pop("notes")
    return Report(f"spline through {poses.name}", values, rows, found.notes, files)
