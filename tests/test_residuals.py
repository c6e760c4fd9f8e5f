"""Every residual: its hand-derived reverse, its compiled loop, its sizes, and its value by independent formulas."""

import itertools

import numpy as np
import pytest
import scipy.linalg
import torch
from batteries import normal, vee
from fit_cases import (
    CANDIDATES,
    PAIRS,
    accepts,
    before_the_camera,
    in_order,
    moved,
    near,
    of_slot,
    poses,
    sample,
)
from scipy.integrate import simpson
from scipy.spatial.transform import Rotation
from spline_cases import control_points

from torchspline import R3, SE3, SO3, BSpline, Group, imu, product
from torchspline.fit import RelativePose, smoothness
from torchspline.fit.kernel import ResidualKernel, kernel_of
from torchspline.fit.residuals import RESIDUALS

each_pair = pytest.mark.parametrize(("kind", "group"), PAIRS, ids=lambda x: getattr(x, "__name__", str(x)))
each_kind = pytest.mark.parametrize("kind", RESIDUALS.values(), ids=RESIDUALS)


def kernel_for(kind, group, slots, own=True):
    return ResidualKernel(kind, group.name, tuple((slot, own) for slot in slots))


def tangent_sizes(kind, group, given):
    sizes = {}
    for name, x in given.items():
        if name == "measured":
            continue
        if name.startswith("value"):
            sizes[name] = (len(x), group.tangent_size)
        elif name in kind.slots and kind.slots[name].group is not None:
            sizes[name] = (len(x), Group(kind.slots[name].group).tangent_size)
        else:
            sizes[name] = tuple(x.shape)
    return sizes


def differentiated(kernel, group, given):
    """`(N, R, ...)` Jacobian of the residual in everything, by automatic differentiation in tangent coordinates."""
    sizes = tangent_sizes(kernel.kind, group, given)

    def function(*steps):
        there = moved(kernel.kind, group, given, dict(zip(sizes, steps, strict=True)))
        return kernel.on_tensors(*in_order(kernel, there)).sum(0)

    zeros = tuple(torch.zeros(size, dtype=torch.float64) for size in sizes.values())
    jacobians = torch.autograd.functional.jacobian(function, zeros)
    return {name: J.movedim(0, 1) for name, J in zip(sizes, jacobians, strict=True)}


def linearized(kernel, given, fused=False):
    return [
        torch.from_numpy(x) for x in kernel.linearize([x.numpy() for x in in_order(kernel, given)], fused)
    ]


def check_reverse(kind, group, given, slots, tolerance=1e-12):
    kernel = kernel_for(kind, group, slots)
    residual, *cotangents = linearized(kernel, given)
    torch.testing.assert_close(residual, kernel.on_tensors(*in_order(kernel, given)), rtol=1e-13, atol=1e-12)
    expected = differentiated(kernel, group, given)
    for m, (parts, got) in enumerate(zip(kernel.parts, cotangents[: kind.moments], strict=True)):
        rates = expected[f"rates{m}"].unbind(2)
        states = [expected[f"value{m}"], *rates]
        used = [J for J, part in zip(states, parts, strict=False) if part]
        unused = [J for J, part in zip(states, (*parts, *[False] * len(states)), strict=False) if not part]
        assert all(not J.any() for J in unused)
        want = torch.cat(used, dim=-1)
        assert (got - want).abs().max() <= tolerance * want.abs().max().clamp_min(1.0)
    for slot, got in zip(kernel.order, cotangents[kind.moments :], strict=True):
        want = expected[slot]
        turning = group.name != "R3"  # without rotation a lever arm moves nothing
        assert want.any() or not turning, f"the residual does not depend on {slot}"
        assert (got - want).abs().max() <= tolerance * want.abs().max().clamp_min(1.0), slot


# ---------------------------------------------------------------------- the reverse and the kernels


@each_pair
def test_the_reverse_is_the_derivative(kind, group):
    check_reverse(kind, group, sample(kind, group), kind.slots)


@each_pair
def test_arguments_that_are_not_given_take_their_defaults(kind, group):
    given = sample(kind, group, seed=5)
    needed = [slot for slot, (_, _, default) in kind.slots.items() if default is None]
    short, full = kernel_for(kind, group, needed), kernel_for(kind, group, kind.slots)
    for slot, (_, _, default) in kind.slots.items():
        if default is not None:
            given[slot] = torch.tensor(default, dtype=torch.float64).expand(len(given["measured"]), -1)
    results = [kernel.on_tensors(*in_order(kernel, given)) for kernel in (short, full)]
    torch.testing.assert_close(*results, rtol=1e-12, atol=1e-12)
    check_reverse(kind, group, {k: x for k, x in given.items() if k in needed or k not in kind.slots}, needed)


@each_pair
def test_one_argument_for_all_measurements(kind, group):
    given = sample(kind, group, seed=7)
    slots = [slot for slot in kind.slots if slot != "landmark"]  # of one landmark only one camera is in front
    kernel = kernel_for(kind, group, kind.slots)
    shared = ResidualKernel(kind, group.name, tuple((slot, slot not in slots) for slot in kind.slots))
    one = {slot: given[slot][:1].expand_as(given[slot]) for slot in slots}
    if "intrinsics" in slots:
        one["landmark"] = before_the_camera(poses(group, given["value0"]), one["T_body_camera"])
    expected = linearized(kernel, {**given, **one})
    alone = {slot: x[0] for slot, x in one.items() if slot in slots}
    got = linearized(shared, {**given, **one, **alone})
    slot_results = dict(zip(kernel.order, expected[1 + kind.moments :], strict=True))
    expected[1 + kind.moments :] = [slot_results[slot] for slot in shared.order]
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-12)


@each_kind
@pytest.mark.slow
def test_the_compiled_loop_is_the_reference(kind):
    group = next(g for g in CANDIDATES if accepts(kind, g))
    given = sample(kind, group, count=70, seed=3)  # two blocks and a rest
    kernel = kernel_for(kind, group, kind.slots)
    fused = linearized(kernel, given, fused=True)
    for a, b in zip(fused, linearized(kernel, given), strict=True):
        assert torch.isfinite(a).all()
        assert (a - b).abs().max() <= 1e-13 * b.abs().max().clamp_min(1.0)


@each_pair
def test_sizes_are_as_declared(kind, group):
    rows, measured_size = kind.sizes(group.arithmetic)
    given = sample(kind, group)
    kernel = kernel_for(kind, group, kind.slots)
    residual, *cotangents = linearized(kernel, given)
    assert residual.shape == (6, rows)
    assert given["measured"].shape == (6, measured_size)
    wanted = [group.tangent_size * sum(parts) for parts in kernel.parts]
    wanted += [kernel._cotangent_size(slot) for slot in kernel.order]
    assert [x.shape[-1] for x in cotangents] == wanted
    if kind.rows is not None:
        assert (rows, measured_size) == (kind.rows, kind.measured_size)


@each_kind
def test_a_kernel_exists_once(kind):
    group = next(g for g in CANDIDATES if accepts(kind, g)).name
    given = tuple((slot, False) for slot in kind.slots)
    assert kernel_of(kind, group, given) is kernel_of(kind, group, given)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 3.0, np.pi - 1e-4])
@pytest.mark.parametrize("name", ["Orientation", "Pose", "RelativePose", "StateValue"])
def test_reverse_of_rotation_errors_of_every_size(name, angle):
    kind, given = RESIDUALS[name], sample(RESIDUALS[name], SE3, seed=11)
    T = SE3.normalize(given["T_body_sensor"]) if "T_body_sensor" in kind.slots else SE3.identity(6)
    if name == "Orientation":
        seen = SO3.compose(given["value0"][:, 3:], SO3.normalize(given["rotation"]))
        given["measured"] = SO3.compose(seen, SO3.exp(near(SO3, angle, 6, seed=2)))
    else:
        seen = SE3.compose(given["value0"], T)
        if name == "RelativePose":
            seen = SE3.between(seen, SE3.compose(given["value1"], T))
        given["measured"] = SE3.compose(seen, SE3.exp(near(SE3, angle, 6, seed=2)))
    check_reverse(kind, SE3, given, kind.slots, tolerance=1e-10)
    residual = kernel_for(kind, SE3, kind.slots).on_tensors(
        *in_order(kernel_for(kind, SE3, kind.slots), given)
    )
    turned = residual[:, -3:].norm(dim=-1)
    torch.testing.assert_close(turned, torch.full_like(turned, angle), rtol=1e-9, atol=1e-13)


# ---------------------------------------------------------------------- known values


def matrix(pose):
    """Homogeneous matrices (N, 4, 4) by SciPy."""
    pose = pose.detach().numpy()
    result = np.tile(np.eye(4), (len(pose), 1, 1))
    result[:, :3, :3] = Rotation.from_quat(pose[:, [4, 5, 6, 3]]).as_matrix()
    result[:, :3, 3] = pose[:, :3]
    return result


def rotation_matrix(q):
    return Rotation.from_quat(q.numpy()[..., [1, 2, 3, 0]]).as_matrix()


def rotation_between(a, b):
    """Rotation vectors of a^-1 b."""
    return Rotation.from_matrix(np.swapaxes(a, -1, -2) @ b).as_rotvec()


def columns(matrices, vectors):
    return np.einsum("...ij,...j->...i", matrices, np.asarray(vectors))


class World:
    """A trajectory, times, and one value for each argument, from which predictions are made by other means."""

    def __init__(self, kind, group):
        self.kind, self.group = kind, group
        points = control_points(group, 9, gap=0.5, seed=3)
        self.spline = BSpline(points, group=group, order=4, dt=0.3)
        low, high = self.spline.domain
        self.t = low + (high - low) * torch.tensor([[0.07, 0.3, 0.51, 0.8], [0.9, 0.33, 0.02, 0.81]]).double()
        with torch.no_grad():
            self.states = [self.spline.evaluate(t, derivatives=3) for t in self.t[: kind.moments]]
        self.slots = {slot: of_slot(kind, slot, 1, seed=40)[0] for slot in kind.slots}
        for slot, (_, slot_group, _) in kind.slots.items():
            if slot_group is not None:
                self.slots[slot] = Group(slot_group).normalize(self.slots[slot])
        self.measured = sample(kind, group, count=4, seed=9)["measured"]
        if "intrinsics" in kind.slots:
            self.slots["landmark"] = before_the_camera(self.pose[:1], self.slots["T_body_camera"])[0]

    @property
    def pose(self):
        return poses(self.group, self.states[0].value)

    def numpy(self, slot):
        return self.slots[slot].numpy()

    def mounted(self, T):
        with torch.no_grad():
            return self.spline.mounted(T).kinematics(self.t[0])

    def at(self, rotation=None, arm=None):
        """Motion of a frame attached to the body; a body without rotation is one that stays upright."""
        q = SO3.identity() if rotation is None else self.slots[rotation]
        p = torch.zeros(3, dtype=torch.float64) if arm is None else self.slots[arm]
        if self.group.name == "R3":
            with torch.no_grad():
                still = self.spline.kinematics(self.t[0])
            return still._replace(position=still.position + p)
        return self.mounted(torch.cat([p, q]))

    def sensor(self, i=0, slot="T_body_sensor"):
        """Matrices of the sensor's pose."""
        return matrix(poses(self.group, self.states[i].value)) @ matrix(self.slots[slot][None])

    def residual(self):
        kernel = kernel_for(self.kind, self.group, self.kind.slots, own=False)
        given = {"measured": self.measured, **self.slots}
        for m, state in enumerate(self.states):
            given[f"value{m}"] = state.value
            rates = [state.velocity, state.acceleration, state.jerk][: self.kind.derivatives]
            given[f"rates{m}"] = torch.stack(rates, dim=1) if rates else torch.zeros(4, 0, 1)
        return kernel.on_tensors(*in_order(kernel, given)).numpy()


def triad(world, x):
    return columns(world.numpy("scaling").reshape(3, 3), x) + world.numpy("bias")


def imu_reading(world, arm):
    T = torch.cat([world.slots[arm] if arm else torch.zeros(3).double(), world.slots["rotation"]])
    gravity = world.slots.get("gravity", (0.0, 0.0, -9.80665))
    with torch.no_grad():
        return imu.measure(world.spline, world.t[0], gravity=gravity, T_body_imu=T)


def gyroscope(world):
    if world.group.name == "SO3":
        return triad(world, world.at("rotation").angular_velocity)
    return triad(world, imu_reading(world, None).gyroscope)


def seen_point(world, slot="T_body_sensor"):
    landmark = np.append(world.numpy("landmark"), 1.0)
    return columns(np.linalg.inv(world.sensor(0, slot)), landmark)[:, :3]


def pinhole(world, distort):
    x, y, z = seen_point(world, "T_body_camera").T
    fx, fy, cx, cy, *k = world.numpy("intrinsics")
    u, v = distort(x, y, z, *k)
    return np.stack([fx * u + cx, fy * v + cy], axis=-1)


def radtan(x, y, z, k1, k2, p1, p2):
    """OpenCV, calib3d, "detailed description"."""
    x, y = x / z, y / z
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    )


def equidistant(x, y, z, k1, k2, k3, k4):
    """OpenCV, fisheye, with the angle by atan2."""
    r = np.hypot(x, y)
    angle = np.arctan2(r, z)
    distorted = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    return distorted * x / r, distorted * y / r


def pose_error(got, measured):
    measured = matrix(measured)
    turn = rotation_between(measured[:, :3, :3], got[:, :3, :3])
    return np.concatenate([got[:, :3, 3] - measured[:, :3, 3], turn], axis=-1)


def value_error(world):
    """The matrix logarithm of X Y^-1."""
    group = world.group
    X = group.to_matrix(world.states[0].value).detach()
    Y = group.to_matrix(group.normalize(world.measured))
    between = X @ torch.linalg.inv(Y)
    logs = np.stack([np.real(scipy.linalg.logm(m)) for m in between.numpy()])
    return vee(group, torch.from_numpy(logs)).numpy()


#: The whole residual of each kind, by other means than the library's residuals: matrices of NumPy and SciPy, and
#: trajectories seen from a mounted frame.
KNOWN = {
    "Accelerometer": lambda w: triad(w, imu_reading(w, "lever_arm").accelerometer) - w.measured.numpy(),
    "AngularAcceleration": lambda w: triad(w, w.at("rotation").angular_acceleration) - w.measured.numpy(),
    "BodyVelocity": lambda w: columns(
        np.swapaxes(rotation_matrix(w.at("rotation", "lever_arm").rotation), -1, -2),
        w.at("rotation", "lever_arm").velocity,
    ) - w.measured.numpy(),
    "Direction": lambda w: triad(
        w, columns(np.swapaxes(rotation_matrix(w.at("rotation").rotation), -1, -2), w.numpy("direction"))
    ) - w.measured.numpy(),
    "Gyroscope": lambda w: gyroscope(w) - w.measured.numpy(),
    "Orientation": lambda w: rotation_between(
        rotation_matrix(w.measured), rotation_matrix(w.at("rotation").rotation)
    ),
    "Point": lambda w: seen_point(w) - w.measured.numpy(),
    "Pose": lambda w: pose_error(w.sensor(), w.measured),
    "Position": lambda w: (w.at(None, "lever_arm").position - w.measured).numpy(),
    "RelativePose": lambda w: pose_error(np.linalg.inv(w.sensor(0)) @ w.sensor(1), w.measured),
    "ReprojectionEquidistant": lambda w: pinhole(w, equidistant) - w.measured.numpy(),
    "ReprojectionRadtan": lambda w: pinhole(w, radtan) - w.measured.numpy(),
    "StateAcceleration": lambda w: (w.states[0].acceleration - w.measured).numpy(),
    "StateJerk": lambda w: (w.states[0].jerk - w.measured).numpy(),
    "StateValue": value_error,
    "StateVelocity": lambda w: (w.states[0].velocity - w.measured).numpy(),
    "WorldVelocity": lambda w: (w.at(None, "lever_arm").velocity - w.measured).numpy(),
}  # fmt: skip


def test_every_residual_has_a_known_value():
    assert set(KNOWN) == set(RESIDUALS)


@each_pair
def test_known_values(kind, group):
    world = World(kind, group)
    if "intrinsics" in kind.slots:  # of the one landmark at least the first camera is in front
        visible = seen_point(world, "T_body_camera")[:, 2] > 0.1
        assert visible[0]
    else:
        visible = np.ones(4, bool)
    expected, got = KNOWN[kind.__name__](world), world.residual()
    assert np.abs(expected - got)[visible].max() <= 1e-9 * max(np.abs(expected[visible]).max(), 1.0)


# ---------------------------------------------------------------------- cameras


def camera(name, seen, intrinsics):
    """Residual and cotangents of points given in the frame of the camera."""
    kind = RESIDUALS[name]
    given = {
        "value0": SE3.identity(len(seen)),
        "rates0": torch.zeros(len(seen), 0, 6),
        "measured": torch.zeros(len(seen), 2, dtype=torch.float64),
        "landmark": seen,
        "intrinsics": intrinsics.expand(len(seen), 8),
        "T_body_camera": SE3.identity(len(seen)),
    }
    return given, linearized(kernel_for(kind, SE3, kind.slots), given)


CAMERA = torch.tensor([400.0, 410.0, 320.0, 240.0, -0.05, 0.02, 0.003, -0.002], dtype=torch.float64)
REPROJECTIONS = ["ReprojectionEquidistant", "ReprojectionRadtan"]


@pytest.mark.parametrize("name", REPROJECTIONS)
def test_landmarks_behind_the_camera_take_no_part(name):
    behind = torch.tensor(
        [[0.01, 0.02, -1.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1e-30]], dtype=torch.float64
    )
    if name == "ReprojectionRadtan":
        extra = torch.tensor([[1.0, 0, 0], [1.0, 2, -1e-9], [3.0, 0, 1e-9], [1.0, 1, -1]]).double()
        behind = torch.cat([behind, extra])
    for x in camera(name, behind, CAMERA)[1]:
        assert not x.any()
    given, _ = camera(name, behind, CAMERA)
    assert all(
        not J.any()
        for J in differentiated(kernel_for(RESIDUALS[name], SE3, RESIDUALS[name].slots), SE3, given).values()
    )
    mixed = torch.cat([behind, torch.tensor([[0.1, 0.2, 1.0]]).double()])
    given, (residual, *cotangents) = camera(name, mixed, CAMERA)
    assert residual[-1].abs().min() > 1.0
    assert all(x[-1].any() for x in cotangents)
    check_reverse(RESIDUALS[name], SE3, given, RESIDUALS[name].slots)


@pytest.mark.parametrize("name", REPROJECTIONS)
@pytest.mark.parametrize("aside", [0.0, 1e-300, 1e-160, 1e-20, 1e-8, 1e-4])
def test_landmarks_on_the_optical_axis(name, aside):
    seen = torch.tensor([[aside, -2 * aside, 0.5], [0.0, aside, 4.0]], dtype=torch.float64)
    given, (residual, *_) = camera(name, seen, CAMERA)
    torch.testing.assert_close(residual, CAMERA[2:4].expand(2, 2), rtol=1e-3, atol=0.0)
    check = kernel_for(RESIDUALS[name], SE3, RESIDUALS[name].slots)
    _, moment, *slots = linearized(check, given)
    expected = differentiated(check, SE3, given)
    for got, want in zip(
        (moment, *slots), (expected["value0"], *(expected[s] for s in check.order)), strict=True
    ):
        assert (got - want).abs().max() <= 1e-12 * want.abs().max().clamp_min(1.0)


def test_a_fisheye_sees_beyond_ninety_degrees():
    angles = torch.linspace(0.02, 2.9, 40, dtype=torch.float64)
    seen = 3.0 * torch.stack([0.6 * angles.sin(), -0.8 * angles.sin(), angles.cos()], dim=-1)
    given, (residual, *_) = camera("ReprojectionEquidistant", seen, CAMERA)
    u, v = equidistant(*seen.numpy().T, *CAMERA[4:].numpy())
    expected = np.stack([400.0 * u + 320.0, 410.0 * v + 240.0], axis=-1)
    np.testing.assert_allclose(residual.numpy(), expected, rtol=1e-12)
    check_reverse(
        RESIDUALS["ReprojectionEquidistant"], SE3, given, ["landmark", "intrinsics", "T_body_camera"]
    )


# ---------------------------------------------------------------------- relative poses and smoothness


def test_a_relative_pose_does_not_depend_on_the_world():
    kind = RelativePose
    given = sample(kind, SE3)
    kernel = kernel_for(kind, SE3, kind.slots)
    shift = SE3.random(generator=torch.Generator().manual_seed(4))
    there = {**given, **{name: SE3.compose(shift, given[name]) for name in ("value0", "value1")}}
    results = [kernel.on_tensors(*in_order(kernel, x)) for x in (given, there)]
    torch.testing.assert_close(*results, rtol=1e-12, atol=1e-12)


def integral(spline, derivative):
    """Of the squared derivative's components, by Simpson's rule."""
    total = 0.0
    low, high = spline.domain
    unit = 1e-9 if spline.dt_ns is not None else 1.0
    knots = np.linspace(low, high, spline.control_points.shape[0] - spline.order + 2)
    for a, b in itertools.pairwise(knots):
        inside = np.linspace(a, b, 201)
        t = torch.from_numpy(np.clip(inside, a + 1e-9 * (b - a), b - 1e-9 * (b - a)))
        t = t.round().to(torch.int64) if spline.dt_ns is not None else t
        with torch.no_grad():
            rate = spline.evaluate(t, derivatives=3)[derivative].numpy()
        total = total + simpson(rate**2, x=inside * unit, axis=0)
    return total


def cost(spline, residual):
    with torch.no_grad():
        state = spline.evaluate(residual.t, derivatives=3)[type(residual).derivatives]
    return float(0.5 * (((state - residual.measured) / residual.weighting[1]) ** 2).sum())


@pytest.mark.parametrize("order", [2, 3, 4, 6])
@pytest.mark.parametrize("derivative", [1, 2, 3])
def test_smoothness_is_the_integral_in_vector_spaces(order, derivative):
    if derivative >= order:
        with pytest.raises(ValueError, match=f"derivative: expected at most {order - 1}.*got {derivative}"):
            smoothness(
                BSpline(normal(9, 3, seed=1), group=R3, order=order, dt=0.3), derivative=derivative, sigma=1.0
            )
        return
    spline = BSpline(normal(9, 3, seed=1), group=R3, order=order, dt=0.3, t0=2.0)
    sigma = torch.tensor([0.5, 1.0, 3.0], dtype=torch.float64)
    expected = 0.5 * (integral(spline, derivative) / sigma.numpy() ** 2).sum()
    assert cost(spline, smoothness(spline, derivative=derivative, sigma=sigma)) == pytest.approx(
        expected, rel=1e-6
    )
    more = smoothness(spline, derivative=derivative, sigma=sigma, nodes=6)
    assert cost(spline, more) == pytest.approx(
        cost(spline, smoothness(spline, derivative=derivative, sigma=sigma)), rel=1e-12
    )


def test_smoothness_of_motions_and_in_nanoseconds():
    points = control_points(SE3, 10, gap=0.4, seed=2)
    for options in ({"dt": 0.25, "t0": 1e9}, {"dt_ns": 250_000_000, "t0_ns": 1_600_000_000_000_000_000}):
        spline = BSpline(points, group=SE3, order=5, **options)
        expected = 0.5 * (integral(spline, 2) / 0.3**2).sum()
        residual = smoothness(spline, sigma=0.3, nodes=5)
        assert cost(spline, residual) == pytest.approx(expected, rel=1e-4)
        assert residual.name == "smoothness"


def test_groups_that_make_no_sense_are_refused():
    for kind in RESIDUALS.values():
        for group in (Group("R2"), Group("R3"), SO3, SE3, product(R3, SO3)):
            if accepts(kind, group):
                continue
            with pytest.raises(
                ValueError, match=rf"{kind.__name__}: expected a trajectory in .*, got {group}"
            ):
                kind.check_group(group)
