"""From one family to another: exact where it can be, within the tolerance elsewhere, and the error as it is."""

import math

import numpy as np
import pytest
import scipy.interpolate
import torch
from batteries import generator, normal

from torchspline import (
    R3,
    SE2,
    SE3,
    SO3,
    BSpline,
    DualQuaternion,
    HermiteSpline,
    KeyframeSpline,
    NonuniformBSpline,
    SplitBSpline,
    State,
    Trajectory,
    product,
)
from torchspline.fit import Problem, StateValue, approximate, compare
from torchspline.groups import convert

float64 = torch.float64
SPLIT = product(R3, SO3)
UNEVEN = torch.tensor([0.0, 0.5, 0.8, 1.5, 2.0, 2.4], dtype=float64)


def walk(group, count, step=0.4, seed=0):
    points = [group.random(generator=generator(seed))]
    for v in step * normal(count - 1, group.tangent_size, seed=seed):
        points.append(group.compose(points[-1], group.exp(v)))
    return torch.stack(points)


def uniform(group, order=4, count=12, step=0.4, **clock):
    return BSpline(walk(group, count, step), group=group, order=order, **(clock or {"dt": 0.2, "t0": -0.3}))


def uneven(group, order=4):
    steps = 0.1 + torch.rand(11 + order, generator=generator(2), dtype=float64)
    knots = torch.cat([steps.new_tensor([-3.0]), steps]).cumsum(0)[: 9 + order]
    knots[order + 2] = knots[order + 1]
    return NonuniformBSpline(walk(group, 9), group=group, knots=knots, order=order)


def hermite(group):
    rates = normal(2, 6, group.tangent_size, seed=3)
    return HermiteSpline(walk(group, 6), rates[0], rates[1], group=group, times=UNEVEN)


def keyed(method, group=SE3, step=0.4):
    return KeyframeSpline(method, walk(group, 6, step), UNEVEN)


def matrices(spline, t):
    """4 x 4 of poses, whatever the group, so that groups can be compared; points of R^n as they are."""
    value = spline(t).detach()
    if spline.group == SPLIT:
        return SE3.to_matrix(value)
    return value if spline.group == R3 else spline.group.to_matrix(value)


def random_times(spline, count=200):
    start, end = spline.domain
    if isinstance(start, int):
        return torch.randint(start, end, (count,), generator=generator(5))
    return start + (end - start) * torch.rand(count, generator=generator(5), dtype=float64)


def gaps(a, b, t):
    """Largest angle and distance of 4 x 4 matrices, by their traces and columns: not as `compare` has it."""
    A, B = matrices(a, t), matrices(b, t)
    if a.group == R3:
        return 0.0, float((A - B).norm(dim=-1).max())
    if a.group == SO3:
        A, B = (torch.nn.functional.pad(M, (0, 1, 0, 1)) for M in (A, B))
    turn = (A[..., :3, :3] - B[..., :3, :3]).norm(dim=(-1, -2)) / math.sqrt(8.0)
    return float((2.0 * torch.asin(turn.clamp_max(1.0))).max()), float((A - B)[..., :3, 3].norm(dim=-1).max())


# ---------------------------------------------------------------------- how far apart


def test_compare_half_circle():
    """[H18] Figure 5: SE3Up leaves the straight line of SPLIT by the radius, at the same rotation."""
    poses = torch.tensor([[0.0, 0, -1, 1, -1, 0, 0], [0.0, 0, 1, 1, 1, 0, 0]], dtype=float64)
    times = torch.tensor([0.0, 1.0], dtype=float64)
    found = compare(
        KeyframeSpline("SE3Up", poses, times), KeyframeSpline("SPLIT", poses, times), samples=1000
    )
    u = torch.linspace(0, 1, 1001, dtype=float64)
    apart = torch.stack([torch.sin(math.pi * u), 1 - 2 * u - torch.cos(math.pi * u)]).norm(dim=0)
    assert found.rotation_max < 1e-14
    assert abs(found.position_max - 1.0) < 1e-12
    assert abs(found.position_rms - float(apart.square().mean().sqrt())) < 1e-12


def test_compare_turns_and_batches():
    """Two steady turns drift apart linearly; of a batch the worst counts."""
    times, angles = torch.tensor([0.0, 2.0], dtype=float64), torch.tensor([0.6, 1.0], dtype=float64)
    keys = SO3.exp(torch.stack([torch.zeros(2, 3), angles[:, None] * torch.eye(3)[:2]], dim=1).to(float64))
    still = KeyframeSpline("SLERP", SO3.identity(2), times)
    found = compare(KeyframeSpline("SLERP", keys, times), still, samples=4)
    assert found.position_max is None
    assert found.rotation_max == pytest.approx(1.0, abs=1e-14)
    share = torch.arange(5, dtype=float64) / 4
    assert found.rotation_rms == pytest.approx(
        float((share[:, None] * angles).square().mean().sqrt()), abs=1e-14
    )
    plane = BSpline(walk(SE2, 5), group=SE2, dt=1.0)
    moved = BSpline(plane.control_points.detach() + torch.tensor([0.3, 0.4, 0, 0]), group=SE2, dt=1.0)
    apart = compare(plane, moved)
    assert apart.position_max > 0.4
    assert apart.rotation_max < 1e-12


# ---------------------------------------------------------------------- exact


EXACT = {
    "BSpline to NonuniformBSpline": (uniform(SE3, 5), NonuniformBSpline, {}),
    "and back": (approximate(uniform(SO3), family=NonuniformBSpline).trajectory, BSpline, {}),
    "BSpline to SplitBSpline": (uniform(SPLIT, 6), SplitBSpline, {}),
    "SE3 to DualQuaternion": (uniform(SE3), NonuniformBSpline, {"group": DualQuaternion}),
    "SE3 Hermite to DualQuaternion": (hermite(SE3), HermiteSpline, {"group": DualQuaternion, "coordinates": "product"}),
    "SpFus to ScFus": (keyed("SpFus"), KeyframeSpline, {"method": "ScFus"}),
    "SpFus": (keyed("SpFus"), NonuniformBSpline, {}),
    "CuBsp": (keyed("CuBsp", SO3), NonuniformBSpline, {"tolerance": 0.1}),
    "SPLIT CuBsp": (keyed("SPLIT CuBsp", SPLIT), NonuniformBSpline, {"order": 4}),
    "SE3Up": (keyed("SE3Up"), NonuniformBSpline, {}),
    "SLERP": (keyed("SLERP", SO3), NonuniformBSpline, {"order": 2}),
    "order 2 to ScLERP": (uniform(SE3, 2), KeyframeSpline, {"method": "ScLERP"}),
    "mounted": (uniform(SE3).mounted(walk(SE3, 1, seed=4)[0]), BSpline, {}),
    "mounted rotation": (uniform(SO3).mounted(walk(SE3, 1, seed=4)[0]), NonuniformBSpline, {}),
    "R3, finer": (uniform(R3), BSpline, {"knots": 27}),
    "R3, raised": (uniform(R3), NonuniformBSpline, {"order": 5}),
    "R3, raised twice, uneven": (uneven(R3, 3), NonuniformBSpline, {"order": 5, "tolerance": 1.0}),
    "R3, to Hermite": (uniform(R3, 6), HermiteSpline, {}),
    "R3, from Hermite": (hermite(R3), NonuniformBSpline, {}),
    "R3, from Hermite, order 7": (hermite(R3), NonuniformBSpline, {"order": 7}),
    "R3, LERP": (keyed("LERP", R3), NonuniformBSpline, {"order": 4}),
    "R3, CompositeBezier": (keyed("CompositeBezier", R3), NonuniformBSpline, {}),
    "R3, Bezier": (keyed("Bezier", R3), BSpline, {"order": 6}),
    "R3, squad": (KeyframeSpline("squad", walk(R3, 6), UNEVEN, group=R3), NonuniformBSpline, {}),
}  # fmt: skip


@pytest.mark.parametrize("name", EXACT)
def test_exact(name):
    source, family, options = EXACT[name]
    found = approximate(source, family=family, **options)
    assert found.exact
    assert type(found.trajectory) is family
    assert max(gaps(found.trajectory, source, random_times(source))) < 1e-12
    assert max(x for x in found.error if x is not None) < 1e-12
    assert all(p.requires_grad and p.is_leaf for p in found.trajectory.parameters())


def test_not_exact():
    """Where degree, smoothness, knots or the group do not allow it."""
    for source, family, options in (
        (uniform(R3), BSpline, {"knots": 10}),
        (uniform(R3), BSpline, {"order": 5, "knots": 9}),
        (uniform(R3, 3), HermiteSpline, {}),
        (hermite(R3), NonuniformBSpline, {"order": 5}),
        (uniform(SO3), NonuniformBSpline, {"order": 5}),
        (uneven(SO3), BSpline, {"order": 4}),
        (uniform(SE3), SplitBSpline, {}),
        (uniform(SO3), HermiteSpline, {}),
    ):
        found = approximate(source, family=family, **options)
        assert not found.exact
        # Not by a hair: what is measured from outside says so, too.
        turn, shift = gaps(found.trajectory, source, random_times(source))
        assert max(turn, shift) > 1e-6
        for measured, told in ((turn, found.error.rotation_max), (shift, found.error.position_max)):
            assert told is None or measured < 1.2 * told + 1e-14


@pytest.mark.parametrize(("order", "step"), [(4, 0.4), (5, 0.5), (6, 0.3)])
def test_rotations_of_poses_are_met_by_split_splines_to_rounding(order, step):
    """They are B-splines in SO3 in both: positions, which are none, do not hide what is left of them."""
    source = uniform(SE3, order, step=step)
    found = approximate(source, family=SplitBSpline)
    assert found.error.rotation_max < 1e-13
    assert found.error.position_max > 1e-4
    # Control points of the rotations are those of the poses.
    turned = SO3.log(SO3.between(source.control_points[:, 3:], found.trajectory.control_points[:, 3:]))
    assert turned[2:-2].abs().max() < 1e-9
    # Positions are as near as any spline over these knots comes, in the mean: least squares by dense algebra.
    t = torch.linspace(*source.domain, 4001, dtype=float64)
    k, M = order, len(source.control_points)
    knots = source.domain[0] + (torch.arange(M + k) - (k - 1)) * 0.2
    design = scipy.interpolate.BSpline.design_matrix(t, knots, k - 1, extrapolate=True).toarray()
    goal = source(t)[:, :3].detach().numpy()
    best = goal - design @ np.linalg.lstsq(design, goal, rcond=None)[0]
    ours = (source(t) - found.trajectory(t))[:, :3].detach().numpy()
    assert np.square(ours).mean() < 1.001 * np.square(best).mean()


# ---------------------------------------------------------------------- within a tolerance


class Helix(Trajectory):
    """A motion that is no spline and belongs to no family."""

    group = SE3

    @property
    def domain(self):
        return (0.0, 3.0)

    def evaluate(self, t, derivatives=2):
        w = torch.tensor([0.4, 0.0, 0.1, 0.0, 0.3, 1.1], dtype=t.dtype)
        value = SE3.compose(SE3.exp(t[..., None] * w), SE3.exp(torch.sin(2 * t)[..., None] * w.flip(0)))
        return State(value, torch.zeros_like(value[..., :6]), torch.zeros_like(value[..., :6]))


WITHIN = {
    "SE3 to split": (uniform(SE3, 5), SplitBSpline, {"order": 4}),
    "split to SE3": (uniform(SPLIT, 5), BSpline, {"group": SE3, "order": 6}),
    "SE3 to Hermite": (uniform(SE3, 5), HermiteSpline, {}),
    "SE3 to Hermite, split": (uniform(SE3, 5), HermiteSpline, {"group": SPLIT, "coordinates": "product"}),
    "split to Hermite, dual": (uniform(SPLIT, 5), HermiteSpline, {"group": DualQuaternion}),
    "Hermite to knots": (hermite(SE3), NonuniformBSpline, {"order": 4}),
    "SLERP to cubic": (keyed("SLERP", SO3), NonuniformBSpline, {"order": 4}),
    "uneven to uniform": (uneven(SO3, 6), BSpline, {"order": 4}),
    "unknown": (Helix(), NonuniformBSpline, {"order": 6}),
    "mounted split": (uniform(SPLIT).mounted(walk(SE3, 1)[0]), SplitBSpline, {"order": 5}),
    "SQUAD": (uniform(SO3, 5), KeyframeSpline, {"method": "SQUAD"}),
    "RQBez": (uniform(SO3, 5), KeyframeSpline, {"method": "RQBez"}),
    "DLB": (uniform(SE3, 5), KeyframeSpline, {"method": "DLB"}),
    "SPLIT": (uniform(SE3, 5), KeyframeSpline, {"method": "SPLIT"}),
    "SpFus": (uniform(SE3, 5), KeyframeSpline, {"method": "SpFus"}),
    "DLFus": (uniform(SE3, 5), KeyframeSpline, {"method": "DLFus"}),
}


@pytest.mark.parametrize("name", WITHIN)
def test_tolerance_is_kept(name):
    source, family, options = WITHIN[name]
    limits = (2e-3, 1e-3)
    found = approximate(source, family=family, tolerance=limits, **options)
    assert type(found.trajectory) is family
    turn, shift = gaps(found.trajectory, source, random_times(source))
    # Random times fall between those of the grid.
    assert turn < 1.2 * limits[1]
    assert shift < 1.2 * limits[0]
    assert found.error.position_max is None or found.error.position_max <= limits[0]
    assert found.error.rotation_max <= limits[1]
    again = compare(found.trajectory, source)
    assert again == found.error


def test_error_falls_with_the_order():
    """Halving the pieces divides the error by 2^order on R^n; by 8 at most where factors do not commute: no control
    points do better, see the next test."""
    for order, group, expected in ((5, SPLIT, 5.0), (3, SE3, 3.0), (5, SE3, 3.1)):
        errors = [
            approximate(Helix(), family=BSpline, group=group, order=order, knots=n).error.position_max
            for n in (32, 64)
        ]
        measured = math.log2(errors[0] / errors[1])
        assert abs(measured - expected) < 0.3, (order, measured)


def test_fit_against_least_squares():
    """Levenberg-Marquardt on the very distances finds nothing better, neither well resolved nor coarse."""
    for order, knots in ((4, 16), (6, 6)):
        found = approximate(Helix(), family=BSpline, order=order, knots=knots)
        t = torch.linspace(0.0, 3.0, 20 * knots + 1, dtype=float64)
        other = BSpline(found.trajectory.control_points.detach(), group=SE3, order=order, dt=3.0 / knots)
        problem = Problem(other)
        problem.add(StateValue(t, Helix()(t), sigma=1.0))
        problem.solve()
        best = compare(other, Helix())
        assert found.error.rotation_rms < 1.05 * best.rotation_rms
        assert found.error.position_rms < 1.05 * best.position_rms


def test_knots_go_where_the_motion_is():
    """A jolt at t = 4: few knots elsewhere, fewer in all than equal ones; given knots stay."""
    points = torch.zeros(54, 3, dtype=float64)
    points[40:44] = torch.tensor([[0.2, 0, 0], [-0.5, 0.3, 0], [0.4, 0, 0.2], [-0.1, 0, 0]], dtype=float64)
    source = BSpline(SO3.exp(points), group=SO3, dt=0.1)
    local = approximate(source, family=NonuniformBSpline, order=5, tolerance=1e-3).trajectory
    equal = approximate(source, family=BSpline, order=5, tolerance=1e-3).trajectory
    assert local.control_points.shape[0] < 0.6 * equal.control_points.shape[0]
    inner = local.knots[5:-5]
    near = (inner - 4.0).abs() < 1.0
    assert near.sum() > 0.6 * len(inner)
    given = torch.tensor([0.0, 1.13, 2.21, 5.1], dtype=float64)
    kept = approximate(source, family=NonuniformBSpline, order=5, tolerance=1e-3, knots=given).trajectory
    assert set(given.tolist()) <= set(kept.knots.tolist())
    only = approximate(source, family=NonuniformBSpline, order=5, knots=given)
    assert torch.equal(only.trajectory.knots[4:-4], given)
    assert only.error.rotation_max > 0.05


def test_coupling_in_one_call():
    """Joint keys read as split ones at the same times: on [H18] Figure 5 the radius of its half-circle."""
    poses = torch.tensor([[0.0, 0, -1, 1, -1, 0, 0], [0.0, 0, 1, 1, 1, 0, 0]], dtype=float64)
    joint = KeyframeSpline("SE3Up", poses, torch.tensor([0.0, 1.0], dtype=float64))
    found = approximate(joint, family=KeyframeSpline, method="SPLIT")
    assert found.error.position_max == pytest.approx(1.0, abs=1e-12)
    assert found.error.rotation_max < 1e-12


@pytest.mark.parametrize("family", [BSpline, NonuniformBSpline, HermiteSpline])
def test_nanoseconds(family):
    epoch = 1_700_000_000_000_000_007
    source = uniform(SE3, 5, dt_ns=200_000_003, t0_ns=epoch)
    options = {} if family is HermiteSpline else {"order": 4}
    found = approximate(source, family=family, tolerance=1e-3, **options)
    start, end = found.trajectory.domain
    assert start == epoch
    assert 0 <= end - source.domain[1] < 100
    assert max(gaps(found.trajectory, source, random_times(source))) < 1.2e-3
    seconds = approximate(uniform(SE3, 5, dt=0.200000003), family=family, tolerance=1e-3, **options)
    assert found.error.position_max == pytest.approx(seconds.error.position_max, rel=1e-3)


def test_batches_and_precision():
    points = torch.stack([walk(SE3, 9, seed=i) for i in range(3)])
    batch = BSpline(points, group=SE3, dt=0.1, extrapolate="clamp")
    found = approximate(batch, family=SplitBSpline, tolerance=1e-2)
    assert found.trajectory.control_points.shape[0] == 3
    assert found.trajectory.extrapolate == "clamp"
    alone = [compare(BSpline(p, group=SE3, dt=0.1), SplitBSpline(q.detach(), dt=found.trajectory.dt)) for p, q in
             zip(points, found.trajectory.control_points, strict=True)]  # fmt: skip
    assert max(x.position_max for x in alone) == pytest.approx(found.error.position_max, rel=1e-9)
    single = BSpline(points[0].float(), group=SE3, dt=0.1)
    made = approximate(single, family=HermiteSpline, tolerance=1e-3).trajectory
    assert made.values.dtype == torch.float32
    assert made.times.dtype == float64
    dual = approximate(single, family=BSpline, group=DualQuaternion).trajectory
    t = torch.linspace(0.0, 0.5, 20, dtype=float64)
    poses = convert.pose_from_dual_quaternion(dual(t))
    assert torch.allclose(SE3.to_matrix(poses), SE3.to_matrix(single(t)), atol=1e-5)


def test_knots_may_come_more_often_where_the_motion_breaks():
    """The corner of a path needs as many knots as the order allows, not ever shorter pieces."""
    keys = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]], dtype=float64)
    path = KeyframeSpline("LERP", keys, torch.tensor([0.0, 1.0, 2.0], dtype=float64))
    knots = torch.tensor([0.0, 0.7, 2.0], dtype=float64)
    found = approximate(path, family=NonuniformBSpline, order=4, tolerance=1e-6, knots=knots)
    assert found.exact
    assert (found.trajectory.knots == 1.0).sum() == 3
    assert found.trajectory.control_points.shape[0] <= 12
