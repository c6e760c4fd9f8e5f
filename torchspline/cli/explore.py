"""`torchspline explore`."""

import sys
import time
from pathlib import Path
from typing import Literal

from torchspline.cli.common import save_figure
from torchspline.cli.report import Report
from torchspline.explore import METHODS, Explorer

EXAMPLES = """
torchspline explore
torchspline explore poses.txt --keyframes 12 --methods SQUAD "SPLIT CuBsp" "squad on SE3"
torchspline explore --figure methods.png      # draws the figure and ends
"""


def explore(
    file: Path | None = None,
    *,
    keyframes: int = 8,
    methods: list[str] | None = None,
    format: Literal["tum", "euroc", "kitti", "ros"] | None = None,
    times: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    open: bool = False,
    figure: Path | None = None,
    duration: float | None = None,
) -> Report:
    """Compare interpolation methods in the browser: drag keyframes, see curves, frames, velocities, basis functions.

    Serves a page until it is interrupted (Ctrl-C).

    Args:
        file: poses or a saved trajectory (.npz) to take keyframes from; may stand alone, as the first word.
        keyframes: how many of them.
        methods: shown at the start; names of interpolate, or "squad on SE3".
        format: of the poses; by default recognised from their content.
        times: file of times that goes with KITTI poses.
        host: where to listen; 127.0.0.1 is this machine alone.
        port: where to listen; the next free one if it is taken.
        open: show the page in the browser.
        figure: write the figure (png, pdf, svg) instead of serving.
        duration: end after so many seconds.
    """
    chosen = ["SPLIT", "SPLIT SQUAD", "SPLIT CuBsp"] if methods is None else methods
    names = {name.lower(): name for name in METHODS}
    chosen = [names.get(name.lower(), name) for name in chosen]
    explorer = (
        Explorer(methods=chosen) if file is None else Explorer.load(file, keyframes, chosen, format, times)
    )
    if figure is not None:
        save_figure(figure, explorer.figure(), dpi=150)
        _, wrong = explorer.curves()
        return Report(
            "figure", {"methods": chosen, "keyframes": len(explorer.keyframes)},
            notes=[f"{method}: {why}" for method, why in wrong.items()], files=[figure],
        )  # fmt: skip
    from torchspline.explore.app import App

    app = App(explorer, host, port)
    print(f"open {app.url} in a browser; Ctrl-C ends", file=sys.stderr, flush=True)
    if open:
        import webbrowser

        webbrowser.open(app.url)
    began = time.monotonic()
    try:
        while duration is None or time.monotonic() - began < duration:
            time.sleep(0.2)
    except KeyboardInterrupt:
        pass
    finally:
        app.stop()
    return Report("explore", {"url": app.url, "seconds": time.monotonic() - began})
