"""The window on an `Explorer`: a page that viser serves to the browser."""

import io
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from torchspline.explore.explorer import LENGTHS, METHODS, Curve, Explorer, resolve
from torchspline.plot.figure import numbers
from torchspline.splines.interpolation.registry import SURVEY

_COLORS = ("#2f6fde", "#e0702b", "#2f9e5b", "#a14fc4", "#c2413b", "#1899a6", "#a3832b", "#6b7280")


def viser() -> Any:
    """The library, imported when it is needed.

    Raises:
        ModuleNotFoundError: it is not installed; the message says what brings it.
    """
    try:
        import viser as library
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"explore needs viser ({error}): pip install 'torchspline[explore]'"
        ) from None
    return library


class App:
    """Serves an `Explorer` until `stop`; open `url` in a browser.

    Args:
        explorer: what is shown, and changed by dragging.
        host, port: where to listen; port 0 takes a free one.
    """

    def __init__(self, explorer: Explorer, host: str = "127.0.0.1", port: int = 8080):
        library = viser()
        self.explorer = explorer
        with redirect_stdout(sys.stderr):  # it announces itself; standard output is for results
            self.server = library.ViserServer(
                host=host, port=port, label="torchspline explore", verbose=False
            )
        self.url = f"http://{host}:{self.server.get_port()}"
        self.controls: list[Any] = []
        self.boxes: dict[str, Any] = {}
        self._charts: dict[str, Any] = {}
        self._drawn: list[Any] = []
        self._busy, self._again = threading.Lock(), False
        self.server.scene.set_up_direction("+z")
        keys = numbers(explorer.keyframes)[:, :3]
        centre, size = keys.mean(axis=0), max(float(np.ptp(keys, axis=0).max()), 1e-3)
        self.server.initial_camera.position = tuple(centre + size * np.array([0.9, -1.6, 1.1]))
        self.server.initial_camera.look_at = tuple(centre)
        self.server.scene.add_grid("/ground", width=20.0, height=20.0, cell_size=0.5)
        self._make_gui()
        self._place_controls()
        self.refresh()

    def stop(self) -> None:
        """Close the server."""
        with redirect_stdout(sys.stderr):
            self.server.stop()

    # ------------------------------------------------------------------ the panel beside the scene

    def _make_gui(self) -> None:
        gui = self.server.gui
        self.status = gui.add_markdown("", order=0.0)
        with gui.add_folder("View", order=0.1):
            self.apart = gui.add_checkbox("side by side", False, hint="one curve beside the other")
            self.frames = gui.add_slider("frames", 0, 60, 1, 12)
            self.moment = gui.add_slider("moment", 0.0, 1.0, 0.002, 0.0, hint="share of the duration")
        with gui.add_folder("Keyframes", order=0.2):
            add, remove = gui.add_button("add"), gui.add_button("remove the last")
            upload = gui.add_upload_button("load a file", hint="poses (TUM, EuRoC) or a trajectory (.npz)")
            self.count = gui.add_slider("keyframes out of a file", 2, 40, 1, 8)
        export = gui.add_button("export the figure", order=0.3)
        with gui.add_folder("Methods", order=0.4):
            for title, names in _by_group().items():
                with gui.add_folder(title, expand_by_default=title == "R3xSO3"):
                    for name in names:
                        self.boxes[name] = gui.add_checkbox(name, name in self.explorer.methods)
                        self.boxes[name].on_update(self._chosen)
        self.plots = gui.add_folder("Over time", order=0.5)
        self.basis_folder = gui.add_folder("Basis functions", order=0.6)
        with self.basis_folder:
            self.basis_of = gui.add_dropdown(
                "method",
                METHODS,
                initial_value=self.explorer.methods[0] if self.explorer.methods else "SPLIT",
            )
        for handle in (self.apart, self.frames, self.moment, self.basis_of):
            handle.on_update(lambda _: self.refresh())
        add.on_click(lambda _: self.change(self.explorer.add))
        remove.on_click(lambda _: self.change(self.explorer.remove))
        upload.on_upload(lambda _: self.open(upload.value.name, upload.value.content))
        export.on_click(self._export)

    def _chosen(self, _: Any) -> None:
        self.explorer.choose([name for name, box in self.boxes.items() if box.value])
        self.refresh()

    def _export(self, event: Any) -> None:
        content = self.figure_bytes()
        target = event.client if event.client is not None else self.server
        target.send_file_download("torchspline.png", content)

    def figure_bytes(self, format: str = "png") -> bytes:
        """The figure of what is shown, as a file."""
        buffer = io.BytesIO()
        self.explorer.figure().savefig(buffer, dpi=150, format=format)
        return buffer.getvalue()

    def change(self, action: Callable[[], None]) -> None:
        """Do something to the keyframes as a whole and show it."""
        action()
        self._place_controls()
        self.refresh()

    def open(self, name: str, content: bytes) -> None:
        """Take keyframes out of a file; what is wrong with it is told in the panel."""
        with tempfile.TemporaryDirectory(prefix="torchspline-") as folder:
            path = Path(folder) / Path(name).name
            path.write_bytes(content)
            try:
                loaded = Explorer.load(path, int(self.count.value), self.explorer.methods)
            except (ValueError, OSError, TypeError) as error:
                self.status.content = f"**{Path(name).name}**: {str(error).replace(folder, '')}"
                return
        self.explorer.keyframes, self.explorer.times = loaded.keyframes, loaded.times
        self._place_controls()
        self.refresh()

    # ------------------------------------------------------------------ the scene

    def _place_controls(self) -> None:
        for handle in self.controls:
            handle.remove()
        keys = numbers(self.explorer.keyframes)
        scale = 0.25 * max(float(np.ptp(keys[:, :3], axis=0).max()), 1e-3)
        self.controls = []
        for i, key in enumerate(keys):
            handle = self.server.scene.add_transform_controls(
                f"/keys/{i}", scale=scale, position=key[:3], wxyz=key[3:] / np.linalg.norm(key[3:]),
                line_width=2.0, depth_test=False,
            )  # fmt: skip
            handle.on_update(self._mover(i, handle))
            self.controls.append(handle)

    def _mover(self, index: int, handle: Any) -> Callable[[Any], None]:
        def moved(_: Any) -> None:
            self.explorer.move(index, handle.position, handle.wxyz)
            self.refresh()

        return moved

    def refresh(self) -> None:
        """Draw everything anew; while one drawing goes on, any number of calls make one more."""
        self._again = True
        while self._again:
            if not self._busy.acquire(blocking=False):
                return
            try:
                self._again = False
                self._draw()
            finally:
                self._busy.release()

    def _draw(self) -> None:
        curves, wrong = self.explorer.curves()
        keys = numbers(self.explorer.keyframes)
        extent = max(float(np.ptp(keys[:, :3], axis=0).max()), 1e-3)
        for handle in self._drawn:
            handle.remove()
        self._drawn = []
        with self.server.atomic():
            for i, curve in enumerate(curves):
                shift = np.array([1.5 * extent * i, 0.0, 0.0]) if self.apart.value else np.zeros(3)
                self._draw_curve(i, curve, shift, extent)
        self._draw_charts(curves)
        names = "  \n".join(
            f'<span style="color:{_color(i)}">■</span> {curve.method}' for i, curve in enumerate(curves)
        )
        errors = "  \n".join(f"**{method}**: {why}" for method, why in wrong.items())
        self.status.content = "\n\n".join(x for x in (names, errors) if x) or "Choose a method below."

    def _draw_curve(self, i: int, curve: Curve, shift: np.ndarray, extent: float) -> None:
        scene = self.server.scene
        path = numbers(curve.position) + shift
        ends = np.stack([path[:-1], path[1:]], axis=1).astype(np.float32)
        rgb = tuple(int(_color(i)[j : j + 2], 16) for j in (1, 3, 5))
        self._drawn.append(
            scene.add_line_segments(f"/curves/{i}/path", ends, rgb, thickness=3.0, thickness_units="screen")
        )
        if self.apart.value:  # else names would stand on each other
            self._drawn.append(scene.add_label(f"/curves/{i}/name", curve.method, position=path[-1]))
        if curve.rotation is None:
            return
        turns = numbers(curve.rotation)
        if self.frames.value:
            rows = np.unique(np.linspace(0, len(path) - 1, int(self.frames.value)).round().astype(int))
            self._drawn.append(
                scene.add_batched_axes(
                    f"/curves/{i}/frames", turns[rows], path[rows],
                    axes_length=0.05 * extent, axes_radius=0.0025 * extent,
                )
            )  # fmt: skip
        row = round(float(self.moment.value) * (len(path) - 1))
        self._drawn.append(
            scene.add_frame(
                f"/curves/{i}/body", wxyz=turns[row], position=path[row],
                axes_length=0.15 * extent, axes_radius=0.006 * extent,
            )
        )  # fmt: skip

    def _draw_charts(self, curves: list[Curve]) -> None:
        with self.plots:
            for name, unit in LENGTHS.items():
                lines = [(i, c) for i, c in enumerate(curves) if name in c.lengths]
                self._chart(
                    f"{name.replace('_', ' ')} [{unit}]", numbers(lines[0][1].t) if lines else None,
                    [(c.method, _color(i), numbers(c.lengths[name])) for i, c in lines],
                )  # fmt: skip
        with self.basis_folder:
            try:
                t, weights = self.explorer.weights(self.basis_of.value)
            except ValueError:
                self._chart("basis functions", None, [])
                return
            columns = [(f"{i}", _color(i), x) for i, x in enumerate(numbers(weights).T)]
            self._chart("basis functions", numbers(t), columns)

    def _chart(self, title: str, t: Any, lines: list[tuple[str, str, Any]]) -> None:
        """One chart; numbers of a chart with the same lines are replaced, which does not make it blink."""
        known = self._charts.pop(title, None)
        names = [(name, color) for name, color, _ in lines]
        data = (t, *(np.ascontiguousarray(x) for _, _, x in lines)) if lines else ()
        if known is not None and known[0] == names:
            if lines:
                known[1].data = data
            self._charts[title] = known
            return
        if known is not None and known[1] is not None:
            known[1].remove()
        handle = None
        if lines:
            series = (
                {"label": "t"},
                *({"label": name, "stroke": color, "width": 1.5} for name, color in names),
            )
            handle = self.server.gui.add_uplot(
                data, series, title=title, scales={"x": {"time": False}}, aspect=2.0, legend={"show": False}
            )
        self._charts[title] = (names, handle)


def _by_group() -> dict[str, list[str]]:
    """Names of methods by what they work in: those of [H18] for poses first, then the rest."""
    survey = ("R3xSO3", "SE3", "DualQuaternion")
    titles = {"R3": "positions alone", "SO3": "rotations alone"}
    found: dict[str, list[str]] = {
        name: [] for name in (*survey, *titles.values(), "every scheme on every group")
    }
    for method in METHODS:
        group = resolve(method)[1]
        found[titles.get(group, group) if method in SURVEY else "every scheme on every group"].append(method)
    return found


def _color(i: int) -> str:
    return _COLORS[i % len(_COLORS)]
