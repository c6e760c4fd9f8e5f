"""Bad arguments of robots, bodies and motion capture; joins the tables of the other functions."""

from collections.abc import Iterator
from types import SimpleNamespace

import pytorch_kinematics as pk
import torch
from error_arguments import (
    F32,
    F64,
    FOLDER,
    INF,
    NAN,
    POSE,
    Case,
    Q,
    T,
    V,
    accept,
    changed,
    file,
    numbers,
    refused,
    tensor,
    times,
    wholes,
)
from robot_cases import URDF
from test_bvh import BVH

import torchspline.io as records
from torchspline import BSpline, Rn, fit, people, robot
from torchspline.robot import LinkTrajectory, Robot, fit_joints

ROBOT = Robot.from_urdf(URDF)
JOINTS = BSpline(0.1 * torch.ones(8, 4, dtype=F64), group=Rn(4), dt=0.1)
MANY = BSpline(0.1 * torch.ones(2, 8, 4, dtype=F64), group=Rn(4), dt=0.1)
LINK, MANY_LINK = ROBOT.link(JOINTS, "tip"), ROBOT.link(MANY, "tip")
BASE, ANGLES = POSE[0, 0], torch.full((2, 8, 4), 0.1, dtype=F64)
LOG = torch.linspace(0.0, 1.0, 30, dtype=F64)
SWEEP = torch.sin(LOG[:, None] + torch.arange(4, dtype=F64))
FRAMES = torch.arange(30, dtype=F64) / 60
WALK = torch.cat([V[0, :1].expand(2, 30, 3), Q[0, :1].expand(2, 30, 4)], -1)
CHAIN = pk.build_chain_from_urdf(URDF.replace('<?xml version="1.0" encoding="utf-8"?>', ""))

#: What `public` in test_errors.py visits besides what the package exports, and what of it nobody is meant to call.
ROOTS = (robot, people, Robot.from_urdf, Robot.from_chain)
RESULTS = {"Joint", "JointFit", "OverLimit", "Robot", "Response", "Skeleton"}
UNTRIED = {"Skeleton.poses": "no arguments"}

accept(
    {
        "from_urdf": (Robot.from_urdf, {"source": URDF}),
        "from_chain": (Robot.from_chain, {"chain": CHAIN}),
        "Robot.motion": (
            ROBOT.motion,
            {
                "link": "tip",
                "q": ANGLES,
                "velocity": ANGLES,
                "acceleration": ANGLES,
                "jerk": ANGLES,
                "base": BASE,
            },
        ),
        "Robot.link": (ROBOT.link, {"joints": JOINTS, "link": "tip", "base": BASE}),
        "Robot.residual": (
            ROBOT.residual,
            {"link": "tip", "kind": fit.Gyroscope, "t": T, "measured": V[0, :3], "base": BASE},
        ),
        "Robot.over_limits": (ROBOT.over_limits, {"joints": JOINTS, "t": T}),
        "LinkTrajectory": (LinkTrajectory, {"robot": ROBOT, "joints": JOINTS, "link": "tip", "base": BASE}),
        "LinkTrajectory.evaluate": (MANY_LINK.evaluate, {"t": T, "derivatives": 2}),
        "fit_joints": (
            fit_joints,
            {
                "t": LOG,
                "positions": SWEEP,
                "velocities": SWEEP,
                "dt": 0.1,
                "position_sigma": 1.0,
                "velocity_sigma": 1.0,
            },
        ),
        "fit_body": (people.fit_body, {"t": FRAMES, "poses": WALK, "bandwidth": 10.0}),
        "response": (people.response, {"frequencies": T + 1.0, "rate": 60.0, "bandwidth": 10.0}),
        "read_bvh": (records.read_bvh, {"path": file(BVH, "walk.bvh"), "unit": 0.01}),
    }
)

_SOURCES = "from_urdf from_chain"
_MADE = "Robot.link LinkTrajectory Robot.over_limits Robot.residual"
NOT_APPLICABLE = {
    "shape": {"text": f"{_SOURCES} read_bvh"},
    "dtype": {"text": f"{_SOURCES} read_bvh"},
    "device": {
        "no two tensors": f"{_SOURCES} read_bvh response",
        "measurements are copied to the CPU": "fit_joints fit_body Robot.residual",
        "the base waits for the first call, and is refused there": "Robot.link LinkTrajectory",
    },
    "nan": {"text, whose numbers the reader checks": _SOURCES},
    "zero quaternion": {
        "no quaternion goes in": f"{_SOURCES} read_bvh response fit_joints Robot.over_limits LinkTrajectory.evaluate",
    },
    "count": {
        "any number of configurations, or one description": f"{_SOURCES} read_bvh response Robot.motion {_MADE} "
        "LinkTrajectory.evaluate",
    },
    "time": {
        "no times": f"{_SOURCES} read_bvh response Robot.motion Robot.link LinkTrajectory Robot.residual",
        "no trajectory yet": "fit_joints",
    },
}


def cases() -> Iterator[Case]:
    yield from sources()
    yield from motions()
    yield from links()
    yield from encoders()
    yield from bodies()


def sources() -> Iterator[Case]:
    missing = f"{FOLDER.name}/missing.urdf"
    function = "from_urdf"
    yield refused(function, "source", "type", 5, "got int", "XML text or the path of a file")
    yield refused(function, "source", "option", missing, "no such file", "XML text or the path of a file")
    yield refused(function, "source", "option", FOLDER.name, "a folder", "XML text or the path of a file")
    yield refused(function, "source", "option", "<nonsense", "cannot be read", "in source")
    yield refused(function, "source", "option", "", "got ''", "XML text or the path of a file")
    empty = URDF[: URDF.index("<link")] + '<link name="a"/></robot>'
    for bad, came, expected in (
        (empty, "got one without", "joints that move"),
        (URDF.replace('type="continuous"', 'type="floating"'), "'roll' is floating", "revolute, continuous"),
        (URDF.replace('<link name="arm"/>', ""), "'arm'", "expected it among the links"),
        (
            URDF.replace('<link name="arm"/>', '<link name="arm"/><link name="loose"/>'),
            "floor, loose",
            "one root link",
        ),
        (URDF.replace('joint="copy"', 'joint="gone"'), "mimics 'gone'", "another joint that moves"),
        (
            URDF.replace('joint="close" multiplier', 'joint="follow" multiplier'),
            "mimics",
            "another joint that moves",
        ),
        (
            URDF.replace('<link name="arm"/>', '<link name="arm"/><link name="arm"/>'),
            "two called 'arm'",
            "links of different names",
        ),
        (URDF.replace('lower="-1.5"', 'lower="nan"'), "'pan' has limits from nan to 1.5", "lower <= upper"),
        (URDF.replace('lower="-1.5"', 'lower="2"'), "'pan' has limits from 2.0 to 1.5", "lower <= upper"),
        (URDF.replace('velocity="2"', 'velocity="nan"'), "velocity and effort [nan, 30.0]", "at least zero"),
        (URDF.replace('xyz="0.2 0.1 2"', 'xyz="0 inf 2"'), "'pan' has the axis", "a direction"),
        (URDF.replace('xyz="0 0 0.123456789012345"', 'xyz="0 nan 0"'), "'pan' has an origin", "numbers"),
        (URDF.replace('multiplier="-2"', 'multiplier="inf"'), "'follow' mimics with factor inf", "finite"),
        (
            URDF.replace('<child link="tip"/>', '<child link="arm"/>'),
            "'arm' has two parents",
            "expected a tree",
        ),
        (URDF.replace("0.2 0.1 2", "0 0 0"), "'pan' has the axis", "expected a direction"),
        (URDF.replace("0.2 0.1 2", "0 0 x"), "could not convert", "a URDF robot"),
        (URDF.replace('name="slide"', 'name="pan"'), "two called 'pan'", "different names"),
    ):
        yield refused("from_urdf", "source", "option", bad, came, expected)
    yield refused("from_chain", "chain", "type", URDF, "got str", "pytorch_kinematics.Chain")


def base(function: str) -> Iterator[Case]:
    for case in tensor(function, "base", " (7,), an SE3 pose", slice(3, 7), like=BASE):
        if case.changes["base"] is not None:
            yield case


def named(function: str, several: bool = True) -> Iterator[Case]:
    yield refused(function, "link", "option", "elbow", "got 'elbow'", "one of floor, base")
    if several:
        yield refused(function, "link", "option", ("tip", "elbow"), "got 'elbow'", "one of floor, base")
        yield refused(function, "link", "option", (), "got none", "the name of a link")
        yield refused(function, "link", "type", 5, "got int", "the name of a link")


def motions() -> Iterator[Case]:
    function = "Robot.motion"
    yield from named(function)
    yield from base(function)
    yield refused(function, "base", "device", BASE.to("meta"), "meta", "cpu")
    yield refused(function, "base", "mixed dtype", BASE.to(F32), "torch.float32", "torch.float64")
    alone = {"velocity": None, "acceleration": None, "jerk": None}
    for case in tensor(function, "q", " (..., 4), one for each of pan, roll"):
        yield case._replace(changes={**alone, "base": None, **case.changes})
    for name in ("velocity", "acceleration", "jerk"):
        yield refused(function, name, "shape", ANGLES[..., :3], "got (2, 8, 3)", "shape (..., 4)")
        yield refused(function, name, "batch", ANGLES[:, :3], f"{name} (2, 3, 4)", "q (2, 8, 4)")
        yield refused(function, name, "device", ANGLES.to("meta"), "meta", "cpu")
        yield refused(function, name, "mixed dtype", ANGLES.to(F32), "torch.float32", "torch.float64")
        yield refused(function, name, "nan", changed(ANGLES, (0, 0, 1), NAN), "got nan", "finite")
    for name, missing in (("acceleration", "velocity"), ("jerk", "acceleration")):
        also = {missing: None}
        yield refused(function, name, "option", ANGLES, "got none", f"expected {missing}, too", **also)


def links() -> Iterator[Case]:
    other = BSpline(torch.zeros(8, 3, dtype=F64), group=Rn(3), dt=0.1)
    for function in ("Robot.link", "LinkTrajectory", "Robot.over_limits"):
        yield refused(function, "joints", "type", ANGLES, "got Tensor", "a Trajectory")
        yield refused(function, "joints", "shape", other, "got R3", "a trajectory in R4")
    for function in ("Robot.link", "LinkTrajectory"):
        yield from named(function)
        yield from base(function)
    yield refused("LinkTrajectory", "robot", "type", URDF, "got str", "Robot")
    single = ("LinkTrajectory.evaluate", "Robot.over_limits")
    for case in times("LinkTrajectory.evaluate"):
        yield case
        if case.category != "batch":
            yield case._replace(function=single[1])
    for bad in (-1, 4, 1.0, True, None):
        yield refused(single[0], "derivatives", "option", bad, f"got {bad!r}", "a whole number from 0 to 3")
    function = "Robot.residual"
    yield from named(function, several=False)
    yield from base(function)
    yield refused(function, "link", "option", "base", "got 'base'", "one that joints move")
    for bad in (5, "Gyroscope", SimpleNamespace):
        yield refused(function, "kind", "type", bad, f"got {bad!r}", "a class of residuals")
    yield from (c for c in tensor(function, "measured", " (3, 3)", like=V[0, :3]) if c.category != "shape")
    yield refused(function, "measured", "shape", V[0], "got (8, 3)", "N = 3 times")
    yield refused(function, "t", "dtype", T.to(F32), "torch.float32", "float64 seconds")
    yield refused(function, "t", "shape", T[:, None], "got (3, 1)", "shape (N,)")
    yield refused(function, "t", "nan", changed(T, 1, NAN), "got nan", "finite")


def encoders() -> Iterator[Case]:
    function = "fit_joints"
    yield refused(function, "t", "type", 0.1, "got float", "a torch.Tensor")
    yield refused(function, "t", "dtype", LOG.to(F32), "torch.float32", "float64 seconds")
    yield refused(function, "t", "shape", LOG[:5], "got (5,)", "shapes (N,) and (N, dof)")
    yield refused(function, "t", "nan", changed(LOG, 3, INF), "got inf", "finite")
    yield refused(function, "t", "count", torch.zeros(30, dtype=F64), "got 1", "at least 7 distinct times")
    for name in ("positions", "velocities"):
        yield refused(function, name, "type", SWEEP.tolist(), "got list", "a torch.Tensor")
        yield refused(
            function, name, "dtype", SWEEP.to(torch.int64), "torch.int64", "torch.float32 or torch.float64"
        )
        yield refused(function, name, "nan", changed(SWEEP, (3, 1), INF), "got inf at index (3, 1)", "finite")
        what = {"positions": "shapes (N,) and (N, dof)", "velocities": "as positions"}[name]
        yield refused(function, name, "shape", SWEEP[0], "got", what)
    for bad in ("best", ""):
        yield refused(function, "dt", "option", bad, f"got {bad!r}", "'auto'")
    yield from (c for c in numbers(function, "dt", 0.0, -1.0) if not isinstance(c.changes["dt"], str))
    yield from wholes(function, "order", 4)
    for name in ("position_sigma", "velocity_sigma"):
        for bad in ("a", True, 1j):
            yield refused(function, name, "type", bad, f"got {type(bad).__name__}", "expected a number")
        for bad in (NAN, 0.0, -1.0, INF):
            yield refused(function, name, "nan", bad, f"got {bad}", "a finite number above zero")
        yield refused(function, name, "shape", torch.ones(3, dtype=F64), "got (3,)", "shape (4,)")
        yield refused(function, name, "nan", torch.zeros(4, dtype=F64), "got 0.0", "above zero")
    also = {"velocities": None}
    alone = {**also, "velocity_sigma": None}
    yield refused(
        function, "estimate_delay", "option", True, "got none", "expected velocities with it", **alone
    )
    yield refused(
        function, "velocity_sigma", "option", 1.0, "got none", "expected velocities with it", **also
    )


def bodies() -> Iterator[Case]:
    function, shapes = "fit_body", "shapes (N,) and (J, N, 7)"
    yield from tensor(function, "poses", "s (N,) and (J, N, 7)", slice(3, 7), like=WALK, named="t, poses")
    yield refused(function, "t", "type", 0.1, "got float", "a torch.Tensor")
    yield refused(
        function, "t", "dtype", FRAMES.to(torch.int64), "torch.int64", "torch.float32 or torch.float64"
    )
    yield refused(function, "t", "shape", FRAMES[:5], "got (5,)", shapes, named="t, poses")
    yield refused(function, "t", "nan", changed(FRAMES, 3, NAN), "got nan", "finite")
    yield refused(function, "t", "time", FRAMES.flip(0), "got 30", "increasing times")
    few = {"poses": WALK[:, :5]}
    yield refused(function, "t", "count", FRAMES[:5], "got 5", "at least 7 increasing times", **few)
    yield refused("response", "frequencies", "type", 5.0, "got float", "a torch.Tensor")
    yield refused("response", "frequencies", "dtype", T.to(torch.int64), "torch.int64", "torch.float64")
    yield refused("response", "frequencies", "shape", T[:, None], "got (3, 1)", "shape (F,)")
    yield refused("response", "frequencies", "nan", changed(T, 1, NAN), "got nan", "finite")
    yield refused("response", "frequencies", "option", T - 1.0, "got -1", "above zero")
    yield from numbers("response", "rate", 0.0, -1.0)
    for function in ("fit_body", "response"):
        yield from numbers(function, "bandwidth", 0.0, -1.0)
        yield refused(function, "bandwidth", "option", 20.0, "got 20.0", "at most 16.67 Hz")
        yield from wholes(function, "order", 4)
    function = "read_bvh"
    yield refused(function, "path", "type", 5, "got int", "the path of a file")
    yield refused(function, "path", "option", FOLDER.name, "got a folder", "a file")
    yield refused(function, "path", "option", f"{FOLDER.name}/missing.bvh", "no such file", "missing.bvh")
    yield from numbers(function, "unit", 0.0, -1.0)
