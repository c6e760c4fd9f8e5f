"""The values of residuals, by matrices of NumPy and SciPy and by trajectories seen from a mounted frame."""

import itertools

import numpy as np
import pytest
import scipy.linalg
import torch
from batteries import normal, vee
from fit_cases import before_the_camera, each_pair, equidistant, in_order, kernel_for, of_slot, poses, sample
from scipy.integrate import simpson
from scipy.spatial.transform import Rotation
from spline_cases import control_points

from torchspline import R3, SE3, SO3, BSpline, Group, imu
from torchspline.fit import smoothness
from torchspline.fit.residuals import RESIDUALS

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


# ---------------------------------------------------------------------- smoothness


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
