"""`torchspline view`."""

import math
from pathlib import Path
from typing import Literal

import torch

from torchspline.cli.files import PoseFormat, check_outputs, fitted, is_trajectory, named_after, open_poses
from torchspline.cli.report import Report
from torchspline.io import load_trajectory
from torchspline.splines import Trajectory
from torchspline.units import SECOND
from torchspline.view import write_page

EXAMPLES = """
torchspline view poses.txt                      # writes poses.html
torchspline view motion.npz --out motion.html --open
torchspline view 00.txt --times times.txt --up=-y  # KITTI
"""


def view(
    file: Path,
    out: Path | None = None,
    open: bool = False,
    spacing: float | Literal["auto"] = "auto",
    order: int = 6,
    samples: int = 2000,
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z",
    gap: float | None = None,
    start: float = 0.0,
    duration: float = math.inf,
    format: PoseFormat | None = None,
    times: Path | None = None,
    topic: str | None = None,
    child: str | None = None,
) -> Report:
    """A page with an interactive 3D view of a file, which any browser shows, also without a network.

    Poses are shown as dots, with a spline through them that tells frames and velocities.

    Args:
        file: poses (TUM, EuRoC, KITTI, nerfstudio, the root of BVH), a ROS bag, or a saved trajectory.
        out: the page; by default named after the file, in this folder.
        open: show it in the browser.
        spacing: of the knots of the spline through poses, ms; auto finds one from the data.
        order: of that spline.
        samples: how finely the path is drawn.
        up: the direction of the world that points up; -y for KITTI.
        gap: the longest stretch without poses that is bridged, ms, as in the command fit.
        start: offset into the stretch shown, s.
        duration: how much of it to show, s.
        format: of the poses; by default recognised from their content.
        times: file of times that goes with KITTI poses.
        topic: of a ROS bag; needed where it has several with poses.
        child: frame of the transforms in that topic; needed where it has several.
    """
    target = out or named_after(file, ".html")
    check_outputs([file, times], [("out", target)])
    measured, notes = None, []
    trajectory: Trajectory
    if is_trajectory(file):
        trajectory = load_trajectory(file)
    else:
        used, fit = fitted(
            open_poses(file, format, times, topic, child), spacing, order, "split", gap, start, duration
        )
        trajectory, measured, notes = fit.trajectory, used.position, fit.notes
    write_page(target, trajectory, measured=measured, samples=samples, up=up, title=file.name)
    if open:
        import webbrowser

        webbrowser.open(target.resolve().as_uri())
    first, last = trajectory.domain
    span = (last - first) / (SECOND if isinstance(first, int) else 1)
    size = target.stat().st_size
    rows = [("duration", f"{span:.6g}", "s"), ("size of the page", f"{size / 1e6:.3g}", "MB")]
    values = {
        "duration_s": span,
        "bytes": size,
        "poses": 0 if measured is None else len(torch.atleast_1d(measured)),
    }
    return Report(f"view of {file.name}", values, rows, notes, [target])
