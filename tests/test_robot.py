"""Robots: links against matrices worked out from the XML, rates against differences, gradients, the traps of others."""

import sys

import numpy as np
import pytest
import pytorch_kinematics as pk
import torch
from robot_cases import DRIVEN, F64, LINKS, MOUNT, NAMES, URDF, joint_spline, poses

from torchspline import SE3, BSpline, Rn, imu
from torchspline.robot import Robot

ROBOT = Robot.from_urdf(URDF)


def random(*shape, seed=0, dtype=F64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def matrices(q):
    """(L, 4, 4) of all links, by the oracle."""
    found = poses(URDF, DRIVEN, q.tolist())
    return torch.from_numpy(np.stack([found[link] for link in LINKS]))


def test_description():
    assert ROBOT.joint_names == NAMES
    assert ROBOT.links[0] == "floor"
    assert set(ROBOT.links) == set(LINKS)
    pan, roll, slide, close = ROBOT.joints
    assert (pan.kind, roll.kind, slide.kind) == ("revolute", "continuous", "prismatic")
    assert (pan.lower, pan.upper, pan.velocity, pan.effort) == (-1.5, 1.5, 2.0, 30.0)
    assert (roll.lower, roll.upper, roll.velocity) == (-np.inf, np.inf, 3.0)
    assert (slide.lower, slide.upper) == (0.0, 0.4)
    assert close.effort == 1.0
    assert repr(ROBOT).startswith("Robot(4 joints: pan, roll, slide, close; 9 links")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1"])
def test_encodings(tmp_path, encoding):
    """Of the file, as it declares; text that declares one has been decoded already."""
    declared = URDF.replace("utf-8", encoding.removesuffix("-sig")).replace("shoulder", "épaule")
    path = tmp_path / "robot.urdf"
    path.write_bytes(declared.encode(encoding))
    for source in (path, str(path), declared, "\ufeff\n" + declared.partition("\n")[2]):
        assert "épaule" in Robot.from_urdf(source).links


def test_poses_equal_products_of_matrices_in_float64():
    """Offsets are those of the file: float32 would be off by 1e-8."""
    for seed in range(5):
        q = 3.0 * random(4, seed=seed)
        value = ROBOT.motion(LINKS, q).value
        assert (SE3.to_matrix(value) - matrices(q)).abs().max() < 2e-14
    turned = torch.tensor([0.0, 1000.0, 0.0, 0.0], dtype=F64)  # many turns of a continuous joint
    assert (SE3.to_matrix(ROBOT.motion(LINKS, turned).value) - matrices(turned)).abs().max() < 1e-12


def test_twist_and_acceleration_of_every_link_against_differences():
    """In terms of the oracle: body velocity from T^-1 dT, acceleration of the origin from the position."""
    spline, t, h = joint_spline(), torch.tensor([0.43, 0.74, 1.36], dtype=F64), 0.006
    motion = ROBOT.link(spline, LINKS).kinematics(t)
    stencil = torch.tensor([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60], dtype=F64)
    second = torch.tensor([1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90], dtype=F64)
    with torch.no_grad():
        q = spline(t[:, None] + h * torch.arange(-3, 4, dtype=F64))
    T = torch.stack([torch.stack([matrices(x) for x in row]) for row in q])  # (N, 7, L, 4, 4)
    rate = torch.einsum("k,nklij->lnij", stencil, T) / h
    bend = torch.einsum("k,nklij->lnij", second, T) / h**2
    middle = T[:, 3].transpose(0, 1)[..., :3, :3]
    hat = middle.mT @ rate[..., :3, :3]
    spin = middle.mT @ bend[..., :3, :3] - hat @ hat

    def vee(x):
        return torch.stack([x[..., 2, 1], x[..., 0, 2], x[..., 1, 0]], -1)

    pairs = {
        "velocity": rate[..., :3, 3],
        "acceleration": bend[..., :3, 3],
        "angular_velocity": vee(hat),
        "angular_acceleration": vee(spin),
    }
    for name, expected in pairs.items():
        found = getattr(motion, name)
        assert (found - expected).abs().max() < 1e-6 * expected.abs().max(), name
    moving = motion.angular_velocity[2:].abs().amax(dim=(1, 2))  # the first two stand on the floor
    assert moving.min() > 1e-2
    assert all(x[0].abs().max() == 0 for x in (motion.velocity, motion.angular_acceleration))


def test_acceleration_and_jerk_against_forward_mode():
    spline, t = joint_spline(), torch.tensor([0.31, 0.64, 1.22], dtype=F64)
    link = ROBOT.link(spline, "right")

    def along(f):
        return lambda s: torch.func.jvp(f, (s,), (torch.ones_like(s),))[1]

    state = link.evaluate(t, derivatives=3)
    velocity = lambda s: link.evaluate(s, derivatives=1).velocity  # noqa: E731
    torch.testing.assert_close(state.acceleration, along(velocity)(t), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(state.jerk, along(along(velocity))(t), rtol=1e-11, atol=1e-11)


def test_gradients_of_joints_to_second_order():
    """Double backward included, which pytorch-kinematics gets wrong by default."""
    spline = joint_spline(count=4, order=4)
    link, t = ROBOT.link(spline, "wrist"), torch.tensor([0.11], dtype=F64)

    def motion(points):
        value = torch.func.functional_call(link, {"joints.control_points": points}, (t,))
        rates = ROBOT.motion("head", points[1], points[2], points[3])
        return value, rates.velocity, rates.acceleration

    points = spline.control_points.detach().requires_grad_()
    assert torch.autograd.gradcheck(motion, (points,), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(motion, (points,))


def test_gradients_of_the_base_and_of_readings():
    spline, t = joint_spline(count=6), torch.tensor([0.11, 0.2], dtype=F64)
    base = SE3.random(generator=torch.Generator().manual_seed(1), dtype=F64).requires_grad_()

    def reading(base, points):
        joints = joint_spline(count=6, learnable=False)
        joints.control_points = points
        made = imu.measure(ROBOT.link(joints, "wrist", base=base), t)
        return made.gyroscope, made.accelerometer

    points = spline.control_points.detach().requires_grad_()
    assert torch.autograd.gradcheck(reading, (base, points))


def test_transforms_of_torch_func():
    q = random(3, 4)
    pose = lambda q: ROBOT.motion("right", q).value  # noqa: E731
    torch.testing.assert_close(torch.func.vmap(pose)(q), torch.stack([pose(x) for x in q]))
    forward, backward = torch.func.jacfwd(pose)(q[0]), torch.func.jacrev(pose)(q[0])
    torch.testing.assert_close(forward, backward, rtol=1e-9, atol=1e-12)
    each = torch.func.vmap(torch.func.jacrev(pose))(q)
    torch.testing.assert_close(each[0], forward)
    bends = torch.func.hessian(lambda q: pose(q).square().sum())(q[0])
    torch.testing.assert_close(
        bends, torch.func.jacrev(torch.func.jacrev(lambda q: pose(q).square().sum()))(q[0])
    )


def test_compiled_without_graph_breaks():
    link, t = ROBOT.link(joint_spline(learnable=False), "tip"), torch.linspace(0.0, 1.5, 5, dtype=F64)
    compiled = torch.compile(lambda t: link.evaluate(t).acceleration, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(t), link.evaluate(t).acceleration)


def test_twist_is_the_jacobian_times_the_rates():
    """The body Jacobian column by column, from unit rates, against differences of the pose."""
    q, h = random(4), 1e-6
    columns = ROBOT.motion("right", q.expand(4, 4), torch.eye(4, dtype=F64)).velocity
    base = ROBOT.motion("right", q).value
    for i, column in enumerate(columns):
        step = torch.zeros(4, dtype=F64)
        step[i] = h
        ahead, behind = (ROBOT.motion("right", q + s * step).value for s in (1, -1))
        expected = SE3.log(SE3.between(behind, ahead)) / (2 * h)
        torch.testing.assert_close(column, expected, rtol=1e-8, atol=1e-8)
    rate = random(4, seed=1)
    torch.testing.assert_close(ROBOT.motion("right", q, rate).velocity, columns.mT @ rate)
    assert base.shape == (7,)


@pytest.mark.parametrize("sensor", ["gyroscope", "accelerometer"])
def test_imu_on_a_link(sensor):
    """Mounted by a fixed joint or by `mounted` is the same; a still one reads gravity."""
    spline, t = joint_spline(), torch.linspace(0.0, 1.5, 7, dtype=F64)
    wrist, tip = ROBOT.link(spline, "wrist"), ROBOT.link(spline, "tip")
    direct = getattr(imu.measure(tip, t), sensor)
    for other in (imu.measure(wrist.mounted(MOUNT), t), imu.measure(wrist, t, T_body_imu=MOUNT)):
        torch.testing.assert_close(getattr(other, sensor), direct, rtol=1e-12, atol=1e-12)
    base = ROBOT.link(spline, "base")
    R = SE3.to_matrix(base(t[:1]))[0, :3, :3]
    still = {
        "gyroscope": torch.zeros(3, dtype=F64),
        "accelerometer": R.T @ torch.tensor([0, 0, 9.80665], dtype=F64),
    }
    torch.testing.assert_close(getattr(imu.measure(base, t), sensor)[3], still[sensor])


def test_shapes_and_batches():
    spline = joint_spline(3, 2)
    one, many = ROBOT.link(spline, "tip"), ROBOT.link(spline, ("tip", "base", "right"))
    shared, own = torch.linspace(0.0, 1.5, 5, dtype=F64), 1.5 * torch.rand(3, 2, 5, dtype=F64)
    for t in (shared, own, shared[2]):
        lead = (3, 2) if t.ndim == 0 else (3, 2, 5)
        state, both = one.evaluate(t), many.evaluate(t)
        assert state.value.shape == (*lead, 7)
        assert state.acceleration.shape == (*lead, 6)
        assert state.jerk is None
        assert both.velocity.shape == (3, *lead, 6)
        torch.testing.assert_close(both.acceleration[0], state.acceleration)
    assert one.domain == spline.domain
    assert [name for name, _ in one.named_parameters()] == ["joints.control_points"]
    nanoseconds = ROBOT.link(joint_spline(dt=None, dt_ns=3 * 10**8, t0_ns=5), "tip")
    torch.testing.assert_close(
        nanoseconds(torch.tensor([10**8 + 5])),
        ROBOT.link(joint_spline(), "tip")(torch.tensor([0.1], dtype=F64)),
    )


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_dtype_follows_the_joints(dtype):
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float16)
        link = ROBOT.link(joint_spline(), LINKS, base=MOUNT).to(dtype)
        state = link.evaluate(torch.tensor([0.3, 0.9], dtype=F64), derivatives=3)
    finally:
        torch.set_default_dtype(before)
    assert {x.dtype for x in state} == {dtype}
    exact = ROBOT.link(joint_spline(), LINKS, base=MOUNT).evaluate(torch.tensor([0.3, 0.9], dtype=F64))
    torch.testing.assert_close(state.acceleration.double(), exact.acceleration, rtol=1e-4, atol=1e-4)


def test_base():
    q, base = random(4), SE3.random(generator=torch.Generator().manual_seed(1), dtype=F64)
    still, moved = ROBOT.motion(LINKS, q, q), ROBOT.motion(LINKS, q, q, base=base)
    torch.testing.assert_close(SE3.to_matrix(moved.value), SE3.to_matrix(SE3.compose(base, still.value)))
    torch.testing.assert_close(moved.velocity, still.velocity)


# ---------------------------------------------------------------------- other formats


def plain(text):
    """Without what pytorch-kinematics leaves out."""
    return text.replace('<mimic joint="copy" multiplier="-2" offset="0.25"/>', "").replace(
        '<mimic joint="close" multiplier="0.5" offset="0.1"/>', ""
    )


def test_pytorch_kinematics_agrees_up_to_float32():
    text = plain(URDF).replace('<origin xyz="0.4 0.05 0"/>', '<origin xyz="0.4 0.05 0"/><axis xyz="1 0 0"/>')
    chain = pk.build_chain_from_urdf(text.encode()).to(dtype=F64)
    robots = (Robot.from_urdf(text), Robot.from_chain(chain))
    if not hasattr(chain, "forward_kinematics_tensor"):
        pytest.skip("pytorch-kinematics before 0.9 gives no plain matrices to compare with")
    q = random(3, 6)
    expected = chain.forward_kinematics_tensor(q)
    for robot, tolerance in zip(robots, (5e-7, 5e-7), strict=True):
        assert list(robot.joint_names) == chain.get_joint_parameter_names()
        for name, i in chain.frame_to_idx.items():
            assert (SE3.to_matrix(robot.motion(name, q).value) - expected[i]).abs().max() < tolerance
    assert robots[1].joints[0].velocity == 2.0
    # Its double backward, by its own automatic differentiation, is ours.
    index = chain.frame_to_idx["right"]

    def loss(pose):
        x = q[:1].clone().requires_grad_()
        (g,) = torch.autograd.grad(pose(x)[..., :3, 3].square().sum(), x, create_graph=True)
        return torch.autograd.grad(g.square().sum(), x)[0]

    theirs = loss(lambda x: chain.forward_kinematics_tensor(x, analytical_grad=False)[index])
    ours = loss(lambda x: SE3.to_matrix(robots[0].motion("right", x).value))
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_mjcf_against_mujoco():
    mujoco = pytest.importorskip("mujoco")
    text = """<mujoco><compiler angle="radian"/><worldbody><body name="a" pos="0 0.2 1" euler="0.1 0.2 0.3">
      <joint name="hinge" type="hinge" axis="0 1 0.5" pos="0.1 0 0.2" ref="0.3" limited="true" range="-1 1"/>
      <geom size="0.1"/><site name="s" pos="0 0 0.1" euler="1 0 0"/>
      <body name="b" pos="0.3 0 0"><joint name="x" type="slide" axis="1 0 1"/>
        <joint name="y" type="hinge" axis="1 0 0" pos="0 0.2 0"/><geom size="0.1"/></body></body>
    </worldbody></mujoco>"""
    robot = Robot.from_mjcf(text)
    assert robot.joint_names == ("hinge", "x", "y")
    assert [joint.kind for joint in robot.joints] == ["revolute", "prismatic", "continuous"]
    assert (robot.joints[0].lower, robot.joints[0].upper) == (-1.0, 1.0)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:] = (0.7, -0.4, 2.0)
    mujoco.mj_kinematics(model, data)
    state = robot.motion(robot.links, torch.tensor([0.7, -0.4, 2.0], dtype=F64)).value
    for pose, name in zip(state, robot.links, strict=True):
        at = data.site(name) if name == "s" else data.body(name)
        expected = np.eye(4)
        expected[:3, :3], expected[:3, 3] = at.xmat.reshape(3, 3), at.xpos
        assert np.abs(SE3.to_matrix(pose).numpy() - expected).max() < 1e-12, name


def test_bad_mjcf():
    pytest.importorskip("mujoco")
    text = "<mujoco><worldbody><body name='a'><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    for bad, kind, message in (
        (text, ValueError, "source: .* free or a ball; expected hinge or slide"),
        ("<nonsense", ValueError, "source: expected an MJCF model in source"),
        (5, TypeError, "source: expected XML text or the path of a file, got int"),
        ("missing.xml", FileNotFoundError, "source: .*: no such file"),
    ):
        with pytest.raises(kind, match=message):
            Robot.from_mjcf(bad)


def test_mjcf_without_mujoco_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install 'torchspline\[mjcf\]'"):
        Robot.from_mjcf("<mujoco/>")


# ---------------------------------------------------------------------- limits


def test_limits_are_reported():
    points = torch.zeros(10, 4, dtype=F64)
    points[:, 2] = 0.2
    points[6, 0], points[:, 3] = 4.0, 1.5
    spline = joint_spline()
    spline.control_points = torch.nn.Parameter(points)
    t = torch.linspace(*spline.domain, 200, dtype=F64)
    found = {(x.joint, x.quantity): x for x in ROBOT.over_limits(spline, t)}
    assert {x for x in found if x[0] not in ("follow", "copy")} == {
        ("pan", "position"), ("pan", "velocity"), ("close", "position"),
    }  # fmt: skip
    worst = found["pan", "position"]
    q = spline(t)[:, 0]
    assert worst.value == q.max().item()
    assert worst.time == t[q.argmax()].item()
    assert worst.limit == 1.5
    batch = joint_spline(2, 3, scale=0.01)
    batch.control_points = torch.nn.Parameter(batch.control_points.detach().clone())
    with torch.no_grad():
        batch.control_points[..., 2:] = 0.2
        batch.control_points[1, 2, :, 3] = -3.0
        batch.control_points[..., :, 3] = batch.control_points[..., :, 3].clamp(
            max=0.03
        )  # "follow" is 0.05 - close
    found = {x.joint: x for x in ROBOT.over_limits(batch, t) if x.quantity == "position"}
    assert set(found) == {"close", "follow", "copy"}
    for name, value, limit in (("close", -3.0, 0.0), ("follow", 3.05, 1.0), ("copy", -1.4, 0.0)):
        assert (found[name].batch, found[name].limit) == ((1, 2), limit)
        assert found[name].value == pytest.approx(value, abs=1e-12)
    assert ROBOT.over_limits(joint_spline(scale=0.0), t) == []


def test_joints_that_mimic_have_limits_of_their_own():
    """By the formulas of `DRIVEN`, worked out by hand: follow = 0.05 - close, copy = 0.1 + close / 2."""
    spline = joint_spline(scale=0.0)
    t = torch.linspace(*spline.domain, 200, dtype=F64)
    steps = torch.zeros_like(spline.control_points.detach())
    steps[..., 3] = torch.linspace(0.0, 0.9, steps.shape[-2], dtype=F64)
    spline.control_points = torch.nn.Parameter(steps)
    close = spline(t)[:, 3].detach()
    (only,) = ROBOT.over_limits(spline, t)
    assert (only.joint, only.quantity, only.limit) == ("follow", "position", 0.0)
    assert only.value == pytest.approx(0.05 - float(close.max()), abs=1e-14)
    assert only.time == t[close.argmax()].item()
    # Fast enough for "copy", which moves at half the rate, as for "close".
    quick = BSpline(steps, group=Rn(4), dt=0.02)
    t = torch.linspace(*quick.domain, 50, dtype=F64)
    rate = float(quick.evaluate(t, 1).velocity[:, 3].detach().abs().max())
    found = {x.joint: x for x in ROBOT.over_limits(quick, t) if x.quantity == "velocity"}
    assert set(found) == {"close", "follow", "copy"}
    for name, factor in (("close", 1.0), ("follow", 1.0), ("copy", 0.5)):
        assert found[name].value == pytest.approx(factor * rate, rel=1e-12)
    assert rate > 2.0


# ---------------------------------------------------------------------- real robots


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["kuka_iiwa", "ur5", "ur10e"])
def test_real_descriptions(shared_data, name):
    path = shared_data / "robots" / f"{name}.urdf"
    robot = Robot.from_urdf(path)
    q = random(robot.dof)
    driven = {joint: (i, 1.0, 0.0) for i, joint in enumerate(robot.joint_names)}
    for link, T in poses(path.read_text(), driven, q.tolist()).items():
        assert (SE3.to_matrix(robot.motion(link, q).value) - torch.from_numpy(T)).abs().max() < 1e-14
    assert all(joint.upper > joint.lower for joint in robot.joints)
