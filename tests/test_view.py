"""The page with the 3D view: what is in it, and that a browser shows it right."""

import json
import re

import pytest
import torch
from browser import Browser, needs_browser

from torchspline import R3, SE3, BSpline, SplitBSpline, use_kernels
from torchspline.view import page, write_page

GENERATOR = torch.Generator().manual_seed(3)
POINTS = SE3.random(9, generator=GENERATOR)


@pytest.fixture(autouse=True)
def reference():
    with use_kernels("reference"):
        yield


def data_of(text: str) -> dict:
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.S)
    assert found
    return json.loads(found[1])


def test_data_are_those_of_the_trajectory():
    spline = SplitBSpline(POINTS, order=4, dt=0.5, t0=100.0, learnable=False)
    data = data_of(page(spline, samples=50, up="-y", title="a <b>"))
    (curve,) = data["curves"]
    t = torch.tensor(curve["t"], dtype=torch.float64)
    assert (float(t[0]), float(t[-1])) == spline.domain
    motion = spline.kinematics(t)
    for name, x in (
        ("position", motion.position), ("rotation", motion.rotation), ("speed", motion.velocity.norm(dim=-1)),
        ("turning", motion.angular_velocity.norm(dim=-1)),
    ):  # fmt: skip
        torch.testing.assert_close(torch.tensor(curve[name], dtype=torch.float64), x, atol=2e-6, rtol=0)
    assert data["up"] == "-y"


def test_nanoseconds_count_from_the_start():
    spline = SplitBSpline(
        POINTS, order=4, dt_ns=500_000_000, t0_ns=1_700_000_000_000_000_000, learnable=False
    )
    (curve,) = data_of(page(spline, samples=7))["curves"]
    assert curve["t"] == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]


def test_positions_alone_have_no_frames():
    spline = BSpline(POINTS[:, :3].contiguous(), group=R3, order=4, dt=0.5, learnable=False)
    (curve,) = data_of(page(spline, samples=5))["curves"]
    assert set(curve) == {"name", "t", "position", "speed"}


def test_the_page_asks_the_network_for_nothing_and_names_cannot_end_the_script(tmp_path):
    spline = SplitBSpline(POINTS, order=4, dt=0.5, learnable=False)
    name = "</script><script>alert(1)</script>"
    measured = torch.tensor([[0.0, 1.0, 2.0], [float("nan"), 0.0, 0.0]], dtype=torch.float64)
    write_page(tmp_path / "a.html", {name: spline}, measured=measured, samples=5, title="<i>")
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert not re.search(r"(src|href)\s*=|https?://|@import|url\(", text)
    assert text.count("</script>") == 2
    assert "<i>" not in text
    data = data_of(text)
    assert data["curves"][0]["name"] == name
    assert data["measured"] == [[0.0, 1.0, 2.0]]


@needs_browser
def test_in_a_browser(tmp_path):
    """Readings at a moment, the projection of a turn by hand, zoom, the slider, switching a curve off."""
    splines = {
        "joint": BSpline(POINTS, group=SE3, order=4, dt=0.5, learnable=False),
        "split": SplitBSpline(POINTS, order=4, dt=0.5, learnable=False),
    }
    path = tmp_path / "view.html"
    write_page(path, splines, samples=3001, title="view")
    with Browser() as browser:
        browser.open(f"{path.as_uri()}#t=1.25")
        browser.wait("Number(document.body.dataset.painted) >= 1")

        def readings() -> list[str]:
            return browser.value("document.getElementById('readout').textContent").split("\n")

        lines = readings()
        assert lines[0] == "t 1.250 s"
        for name, at in (("joint", 1), ("split", 6)):
            motion = splines[name].kinematics(torch.tensor(1.25, dtype=torch.float64))
            assert lines[at] == name
            numbers = [[float(x) for x in re.findall(r"-?\d+\.\d+", line)] for line in lines[at + 1 : at + 5]]
            torch.testing.assert_close(torch.tensor(numbers[0]).double(), motion.position, atol=2e-4, rtol=0)
            q = torch.tensor(numbers[1]).double()
            assert float((q @ motion.rotation).abs()) == pytest.approx(1.0, abs=2e-4)
            assert numbers[2][0] == pytest.approx(float(motion.velocity.norm()), abs=1e-3)
            assert numbers[3][0] == pytest.approx(float(motion.angular_velocity.norm()), abs=1e-3)

        # The axes that the page draws are the columns of the rotation matrix.
        shown = browser.value("bodyAxes(at(curves[0], 1.25).rotation)")
        R = SE3.to_matrix(splines["joint"](torch.tensor(1.25, dtype=torch.float64)))[:3, :3]
        torch.testing.assert_close(torch.tensor(shown).double(), R.mT, atol=1e-5, rtol=0)

        # Turned by 100 px, the camera stands 0.7 rad further and still looks at the same point in the middle.
        before = browser.value("camera.yaw")
        browser.drag((500, 300), (600, 300))
        assert browser.value("camera.yaw") == pytest.approx(before - 0.7, abs=1e-6)
        middle = browser.value("projector(800, 600)(camera.target)")
        assert middle == pytest.approx([400, 300, browser.value("camera.distance")])
        # A point seen at right angles to the view, as far aside as half the distance.
        side = "projector(800, 600)(camera.target.map((x, i) => x + camera.distance / 2 * view().right[i]))"
        assert browser.value(side)[:2] == pytest.approx([400 + 1.1 * 600 / 2, 300])
        distance = browser.value("camera.distance")
        browser.wheel((500, 300), -500)
        browser.wait(f"camera.distance < 0.6 * {distance}")

        seek = (
            "const s = document.getElementById('slider'); s.value = 0.5; s.dispatchEvent(new Event('input'))"
        )
        browser.value(f"(() => {{ {seek} }})()")
        browser.wait("document.getElementById('clock').textContent === '1.500 s'")
        browser.value("document.getElementById('play').click()")
        browser.wait("now > 1.6")
        browser.value("document.getElementById('play').click()")
        assert browser.value("playing") is False
        browser.value("document.querySelectorAll('#legend input')[1].click()")
        browser.wait("!document.getElementById('readout').textContent.includes('split')")
        assert "joint" in readings()

        colours = (
            "[...new Uint32Array(document.getElementById('scene').getContext('2d')"
            ".getImageData(0, 0, 1200, 500).data.buffer)].filter((x) => (x >>> 0) === 0xffde6f2f).length"
        )
        assert browser.value(colours) > 100  # the path of the first curve, #2f6fde, as ABGR
        browser.value("document.querySelectorAll('#legend input')[0].click()")
        browser.wait(f"{colours} === 0")
        browser.picture(tmp_path / "view.png")
        assert (tmp_path / "view.png").stat().st_size > 5_000


@needs_browser
def test_the_world_is_turned_and_not_mirrored(tmp_path):
    spline = SplitBSpline(POINTS, order=4, dt=0.5, learnable=False)
    with Browser() as browser:
        for name in ("x", "y", "z", "-x", "-y", "-z"):
            path = tmp_path / f"{name}.html"
            write_page(path, spline, samples=20, up=name)
            browser.open(path.as_uri())
            turned = torch.tensor(browser.value("[[1,0,0],[0,1,0],[0,0,1]].map(upright)")).double().mT
            assert float(torch.linalg.det(turned)) == 1.0
            axis = torch.eye(3, dtype=torch.float64)["xyz".index(name[-1])] * (-1 if name[0] == "-" else 1)
            assert (turned @ axis).tolist() == [0.0, 0.0, 1.0]
