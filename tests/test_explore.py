"""`torchspline explore`: the state without a window, the page that viser serves, and a key dragged in a browser."""

import math
import time

import numpy as np
import pytest
import torch
from browser import Browser, needs_browser

from torchspline import SE3, SO3, SplitBSpline, functional, use_kernels
from torchspline.explore import METHODS, Explorer
from torchspline.groups.convert import pose_from_dual_quaternion, pose_to_dual_quaternion
from torchspline.io import PoseRecord, save_trajectory, write_poses


@pytest.fixture(autouse=True)
def reference():
    with use_kernels("reference"):
        yield


@pytest.mark.parametrize("method", METHODS)
def test_every_method_makes_a_curve(method):
    explorer = Explorer(methods=[method])
    (curve,), wrong = explorer.curves(samples=40)
    assert not wrong
    assert curve.position.shape == (40, 3)
    assert curve.lengths
    # Curves begin at the first key, where it is not the scheme's way to keep off it.
    if "bspline" in method.lower() or "fus" in method.lower() or "cubsp" in method.lower():
        return
    torch.testing.assert_close(curve.position[0], explorer.keyframes[0, :3])
    if curve.rotation is not None:
        difference = SO3.log(SO3.between(curve.rotation[0], explorer.keyframes[0, 3:]))
        assert float(difference.norm()) < 1e-9


def test_curves_are_those_of_interpolate():
    explorer = Explorer()
    t = explorer.curve("SpFus", 30).t
    joint = functional.interpolate("SpFus", explorer.keyframes, explorer.times, t).value
    torch.testing.assert_close(explorer.curve("SpFus", 30).position, joint[:, :3])
    dual = pose_to_dual_quaternion(explorer.keyframes)
    screw = pose_from_dual_quaternion(functional.interpolate("ScLERP", dual, explorer.times, t).value)
    torch.testing.assert_close(explorer.curve("ScLERP", 30).position, screw[:, :3])
    alone = functional.interpolate("SQUAD", explorer.keyframes[:, 3:], explorer.times, t)
    curve = explorer.curve("SQUAD", 30)
    torch.testing.assert_close(curve.rotation, alone.value)
    torch.testing.assert_close(curve.lengths["angular_velocity"], alone.velocity.norm(dim=-1))
    assert "velocity" not in curve.lengths


def test_lengths_are_rates_of_the_curve():
    curve = Explorer().curve("squad on SE3", 4001)
    steps = (curve.position[2:] - curve.position[:-2]) / (curve.t[2:] - curve.t[:-2])[:, None]
    torch.testing.assert_close(steps.norm(dim=-1), curve.lengths["velocity"][1:-1], atol=5e-3, rtol=0)


def test_keys_are_moved_added_and_taken_away():
    explorer = Explorer()
    pose = SE3.random(generator=torch.Generator().manual_seed(1))
    explorer.move(1, pose[:3].tolist(), pose[3:].tolist())
    curve = explorer.curve("SPLIT", 401)
    torch.testing.assert_close(curve.position[100], pose[:3])
    explorer.add()
    assert explorer.times.tolist() == [0, 1, 2, 3, 4, 5]
    step = SE3.between(explorer.keyframes[-3], explorer.keyframes[-2])
    torch.testing.assert_close(SE3.between(explorer.keyframes[-2], explorer.keyframes[-1]), step)
    for _ in range(9):
        explorer.remove()
    assert len(explorer.keyframes) == 2
    found, wrong = Explorer(explorer.keyframes, explorer.times, ["SPLIT", "RQBez", "SPLIT CuBsp"]).curves()
    assert [curve.method for curve in found] == ["SPLIT", "SPLIT CuBsp"]
    assert wrong == {"RQBez": "keyframes: expected at least 3 points of SO3, got 2"}


def test_keys_out_of_files(tmp_path):
    stamps = torch.arange(101) * 10_000_000 + 5_000_000_000
    poses = SE3.random(101, generator=torch.Generator().manual_seed(2))
    record = PoseRecord(stamps.flip(0), poses[:, :3].flip(0), poses[:, 3:].flip(0), "x")
    write_poses(tmp_path / "p.txt", record)
    explorer = Explorer.load(tmp_path / "p.txt", 5)
    torch.testing.assert_close(explorer.times, torch.tensor([0, 0.25, 0.5, 0.75, 1.0], dtype=torch.float64))
    torch.testing.assert_close(explorer.keyframes, poses[::25])
    assert len(Explorer.load(tmp_path / "p.txt", 500).times) == 101  # there are no more
    spline = SplitBSpline(poses[:8], order=4, dt=0.5, t0=3.0, learnable=False)
    save_trajectory(tmp_path / "m.npz", spline)
    explorer = Explorer.load(tmp_path / "m.npz", 6)
    torch.testing.assert_close(explorer.keyframes, spline(3.0 + explorer.times))


def test_basis_functions_weigh_the_keys():
    explorer = Explorer()
    t, weights = explorer.weights("CompositeBezier", 50)
    torch.testing.assert_close(weights.sum(-1), torch.ones(50, dtype=torch.float64))
    made = functional.interpolate("CompositeBezier", explorer.keyframes[:, :3], explorer.times, t).value
    torch.testing.assert_close(weights @ explorer.keyframes[:, :3], made)


def test_the_figure_shows_all(tmp_path):
    explorer = Explorer(methods=["SPLIT", "RQBez", "LERP"])
    figure = explorer.figure()
    scene, *panels = figure.subfigs[0].axes + figure.subfigs[1].axes
    assert [text.get_text() for text in scene.get_legend().get_texts()] == ["keys", "SPLIT", "RQBez", "LERP"]
    assert scene.get_xlabel() == "x [m]"
    assert [len(panel.lines) for panel in panels] == [2, 2, 2, 2, 5]
    assert "[rad/s²]" in panels[3].get_ylabel()


# ---------------------------------------------------------------------- the page


@pytest.fixture
def app():
    pytest.importorskip("viser", reason="viser is not installed")
    from torchspline.explore.app import App

    made = App(Explorer(), port=0)
    yield made
    made.stop()


def until(true, seconds=180.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_the_page_follows_the_state(app, tmp_path):
    assert len(app.controls) == 5
    assert {"/curves/0/path", "/curves/2/frames", "/curves/1/body"} <= {handle.name for handle in app._drawn}
    app.boxes["SPLIT"].value = False
    app.boxes["LERP"].value = True
    until(lambda: app.explorer.methods == ["SPLIT SQUAD", "SPLIT CuBsp", "LERP"])
    until(lambda: "LERP" in app.status.content)
    app.change(app.explorer.add)
    assert len(app.controls) == 6
    np.testing.assert_allclose(app.controls[-1].position, app.explorer.keyframes[-1, :3])
    path = next(handle for handle in app._drawn if handle.name == "/curves/2/path")
    np.testing.assert_allclose(path.points[0, 0], app.explorer.keyframes[0, :3], atol=1e-6)
    (names, chart) = app._charts["velocity [m/s]"]
    assert [name for name, _ in names] == app.explorer.methods
    np.testing.assert_allclose(chart.data[3], app.explorer.curve("LERP").lengths["velocity"])

    write_poses(
        tmp_path / "p.txt", PoseRecord(torch.arange(30) * 10**8, *SE3.random(30).split((3, 4), -1), "x")
    )
    app.open("p.txt", (tmp_path / "p.txt").read_bytes())
    assert len(app.controls) == 8
    app.open("bad.txt", b"1 2 x\n")
    assert "**bad.txt**: " in app.status.content
    assert "line 1" in app.status.content
    assert len(app.controls) == 8
    assert app.figure_bytes().startswith(b"\x89PNG")


@needs_browser
@pytest.mark.slow
def test_a_key_dragged_in_a_browser(app, tmp_path):
    """The mouse pulls the x arrow of a key in a real browser; the key moves along it, the curve follows."""
    with Browser() as browser:
        browser.open(app.url)
        until(lambda: app.server.get_clients())
        client = next(iter(app.server.get_clients().values()))
        until(lambda: client.camera.image_width > 0)
        key = app.explorer.keyframes[0].clone()
        eye, target = np.array([0.5, -4.0, 2.0]), np.array([0.5, 0.0, 0.0])
        client.camera.position, client.camera.look_at = tuple(eye), tuple(target)
        browser.wait(
            "document.querySelector('canvas') !== null && document.body.innerText.includes('SPLIT SQUAD')"
        )

        def on_screen(point):
            """Of a point in the world, px, by hand: a pinhole of the field of view that the page has."""
            box = browser.value(
                "(() => { const b = document.querySelector('canvas').getBoundingClientRect();"
                "return [b.x, b.y, b.width, b.height] })()"
            )
            back = (eye - target) / np.linalg.norm(eye - target)
            right = np.cross([0.0, 0.0, 1.0], back)
            right /= np.linalg.norm(right)
            aside, depth = point - eye, -(point - eye) @ back
            focal = box[3] / 2 / math.tan(client.camera.fov / 2)
            x = box[0] + box[2] / 2 + focal * (aside @ right) / depth
            return x, box[1] + box[3] / 2 - focal * (aside @ np.cross(back, right)) / depth

        scale = 0.25 * float(np.ptp(app.explorer.keyframes[:, :3].numpy(), axis=0).max())
        arrow = key[:3].numpy() + scale * np.array([0.75, 0.0, 0.0])
        end = time.monotonic() + 180  # the scene is there a little later than its names
        while torch.equal(app.explorer.keyframes[0], key):
            assert time.monotonic() < end
            # A drag that came too early has turned the view instead.
            client.camera.position, client.camera.look_at = tuple(eye), tuple(target)
            time.sleep(0.3)
            browser.drag(on_screen(arrow), on_screen(arrow + np.array([0.6, 0.0, 0.0])))
            time.sleep(0.3)
        browser.picture(tmp_path / "explore.png")
        moved = app.explorer.keyframes[0]
        assert 0.3 < float(moved[0] - key[0]) < 1.0
        torch.testing.assert_close(moved[1:], key[1:], atol=1e-4, rtol=0)
        until(lambda: _follows(app))


def _follows(app):
    path = next((handle for handle in list(app._drawn) if handle.name == "/curves/0/path"), None)
    return path is not None and np.allclose(path.points[0, 0], app.explorer.keyframes[0, :3], atol=1e-3)
