"""MJCF files that ask for more than they say, and robots out of them."""

import time

import pytest

from torchspline.robot import Robot
from torchspline.robot.bounds import check_mjcf


def world(content: str, asset: str = "") -> str:
    return f"<mujoco><asset>{asset}</asset><worldbody>{content}</worldbody></mujoco>"


ARM = "<body><joint axis='0 0 1'/><geom size='1'/><body pos='1 0 0'><joint/><geom size='1'/></body></body>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><mujoco/>", "a document type with entities of its own"),
        ("<mujoco><body></mujoco>", "XML Error: mismatched tag"),
        ("", "XML Error: no element found"),
        (world("<body>" * 500 + "</body>" * 500), "elements that go deeper than 400"),
        ("<body>" * 200_000, "elements that go deeper than 400"),
        (world("<body/>" * 100_001), "more than 100000 elements with all copies, at <body>"),
        (world("<replicate count='1000000'><site/></replicate>"), "more than 100000 elements"),
        (world("<replicate count='999'>" * 4 + "<site/>" + "</replicate>" * 4), "more than 100000 elements"),
        (world("<replicate count='1e300'><site/></replicate>"), "more than 100000 elements"),
        (world("<body><composite count='1000 1000 1'/></body>"), "elements with all copies, at <composite>"),
        (world("<flexcomp count='300 300 300'/>"), "elements with all copies, at <flexcomp>"),
        (
            world(ARM, "<hfield nrow='100000' ncol='100000' name='a'/>"),
            "a <hfield> of more than 10000000 numbers",
        ),
        (world(ARM, "<texture width='9999999999' height='8'/>"), "a <texture> of more than 10000000 numbers"),
        (
            "<mujoco><include file='/dev/zero'/></mujoco>",
            "a <include> from '/dev/zero', which is no regular file",
        ),
    ],
)
def test_more_than_the_text_is_refused_before_anything_is_made_of_it(text, message):
    began = time.process_time()
    with pytest.raises(ValueError, match=message):
        check_mjcf(text.encode())
    assert time.process_time() - began < 2  # milliseconds; the bound leaves room


def test_what_is_usual_passes():
    replicate = "<replicate count='10'><replicate count='100'><site/></replicate></replicate>"
    words = "<replicate count='many'><site/></replicate><replicate count='nan'/>"  # for MuJoCo to refuse
    check_mjcf(world(ARM + replicate + words, "<texture width='1000' height='1000'/>").encode())


def test_mujoco_is_asked_after_that(tmp_path):
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    robot = Robot.from_mjcf(world(ARM))
    assert robot.links == ("world", "body1", "body2")  # where the file has no names
    assert robot.joint_names == ("joint0", "joint1")
    path = tmp_path / "arm.xml"
    for bad, message in (
        (world(ARM.replace("1 0 0", "nan 0 0")), "'body2' has a pose or joint that is not finite"),
        (world("<replicate count='9999999'/>"), "expected an MJCF model in .*more than 100000 elements"),
        (world(ARM.replace("joint/", "joint axis='0 0 0'/")), "expected an MJCF model"),
    ):
        path.write_text(bad)
        with pytest.raises(ValueError, match=message) as caught:
            Robot.from_mjcf(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
