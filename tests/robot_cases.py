"""A small robot with every kind of joint, and its forward kinematics worked out from the XML by 4 x 4 matrices."""

import gzip
from xml.etree import ElementTree

import numpy as np
import torch

from torchspline import BSpline, Rn

F64 = torch.float64
#: A tree: turned axes, a continuous and a prismatic joint, one without an axis (x, says the format), joints that mimic
#: one another, fixed ones, and a branch. "tip" is `MOUNT` away from "wrist".
URDF = """<?xml version="1.0" encoding="utf-8"?>
<robot name="small">
  <link name="floor"/> <link name="base"/> <link name="shoulder"/> <link name="arm"/> <link name="wrist"/>
  <link name="left"/> <link name="right"/> <link name="tip"/> <link name="head"/>
  <joint name="stand" type="fixed"><parent link="floor"/><child link="base"/>
    <origin xyz="0.1 -0.3 0.2" rpy="0.2 -0.1 0.4"/></joint>
  <joint name="pan" type="revolute"><parent link="base"/><child link="shoulder"/>
    <origin xyz="0 0 0.123456789012345" rpy="0 0.3 0"/><axis xyz="0.2 0.1 2"/>
    <limit lower="-1.5" upper="1.5" velocity="2" effort="30"/></joint>
  <joint name="roll" type="continuous"><parent link="shoulder"/><child link="arm"/>
    <origin xyz="0.4 0.05 0"/><limit velocity="3" effort="3"/></joint>
  <joint name="slide" type="prismatic"><parent link="arm"/><child link="wrist"/>
    <origin rpy="1.5707963267948966 0 -0.5" xyz="0 0.3 0.1"/><axis xyz="1 1 0"/>
    <limit lower="0" upper="0.4" velocity="1" effort="3"/></joint>
  <joint name="close" type="revolute"><parent link="wrist"/><child link="left"/>
    <origin xyz="0.1 0 0"/><axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
  <joint name="follow" type="revolute"><parent link="left"/><child link="right"/>
    <origin xyz="0.05 0 0.02"/><axis xyz="0 1 0"/><limit lower="0" upper="1" velocity="1" effort="1"/>
    <mimic joint="copy" multiplier="-2" offset="0.25"/></joint>
  <joint name="copy" type="revolute"><parent link="base"/><child link="head"/>
    <axis xyz="0 1 1"/><limit lower="0" upper="1" velocity="1" effort="1"/>
    <mimic joint="close" multiplier="0.5" offset="0.1"/></joint>
  <joint name="screwed" type="fixed"><parent link="wrist"/><child link="tip"/>
    <origin xyz="0.3 -0.2 0.5" rpy="0 0 1.5707963267948966"/></joint>
</robot>
"""
NAMES = ("pan", "roll", "slide", "close")
LINKS = ("floor", "base", "shoulder", "arm", "wrist", "left", "right", "tip", "head")
MOUNT = torch.tensor([0.3, -0.2, 0.5, 0.5**0.5, 0.0, 0.0, 0.5**0.5], dtype=F64)
#: What drives each joint that moves: coordinate, factor and offset, mimicking worked out by hand.
DRIVEN = {
    "pan": (0, 1.0, 0.0), "roll": (1, 1.0, 0.0), "slide": (2, 1.0, 0.0), "close": (3, 1.0, 0.0),
    "copy": (3, 0.5, 0.1), "follow": (3, -1.0, 0.05),
}  # fmt: skip


def numbers(element, name, default):
    return np.array([float(x) for x in (default if element is None else element.get(name, default)).split()])


def turn(axis, angle):
    x, y, z = axis / np.linalg.norm(axis)
    hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * hat + (1 - np.cos(angle)) * hat @ hat


def poses(text, driven, q):
    """Of every link, (4, 4) by name: matrix after matrix down the tree, q a list of numbers."""
    joints = ElementTree.fromstring(text).findall("joint")
    found = {}

    def pose(link):
        joint = next((j for j in joints if j.find("child").get("link") == link), None)
        if joint is None:
            return np.eye(4)
        origin, T = joint.find("origin"), np.eye(4)
        roll, pitch, yaw = numbers(origin, "rpy", "0 0 0")
        T[:3, :3] = turn([0, 0, 1], yaw) @ turn([0, 1, 0], pitch) @ turn([1, 0, 0], roll)
        T[:3, 3] = numbers(origin, "xyz", "0 0 0")
        move, axis = np.eye(4), numbers(joint.find("axis"), "xyz", "1 0 0")
        if joint.get("type") != "fixed":
            i, factor, offset = driven[joint.get("name")]
            value = factor * q[i] + offset
            if joint.get("type") == "prismatic":
                move[:3, 3] = axis / np.linalg.norm(axis) * value
            else:
                move[:3, :3] = turn(axis, value)
        return pose(joint.find("parent").get("link")) @ T @ move

    for link in ElementTree.fromstring(text).findall("link"):
        found[link.get("name")] = pose(link.get("name"))
    return found


def joint_spline(*batch, dof=4, count=10, order=6, dt=0.3, seed=0, scale=1.0, **options):
    generator = torch.Generator().manual_seed(seed)
    points = scale * torch.randn(*batch, count, dof, generator=generator, dtype=F64)
    return BSpline(points, group=Rn(dof), order=order, dt=dt, **options)


def ur10e_log(folder):
    """Times, positions and velocities of the recorded run."""
    with gzip.open(folder / "robots" / "fourier_20s_8harm.csv.gz", "rt") as file:
        table = torch.from_numpy(np.loadtxt(file, delimiter=","))
    return table[:, 0], table[:, 1:7], table[:, 7:13]
