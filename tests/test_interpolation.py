"""Every scheme of [H18]: what it declares, its rates, SciPy where that knows the curve, the survey's formulas."""

import math

import batteries as kit
import pytest
import scipy.interpolate
import torch
from batteries import normal
from oracles import body_rates
from scipy.spatial.transform import Rotation, Slerp
from spline_cases import close
from test_jet import derivatives_of

from torchspline import R3, SE3, SO3, Group, KeyframeSpline, Trajectory
from torchspline.functional import interpolate, nonuniform_bspline
from torchspline.groups import DualQuaternion, convert
from torchspline.splines.interpolation import SCHEMES, SURVEY
from torchspline.splines.interpolation.bezier import bernstein
from torchspline.splines.interpolation.bsplines import knots_of, with_phantoms

float64 = torch.float64
EVEN = torch.arange(7, dtype=float64) - 1.0
UNEVEN = torch.tensor([0.0, 0.7, 1.9, 2.5, 4.0, 4.3, 6.0], dtype=float64) - 1.0
each_name = pytest.mark.parametrize("name", SURVEY)
each_scheme = pytest.mark.parametrize("scheme", SCHEMES)
each_clock = pytest.mark.parametrize("times", [EVEN, UNEVEN], ids=("even", "uneven"))


def group_of(name):
    group = SURVEY[name].group
    return R3 if group == "Rn" else Group(group)


def keyframes(group, count=7, seed=0):
    """Neighbours up to 1.5 rad apart, in quaternions of any sign."""
    steps = kit.tangents(group, [1.5], each=count - 1, seed=seed)
    points = [group.random(generator=kit.generator(seed))]
    for step in steps:
        points.append(group.compose(points[-1], group.exp(step)))
    return kit.rescaled(group, torch.stack(points), (2.0, -0.3, 1.0))


def quaternions(times, seed=0):
    """Keys of SO3 with signs that go on, and SciPy's rotations of them."""
    q = SO3.normalize(keyframes(SO3, len(times), seed=seed))
    sign = torch.cumprod(torch.cat([torch.ones(1), (q[1:] * q[:-1]).sum(-1).sign()]), 0)
    return q * sign[:, None]


# ---------------------------------------------------------------------- what is declared


@each_name
@each_clock
def test_declared_properties(name, times):
    """Interpolation at keys; continuity from one-sided derivatives at keys; local control by moving one key."""
    group = group_of(name)
    spline = KeyframeSpline(name, keyframes(group), times, learnable=False)
    declared = spline.properties
    miss = group.log(group.between(group.normalize(spline.keyframes), spline(times))).norm(dim=-1)
    assert miss[[0, -1]].max() < 1e-12, "every scheme starts and ends at a key"
    assert (miss[1:-1].max() < 1e-12) == declared.interpolates
    if not declared.interpolates:
        assert miss[1:-1].min() > 1e-3

    h = 1e-7
    before, after = (spline.evaluate(times[1:-1] + s * h, declared.derivatives) for s in (-1, 1))
    continuous = declared.derivatives if declared.continuity is None else declared.continuity
    for r in range(1, 4):
        jump = (before[r] - after[r]).abs().amax(-1)
        if r <= continuous:
            assert jump.max() < 3e-4, f"derivative {r} jumps by {jump.max():.1e}"
        elif r == continuous + 1:
            assert jump.min() > 1e-3, f"derivative {r} does not jump at every key"

    moved = spline.keyframes.clone()
    moved[3] = group.compose(moved[3], group.exp(kit.tangents(group, [0.2], each=1, seed=5))[0])
    other = KeyframeSpline(name, moved, times)
    middles = (times[1:] + times[:-1]) / 2
    changed = [
        i for i in range(6) if (spline(middles[i : i + 1]) - other(middles[i : i + 1])).abs().max() > 1e-9
    ]
    reach = 6 if declared.reach is None else declared.reach
    assert changed == [i for i in range(6) if i - reach <= 3 <= i + 1 + reach]


@each_scheme
@pytest.mark.parametrize("group", [*kit.FIXED, R3, Group("R3xSO3")], ids=str)
def test_rates_on_every_group(scheme, group):
    """Velocity, acceleration and jerk by nested forward mode through matrices."""
    count = 3 if scheme == "bezier" else 5  # geodesics between geodesics between ...
    keys, t = keyframes(group, count, seed=2), torch.tensor([0.1, 0.9, 2.0, 3.3], dtype=float64)
    times = torch.tensor([-0.2, 0.7, 1.5, 3.0, 3.6], dtype=float64)[[*range(count - 1), -1]]

    def matrix(t):
        value = interpolate(scheme, keys, times, t, 0, group=group, validate=False).value
        return group.to_matrix(value, validate=False)

    state = interpolate(scheme, keys, times, t, 3, group=group)
    for ours, exact in zip(state[1:], body_rates(group, derivatives_of(matrix, t, 3)), strict=True):
        assert close(ours, exact, 1e-9)
    for count in range(3):
        fewer = interpolate(scheme, keys, times, t, count, group=group)
        assert all(x is None for x in fewer[count + 1 :])
        assert all(close(a, b, 1e-13) for a, b in zip(fewer[: count + 1], state, strict=False))
    for start, stop in group.arithmetic.unit_blocks:
        assert close(state.value[:, start:stop].norm(dim=-1), torch.ones(4, dtype=float64), 1e-14)


# ---------------------------------------------------------------------- SciPy, where it knows the curve

T = torch.linspace(-1.0, 5.0, 43, dtype=float64)


@each_clock
def test_scipy_on_numbers(times):
    y = normal(7, 3, seed=1)
    lerp = interpolate("LERP", y, times, T).value
    assert close(lerp, torch.as_tensor(scipy.interpolate.make_interp_spline(times, y, k=1)(T)), 1e-13)
    closed = torch.cat([y[:-1], y[:1]])
    for ends, keys in (("natural", y), ("clamped", y), ("periodic", closed)):
        theirs = scipy.interpolate.CubicSpline(times, keys, bc_type=ends)
        state = interpolate("CompositeBezier", keys, times, T[1:-1], 3, ends=ends)
        smooth = ((T[1:-1, None] - times).abs() > 1e-6).all(-1)  # third derivatives jump at keys
        for r, ours in enumerate(state):
            assert close(ours[smooth], torch.as_tensor(theirs(T[1:-1].numpy(), r))[smooth], 1e-11)
    theirs = scipy.interpolate.BPoly(y[:, None].numpy(), [-1.0, 5.0])
    for name in ("bezier", "bernstein"):
        state = interpolate(name, y, times, T, 3, group=R3)
        for r, ours in enumerate(state):
            assert close(ours, torch.as_tensor(theirs(T.numpy(), r)), 1e-11)
    knots = knots_of(times)
    theirs = scipy.interpolate.BSpline(knots.numpy(), with_phantoms(R3, y).numpy(), 3)
    for name in ("bspline", "cumulative_bspline"):
        for r, ours in enumerate(interpolate(name, y, times, T[:-1], 2, group=R3)[:3]):
            assert close(ours, torch.as_tensor(theirs(T[:-1].numpy(), r)), 1e-12)


@each_clock
def test_scipy_on_rotations(times):
    q = quaternions(times)
    slerp = Slerp(times.numpy(), Rotation.from_quat(q.roll(-1, -1).numpy()))(T.numpy()).as_quat()
    state = interpolate("SLERP", q, times, T)
    assert kit.equal_up_to_sign(SO3, state.value, torch.as_tensor(slerp).roll(1, -1)) < 30
    for ends in ("natural", "clamped"):
        theirs = torch.as_tensor(scipy.interpolate.CubicSpline(times, q, bc_type=ends)(T))
        assert close(interpolate("RQBez", q, times, T, ends=ends).value, SO3.normalize(theirs), 1e-13)


def test_uniform_cubics_are_the_matrix_form():
    """[H18] (2) and (18) on phantom points; the same as the uniform B-spline of the library."""
    matrix = torch.tensor([[-1, 3, -3, 1], [3, -6, 3, 0], [-3, 0, 3, 0], [1, 4, 1, 0]], dtype=float64) / 6
    u = torch.tensor([0.0, 0.3, 0.9], dtype=float64)
    weights = torch.stack([u**3, u**2, u, torch.ones_like(u)], -1) @ matrix
    Q = DualQuaternion.normalize(keyframes(DualQuaternion))
    Q = Q * torch.cumprod(torch.cat([torch.ones(1), (Q[1:, :4] * Q[:-1, :4]).sum(-1).sign()]), 0)[:, None]
    fused = interpolate("DLFus", Q, EVEN, EVEN[2] + u).value
    assert close(fused, DualQuaternion.normalize(weights @ Q[1:5]), 1e-13)
    for name in ("CuBsp", "SpFus", "ScFus", "SPLIT CuBsp"):
        group = group_of(name)
        keys = keyframes(group)
        from torchspline import phantom_points
        from torchspline.functional import bspline

        expected = bspline(phantom_points(keys, group), T, group=group, dt=1.0, t0=-1.0)
        ours = interpolate(name, keys, EVEN, T)
        assert kit.equal_up_to_sign(group, ours.value, expected.value) < 100
        assert close(ours.velocity, expected.velocity, 1e-12)


# ---------------------------------------------------------------------- the survey's own formulas


def multiply(p, q):
    w, v = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1, keepdim=True), None
    v = torch.linalg.cross(p[..., 1:], q[..., 1:]) + p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:]
    return torch.cat([w, v], dim=-1)


def conjugate(q):
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


def exponential(w):
    angle = w.norm(dim=-1, keepdim=True)
    return torch.cat([(angle / 2).cos(), w / angle * (angle / 2).sin()], dim=-1)


def logarithm(q):
    return 2 * torch.acos(q[..., :1]) * q[..., 1:] / q[..., 1:].norm(dim=-1, keepdim=True)


def slerp(a, b, u):
    return multiply(a, exponential(u * logarithm(multiply(conjugate(a), b))))


def test_squad_as_written():
    """(14)-(16), on SU(2) with arccos; (6) is only right for unit quaternions."""
    q = quaternions(EVEN)
    s = q.clone()
    back, ahead = (logarithm(multiply(conjugate(q[1:-1]), other)) for other in (q[:-2], q[2:]))
    s[1:-1] = multiply(q[1:-1], exponential(-(ahead + back) / 4))
    for i in (0, 2, 5):
        for u in (0.2, 0.5, 0.8):
            expected = slerp(slerp(q[i], q[i + 1], u), slerp(s[i], s[i + 1], u), 2 * u * (1 - u))
            ours = interpolate("SQUAD", q, EVEN, EVEN[i : i + 1] + u).value[0]
            assert close(ours, expected, 1e-12)


def test_linear_blending_as_written():
    """(9), and the same eight numbers at a time."""
    q, times = quaternions(UNEVEN), UNEVEN
    u = 0.3
    t = (1 - u) * times[:-1] + u * times[1:]
    blend = (1 - u) * q[:-1] + u * q[1:]
    assert close(interpolate("QLB", q, times, t).value, blend / blend.norm(dim=-1, keepdim=True), 1e-14)
    assert close(bernstein(3, torch.tensor(0.3))[1], torch.tensor(3 * 0.3 * 0.49), 1e-6)


@each_clock
def test_dual_quaternions_are_rigid_motions(times):
    """ScLERP is SE3Up and ScFus is SpFus."""
    poses = keyframes(SE3)
    dual = convert.pose_to_dual_quaternion(poses)
    for theirs, ours in (("SE3Up", "ScLERP"), ("SpFus", "ScFus")):
        a, b = interpolate(theirs, poses, times, T, 3), interpolate(ours, dual, times, T, 3)
        assert kit.equal_up_to_sign(SE3, convert.pose_from_dual_quaternion(b.value), a.value) < 500
        assert all(close(x, y, 1e-11) for x, y in zip(a[1:], b[1:], strict=True))


def test_the_split_is_its_parts():
    poses = SE3.normalize(keyframes(SE3))
    for whole, rotation, position in (
        ("SPLIT", "SLERP", "LERP"), ("QLB+LERP", "QLB", "LERP"), ("SPLIT CuBsp", "CuBsp", "BSpline"),
    ):  # fmt: skip
        state = interpolate(whole, poses, UNEVEN, T)
        q, p = (interpolate(n, x, UNEVEN, T) for n, x in ((rotation, poses[:, 3:]), (position, poses[:, :3])))
        for a, x, y in zip(state[:3], p, q, strict=False):
            assert close(a, torch.cat([x, y], dim=-1), 1e-12)


# ---------------------------------------------------------------------- the double cover

#: [H18] Figure 5: positions one below and one above the origin, rotations by -90 and 90 degrees about x.
HALF = math.sqrt(0.5)
FIGURE_5 = torch.tensor([[0, 0, -1, HALF, -HALF, 0, 0], [0, 0, 1, HALF, HALF, 0, 0]], dtype=float64)


def test_figure_5_lies_exactly_at_pi():
    """Both half-circles are as short. Short: the one about +x, whatever the signs; the other one by a sign on
    purpose."""
    times, t = torch.tensor([0.0, 1.0], dtype=float64), torch.linspace(0, 1, 21, dtype=float64)
    other = FIGURE_5 * torch.tensor([1, 1, 1, -1, -1, -1, -1.0])
    paths = {}
    for way in ("short", "signs"):
        for label, keys in (("as given", FIGURE_5), ("flipped", torch.stack([FIGURE_5[0], other[1]]))):
            paths[way, label] = interpolate("SE3Up", keys, times, t, way=way).value[:, :3]
    circle = torch.stack([0 * t, torch.sin(math.pi * t), -torch.cos(math.pi * t)], dim=-1)
    assert close(paths["short", "as given"], circle, 1e-14)
    assert close(paths["short", "flipped"], circle, 1e-14)
    assert close(paths["signs", "as given"], circle, 1e-14)
    assert close(paths["signs", "flipped"], circle * torch.tensor([1, -1, 1]), 1e-14)
    dual = convert.pose_to_dual_quaternion(FIGURE_5)
    state = interpolate("DLB", dual, times, t, 1)
    blended = convert.pose_from_dual_quaternion(state.value)[:, :3]
    assert close(blended.norm(dim=-1), torch.ones(21, dtype=float64), 1e-14), "the same half-circle"
    speed = state.velocity[:, 3:].norm(dim=-1)
    assert speed.argmax() == 10, "bell-shaped"
    assert close(speed, speed.flip(0), 1e-12)
    assert close(speed[10], torch.tensor(4.0, dtype=float64), 1e-12), "against pi for ScLERP"
    split = interpolate("SPLIT", FIGURE_5, times, t).value[:, :3]
    assert close(
        (paths["short", "as given"] - split).norm(dim=-1).max(), torch.tensor(1.0, dtype=float64), 1e-14
    )


@pytest.mark.parametrize("name", ["SLERP", "SPLIT", "SE3Up", "ScLERP"])
def test_the_long_way_round(name):
    """As the signs say: a rotation by 300 degrees instead of 60 back, and the translation of the same screw."""
    group = group_of(name)
    step = kit.tangents(group, [5 * math.pi / 3], each=1, seed=3)
    start = group.random(1, generator=kit.generator(1))
    keys = torch.cat([start, group.compose(start, group.exp(step))])
    times, t = torch.tensor([0.0, 2.0], dtype=float64), torch.linspace(0, 2, 9, dtype=float64)
    long = interpolate(name, keys, times, t, 2, way="signs")
    short = interpolate(name, keys, times, t, 2, way="short")
    assert close(long.velocity, step.expand(9, -1) / 2, 1e-13)
    assert close(long.value, group.compose(start, group.exp(t[:, None] / 2 * step)), 1e-13)
    assert short.velocity[0, -3:].norm() < 0.6 < long.velocity[0, -3:].norm()
    opposite = torch.cat([start, kit.rescaled(group, start, (-1.0,))])
    still = interpolate(name, opposite, times, t, 2, way="signs")
    assert close(still.velocity, torch.zeros_like(still.velocity), 1e-13)


@each_scheme
def test_short_way_ignores_signs(scheme):
    keys = keyframes(SE3)
    flipped = kit.rescaled(SE3, keys, (1.0, -1.0, -5.0, 1.0, -1.0, 1.0, 1.0))
    a, b = (interpolate(scheme, x, UNEVEN, T, 2, group=SE3) for x in (keys, flipped))
    assert kit.equal_up_to_sign(SE3, a.value, b.value) < 100
    assert all(close(x, y, 1e-11) for x, y in zip(a[1:3], b[1:3], strict=True))


def test_closed_curves_in_either_sign():
    """Keys that come back to -q: the curve closes as a motion, with two continuous derivatives."""
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=float64)
    angles = torch.linspace(0, 2 * math.pi, 7, dtype=float64)
    wobble = 0.2 * torch.sin(angles)[:, None] * torch.tensor([1.0, 0.0, 0.0], dtype=float64)
    keys = SO3.compose(SO3.exp(angles[:, None] * axis), SO3.exp(wobble))
    assert close(keys[-1], -keys[0], 1e-15)
    ends = torch.tensor([EVEN[0], EVEN[-1]])
    state = interpolate("RQBez", keys, EVEN, ends, 2, ends="periodic")
    assert all(close(x[0], x[1], 1e-12) for x in state[1:3])
    with pytest.raises(
        ValueError, match="keyframes: ends='periodic' expects the first and the last to be the same"
    ):
        interpolate("RQBez", keys[:-1], EVEN[:-1], ends[:1], ends="periodic")


# ---------------------------------------------------------------------- gradients and the module


@each_scheme
@pytest.mark.parametrize("group", [SO3, DualQuaternion], ids=str)
def test_gradients(scheme, group):
    """By keys, times of keys and queries, both modes; double backward along a line."""
    count = 3 if scheme == "bezier" else 4
    given = [
        keyframes(group, count, seed=2),
        torch.tensor([0.0, 0.8, 2.0, 2.5], dtype=float64)[:count],
        torch.tensor([0.3, 1.1], dtype=float64),
    ]
    given = [x.requires_grad_() for x in given]

    def total(keys, times, t):
        state = interpolate(scheme, keys, times, t, 2, group=group, validate=False)
        fields = torch.cat(state[:3], dim=-1)
        return (fields * normal(*fields.shape, seed=4)).sum()

    assert torch.autograd.gradcheck(total, given, check_forward_ad=True, fast_mode=True, atol=1e-5, rtol=1e-5)
    direction = [normal(*x.shape, seed=i) for i, x in enumerate(given)]

    def slope(*given):
        return torch.func.jvp(total, given, tuple(direction))[1]

    plain = [x.detach() for x in given]
    second = torch.func.jvp(slope, tuple(plain), tuple(direction))[1]
    gradients = torch.autograd.grad(total(*given), given, create_graph=True)
    along = sum((g * d).sum() for g, d in zip(gradients, direction, strict=True))
    again = torch.autograd.grad(along, given, allow_unused=True, materialize_grads=True)
    backward = sum((g * d).sum() for g, d in zip(again, direction, strict=True))
    assert abs(second - backward) < 1e-9 * (1 + abs(second))


@each_scheme
def test_still_keys_have_finite_gradients(scheme):
    for way in ("short", "signs"):
        keys = SE3.identity(4).requires_grad_()
        state = interpolate(scheme, keys, EVEN[:4], EVEN[:4], 3, group=SE3, way=way)
        (gradient,) = torch.autograd.grad(sum((x + 0.2).square().sum() for x in state), keys)
        assert torch.isfinite(gradient).all()


@each_scheme
@kit.each_dtype
def test_shapes_and_precision(scheme, dtype):
    keys = torch.stack([keyframes(SE3, seed=i) for i in range(6)]).reshape(2, 3, 7, 7).to(dtype)
    t = T[3:-3:4]
    for times, shape in (
        (t[1], (2, 3)),
        (t, (2, 3, 10)),
        (t.expand(2, 3, 10), (2, 3, 10)),
        (t.expand(3, 10), (2, 3, 10)),
    ):
        state = interpolate(scheme, keys, UNEVEN, times, 2, group=SE3)
        assert state.value.shape == (*shape, 7)
        assert state.velocity.shape == (*shape, 6)
        assert state.value.dtype == state.acceleration.dtype == dtype
    alone = interpolate(scheme, keys[1, 2].double(), UNEVEN, t, 2, group=SE3)
    for a, b in zip(interpolate(scheme, keys, UNEVEN, t, 2, group=SE3), alone, strict=False):
        if a is not None:
            assert close(a[1, 2].double(), b, 1e-13 if dtype == float64 else 2e-4)


def test_module():
    keys = keyframes(SE3)
    spline = KeyframeSpline("SE3Up", keys, UNEVEN, extrapolate="linear")
    assert isinstance(spline, Trajectory)
    assert spline.group == SE3
    assert spline.domain == (-1.0, 5.0)
    assert list(dict(spline.named_parameters())) == ["keyframes"]
    assert spline.to(torch.float32).times.dtype == float64
    spline = KeyframeSpline("cumulative_bspline", keys, UNEVEN, group=SE3)
    other = KeyframeSpline("cumulative_bspline", keyframes(SE3, seed=4), EVEN, group=SE3)
    other.load_state_dict(spline.state_dict())
    assert torch.equal(other(T), spline(T))
    assert spline.kinematics(T).acceleration.shape == (43, 3)
    assert spline.mounted(keys[0]).kinematics(T).angular_velocity.shape == (43, 3)
    leaf = keyframes(SE3).requires_grad_()
    KeyframeSpline("SpFus", leaf, UNEVEN)(T).sum().backward()
    assert leaf.grad.abs().max() > 0
    assert KeyframeSpline("rqbez", keys[:, 3:], EVEN, ends="clamped").options == {"ends": "clamped"}


def test_names():
    keys = keyframes(SE3)
    with pytest.raises(ValueError, match="method: expected one of LERP, Bezier"):
        interpolate("spline", keys, EVEN, T)
    with pytest.raises(ValueError, match="group: expected one with the plain name 'squad'"):
        interpolate("squad", keys, EVEN, T)
    with pytest.raises(ValueError, match="group: expected none or SO3 with 'SLERP'"):
        interpolate("SLERP", keys, EVEN, T, group=SE3)
    with pytest.raises(ValueError, match="ends: expected an option of 'SPLIT'"):
        interpolate("SPLIT", keys, EVEN, T, ends="natural")
    a, b = (
        interpolate("slerp", keys[:, 3:], EVEN, T),
        interpolate("geodesic", keys[:, 3:], EVEN, T, group=SO3),
    )
    assert torch.equal(a.value, b.value)


def test_general_knots_agree_with_the_scheme():
    """The cumulative scheme is the nonuniform B-spline on its keys, mirrored."""
    keys = SE3.normalize(keyframes(SE3))
    expected = nonuniform_bspline(with_phantoms(SE3, keys), T, group=SE3, knots=knots_of(UNEVEN))
    ours = interpolate("SpFus", keys, UNEVEN, T)
    assert kit.equal_up_to_sign(SE3, ours.value, expected.value) < 100
    assert all(close(a, b, 1e-12) for a, b in zip(ours[1:3], expected[1:3], strict=True))
