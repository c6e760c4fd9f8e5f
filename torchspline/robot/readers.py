"""Robot descriptions as frames: URDF, MJCF and chains of pytorch-kinematics.

Numbers go from the file into float64: pytorch-kinematics keeps offsets in float32, whatever its chain is converted to
later, takes z for a joint's axis where a URDF says none (the format says x), moves joints that mimic others by
themselves, and turns MJCF bodies about their origin wherever the joint is.
"""

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchspline.robot.bounds import check_mjcf

Array = NDArray[np.float64]
_NONE = math.inf
#: What says in which encoding XML is.
_DECLARED = re.compile(r"""^(<\?xml[^>]*?)\s+encoding\s*=\s*(?:"[^"]*"|'[^']*')""")


class Joint(NamedTuple):
    """A coordinate of a robot, in rad or m; limits that a description does not give are infinite."""

    name: str
    #: "revolute", "continuous" or "prismatic".
    kind: str
    lower: float = -_NONE
    upper: float = _NONE
    #: Of the rate, rad/s or m/s, and of torque or force, N m or N.
    velocity: float = _NONE
    effort: float = _NONE


class Move(NamedTuple):
    """How a frame moves with a joint: `Exp(screw (factor q + offset))`, after what stands before it."""

    joint: str
    #: [v, omega] in the frame that moves.
    screw: Array
    factor: float = 1.0
    offset: float = 0.0
    #: The joint that stands here, where it mimics that one: its limits are of what it does itself.
    mimic: Joint | None = None


class Frame(NamedTuple):
    """A link: where it sits on its parent, (4, 4), and how it moves there."""

    name: str
    #: None for the root.
    parent: str | None
    pose: Array
    moves: tuple[Move, ...] = ()


def transform(position: Sequence[float] | Array, rotation: Array | None = None) -> Array:
    """`(4, 4)` from a position and a rotation matrix."""
    T = np.eye(4)
    T[:3, 3] = position
    if rotation is not None:
        T[:3, :3] = rotation
    return T


def screw(
    kind: str, axis: Sequence[float] | Array, anchor: Sequence[float] | Array = (0.0, 0.0, 0.0)
) -> Array:
    """[v, omega] of a unit step: along the axis, or about it through the anchor."""
    unit = np.asarray(axis, float) / np.linalg.norm(axis)
    if kind == "prismatic":
        return np.concatenate([unit, np.zeros(3)])
    return np.concatenate([np.cross(anchor, unit), unit])


def content(source: str | PathLike[str]) -> tuple[str, bytes]:
    """What errors call it, and the bytes: of `source` itself if it is XML, else of the file of that name.

    Which encoding they are in is for the parser to find out: a file may declare one. Text is past that.
    """
    if isinstance(source, str) and (text := source.lstrip("\ufeff \t\r\n")).startswith("<"):
        return "source", _DECLARED.sub(r"\1", text, count=1).encode()
    if not isinstance(source, (str, PathLike)):
        raise TypeError(f"source: expected XML text or the path of a file, got {type(source).__name__}")
    path = Path(source)
    if not str(source) or not path.is_file():
        came = str(source) if len(str(source)) <= 200 else str(source)[:197] + "..."
        what = "a folder" if path.is_dir() else "no such file"
        raise FileNotFoundError(f"source: expected XML text or the path of a file, got {came!r}: {what}")
    return str(path), path.read_bytes()


@contextmanager
def naming(source: str | PathLike[str]) -> Iterator[None]:
    """Errors in the block are of one line, and name the file that `source` is, if it is one."""
    try:
        yield
    except ValueError as reason:
        text = " ".join(str(reason).split())
        is_text = isinstance(source, str) and source.lstrip().startswith("<")
        if not is_text and str(source) not in text:
            text = f"source: {source}: {text.removeprefix('source: ')}"
        raise ValueError(text if len(text) <= 500 else f"{text[:497]}...") from None


# ---------------------------------------------------------------------- URDF


def from_urdf(source: str | PathLike[str]) -> tuple[list[Joint], list[Frame]]:
    """Joints and frames, parents first, in the order in which pytorch-kinematics counts them."""
    from pytorch_kinematics.urdf_parser_py.urdf import URDF

    name, text = content(source)
    try:
        robot = URDF.from_xml_string(text)
    except Exception as reason:  # the parser raises whatever comes, assertions included
        raise ValueError(
            f"source: expected a URDF robot in {name}, got one that cannot be read: {reason}"
        ) from None
    return _urdf_tree(robot)


def _urdf_tree(robot: Any) -> tuple[list[Joint], list[Frame]]:
    links = [link.name for link in robot.links]
    if len(set(links)) < len(links):
        twice = next(name for name in links if links.count(name) > 1)
        raise ValueError(f"source: expected links of different names, got two called {twice!r}")
    children: dict[str, list[Any]] = {}
    parent_of: dict[str, str] = {}
    for joint in robot.joints:
        for end in (joint.parent, joint.child):
            if end not in links:
                raise ValueError(
                    f"source: joint {joint.name!r} needs the link {end!r}; expected it among the links"
                )
        if joint.child in parent_of:
            raise ValueError(f"source: link {joint.child!r} has two parents; expected a tree")
        parent_of[joint.child] = joint.parent
        children.setdefault(joint.parent, []).append(joint)
    roots = [link for link in links if link not in parent_of]
    if len(roots) != 1:
        raise ValueError(f"source: expected one root link, got {len(roots)}: {', '.join(roots) or 'a cycle'}")
    sources = _mimicked(robot.joints)
    frames, joints, stack = [Frame(roots[0], None, np.eye(4))], [], [*reversed(children.get(roots[0], []))]
    while stack:
        joint = stack.pop()
        move: tuple[Move, ...] = ()
        if joint.type != "fixed":
            own = _urdf_joint(joint)
            driver, factor, offset = sources[joint.name]
            if driver == joint.name:
                joints.append(own)
            mimic = own if driver != joint.name else None
            move = (Move(driver, _urdf_screw(joint), factor, offset, mimic),)
        pose = _origin(joint.origin)
        if not np.isfinite(pose).all():
            raise ValueError(
                f"source: joint {joint.name!r} has an origin that is not finite; expected numbers"
            )
        frames.append(Frame(joint.child, joint.parent, pose, move))
        stack += reversed(children.get(joint.child, []))
    if len(frames) != len(links):
        left = sorted(set(links) - {frame.name for frame in frames})
        raise ValueError(f"source: expected a tree, got links that hang on a cycle: {', '.join(left)}")
    return joints, frames


def _urdf_joint(joint: Any) -> Joint:
    if joint.type not in ("revolute", "continuous", "prismatic"):
        raise ValueError(
            f"source: joint {joint.name!r} is {joint.type}; expected revolute, continuous, prismatic or fixed"
        )
    limit = joint.limit
    if limit is None:
        return Joint(joint.name, joint.type)
    bounds = (-_NONE, _NONE) if joint.type == "continuous" else (limit.lower or 0.0, limit.upper or 0.0)
    if not bounds[0] <= bounds[1]:
        raise ValueError(
            f"source: joint {joint.name!r} has limits from {bounds[0]} to {bounds[1]}; expected lower <= upper"
        )
    most = [_NONE if x is None else float(x) for x in (limit.velocity, limit.effort)]
    if not all(x >= 0 for x in most):
        raise ValueError(
            f"source: joint {joint.name!r} has limits of velocity and effort {most}; expected numbers of at least zero"
        )
    return Joint(joint.name, joint.type, *map(float, bounds), *most)


def _urdf_screw(joint: Any) -> Array:
    axis = (1.0, 0.0, 0.0) if joint.axis is None else joint.axis
    if not 0 < np.linalg.norm(axis) < math.inf:
        raise ValueError(f"source: joint {joint.name!r} has the axis {axis}; expected a direction")
    return screw(joint.type, axis)


def _mimicked(joints: Sequence[Any]) -> dict[str, tuple[str, float, float]]:
    """Of each joint the one that drives it in the end, factor and offset."""
    own = {joint.name: joint for joint in joints}
    found = {}
    for name, joint in own.items():
        factor, offset, seen = 1.0, 0.0, {name}
        while joint.mimic is not None:
            rule = joint.mimic
            rate = 1.0 if rule.multiplier is None else float(rule.multiplier)
            offset += factor * (rule.offset or 0.0)
            factor *= rate
            if not math.isfinite(factor) or not math.isfinite(offset):
                raise ValueError(
                    f"source: joint {name!r} mimics with factor {factor} and offset {offset}; expected finite numbers"
                )
            if rule.joint not in own or own[rule.joint].type == "fixed" or rule.joint in seen:
                raise ValueError(
                    f"source: joint {name!r} mimics {rule.joint!r}; expected another joint that moves by itself"
                )
            seen.add(rule.joint)
            joint = own[rule.joint]
        found[name] = joint.name, factor, offset
    return found


def _origin(origin: Any) -> Array:
    if origin is None:
        return np.eye(4)
    roll, pitch, yaw = origin.rpy or (0.0, 0.0, 0.0)
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return transform(origin.xyz or (0.0, 0.0, 0.0), about_z @ about_y @ about_x)


# ---------------------------------------------------------------------- MJCF


def from_mjcf(source: str | PathLike[str]) -> tuple[list[Joint], list[Frame]]:
    """Of MuJoCo's own parser; bodies and sites are frames."""
    try:
        import mujoco
    except ImportError:
        raise ImportError("MJCF files need MuJoCo's parser: pip install 'torchspline[mjcf]'") from None
    name, text = content(source)
    try:
        check_mjcf(text)
        model = mujoco.MjModel.from_xml_string(text.decode(errors="replace"))
    except (ValueError, RuntimeError, mujoco.FatalError, mujoco.UnexpectedError) as reason:
        raise ValueError(
            f"source: expected an MJCF model in {name}, got one that cannot be read: {reason}"
        ) from None
    kinds = {mujoco.mjtJoint.mjJNT_HINGE: "revolute", mujoco.mjtJoint.mjJNT_SLIDE: "prismatic"}
    joints, frames = [], []

    def called(b: int) -> str:
        return model.body(b).name or f"body{b}"

    for b in range(model.nbody):
        body, moves = model.body(b), []
        for j in range(int(body.jntadr[0]), int(body.jntadr[0]) + int(body.jntnum[0])):
            joint = model.joint(j)
            kind = kinds.get(mujoco.mjtJoint(int(joint.type[0])))
            if kind is None:
                raise ValueError(f"source: joint {joint.name!r} is free or a ball; expected hinge or slide")
            limited = bool(model.jnt_limited[j])
            lower, upper = joint.range if limited else (-_NONE, _NONE)
            kind = "continuous" if kind == "revolute" and not limited else kind
            joints.append(Joint(joint.name or f"joint{j}", kind, float(lower), float(upper)))
            # Poses hold where the joint stands at its reference.
            reference = float(model.qpos0[int(joint.qposadr[0])])
            moves.append(Move(joints[-1].name, screw(kind, joint.axis, joint.pos), 1.0, -reference))
        parent = None if b == 0 else called(int(body.parentid[0]))
        frames.append(Frame(called(b), parent, transform(body.pos, _matrix(body.quat)), tuple(moves)))
    for s in range(model.nsite):
        site = model.site(s)
        on = called(int(site.bodyid[0]))
        frames.append(Frame(site.name or f"site{s}", on, transform(site.pos, _matrix(site.quat))))
    for frame in frames:
        numbers = [frame.pose, *(np.append(move.screw, move.offset) for move in frame.moves)]
        if not all(np.isfinite(x).all() for x in numbers):
            raise ValueError(
                f"source: {frame.name!r} has a pose or joint that is not finite; expected numbers"
            )
    return joints, frames


def _matrix(q: Array) -> Array:
    from scipy.spatial.transform import Rotation

    if not 0 < np.linalg.norm(q) < math.inf:  # MuJoCo normalises; numbers at the edge are left as they are
        raise ValueError(f"source: expected rotations, got the quaternion {q}")
    return Rotation.from_quat(np.roll(q, -1)).as_matrix()


# ---------------------------------------------------------------------- pytorch-kinematics


def from_chain(chain: Any) -> tuple[list[Joint], list[Frame]]:
    """Of a `pytorch_kinematics.Chain`, with the offsets and axes that it has."""
    if not hasattr(chain, "_root") or not hasattr(chain, "get_joint_parameter_names"):
        raise TypeError(f"chain: expected a pytorch_kinematics.Chain, got {type(chain).__name__}")
    joints, frames = [], []
    stack: list[tuple[Any, str | None]] = [(chain._root, None)]
    while stack:
        frame, parent = stack.pop()
        pose = np.eye(4)
        for part in (frame.link.offset, frame.joint.offset):
            if part is not None:
                pose = pose @ _orthonormal(part.get_matrix()[0].double().cpu().numpy())
        moves: tuple[Move, ...] = ()
        if frame.joint.joint_type != "fixed":
            lower, upper = frame.joint.limits or (-_NONE, _NONE)
            most = [
                _NONE if x is None else float(x[1])
                for x in (frame.joint.velocity_limits, frame.joint.effort_limits)
            ]
            joints.append(Joint(frame.joint.name, frame.joint.joint_type, float(lower), float(upper), *most))
            axis = frame.joint.axis.double().cpu().numpy()
            moves = (Move(frame.joint.name, screw(frame.joint.joint_type, axis)),)
        frames.append(Frame(frame.name.strip(), parent, pose, moves))
        stack += [(child, frames[-1].name) for child in reversed(frame.children)]
    return joints, frames


def _orthonormal(T: Array) -> Array:
    """The nearest rigid motion: what float32 left of one would grow along the chain."""
    U, _, V = np.linalg.svd(T[:3, :3])
    return transform(T[:3, 3], U @ V)
