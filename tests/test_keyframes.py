"""Control points from keyframes and from timed poses, and quaternions made continuous in sign."""

import pytest
import torch
from batteries import generator, tangents
from spline_cases import chain, scaled

from torchspline import (
    R3,
    SE3,
    SO3,
    BSpline,
    Rn,
    consistent_signs,
    initial_control_points,
    phantom_points,
    product,
)

F32, F64 = torch.float32, torch.float64
GROUPS = pytest.mark.parametrize("group", [SO3, SE3, Rn(2), product(R3, SO3), product(SO3, SE3)], ids=str)
ORDERS = pytest.mark.parametrize("order", range(2, 9))
#: Rotation between neighbours, radians; 2.5 is where errors of a correction would grow instead of shrink.
GAPS = (0.0, 1e-9, 1e-4, 0.5, 1.5, 2.5)


def keyframes(group, count, gap=0.8, batch=(), seed=0):
    """Random directions, every rotation by the same angle; `(*batch, count, P)`."""
    total = (count - 1) * int(torch.Size(batch).numel())
    steps = tangents(group, [1.0], each=total, seed=seed).reshape(*batch, count - 1, group.tangent_size)
    return chain(group, gap * steps, seed)


def ends(points, group, order):
    """Where a spline with these control points starts and ends, and how many knot intervals lie between."""
    spline = BSpline(points, group=group, order=order, dt=1.0)
    return spline(torch.tensor(spline.domain, dtype=F64).to(points.dtype)), spline.domain[1]


def distance(group, a, b):
    return group.log(group.between(a, b)).abs().max().item()


# ---------------------------------------------------------------------- phantom points


@GROUPS
@ORDERS
def test_the_spline_starts_and_ends_at_the_keyframes(group, order):
    fewest = max(2, order // 2)
    for count in {fewest, fewest + 1, 6}:
        frames = torch.stack([keyframes(group, count, gap, (8,), seed) for seed, gap in enumerate(GAPS)])
        points = phantom_points(frames, group, order)
        extra = -(-(order - 2) // 2)
        assert points.shape == (*frames.shape[:-2], count + 2 * extra, group.point_size)
        assert torch.equal(points[..., extra : extra + count, :], frames)
        met, intervals = ends(points, group, order)
        assert intervals == (count - 1 if order % 2 == 0 else count)
        assert distance(group, met, frames[..., [0, -1], :]) < 2e-14 * max(1.0, frames.abs().max().item())


@GROUPS
@ORDERS
def test_phantom_points_mirror_the_neighbours(group, order):
    """By what mirrored means: the end keyframe is the middle of the geodesic between a point and its image."""
    frames = keyframes(group, 5, gap=0.4)
    points = phantom_points(frames, group, order)
    for sequence, given in ((points, frames), (points.flip(0), frames.flip(0))):
        images = list(sequence[: (order - 1) // 2].flip(0))
        if order % 2:
            assert torch.equal(images.pop(0), given[0])
        for image, neighbour in zip(images, given[1:], strict=False):
            middle = group.interpolate(image, neighbour, 0.5)
            assert distance(group, middle, given[0]) < 4e-14 * max(1.0, frames.abs().max().item())


def test_phantom_points_on_a_line_go_on_with_it():
    frames = torch.arange(5, dtype=F64)[:, None] * torch.tensor([1.0, -2.0], dtype=F64)
    assert torch.equal(phantom_points(frames, Rn(2), 6)[:, 0], torch.arange(-2.0, 7.0, dtype=F64))
    points = phantom_points(frames, Rn(2), 7)[:, 0]
    assert points.tolist() == [-2, -1, 0, 0, 1, 2, 3, 4, 4, 5, 6]


@ORDERS
def test_a_pose_that_rests_rests_all_along(order):
    frames = SE3.random(generator=generator(3)).expand(5, -1)
    spline = BSpline(phantom_points(frames, SE3, order), group=SE3, order=order, dt=0.5)
    state = spline.evaluate(torch.linspace(0, spline.domain[1], 20, dtype=F64), derivatives=1)
    assert distance(SE3, state.value, frames[0]) < 1e-14
    assert state.velocity.abs().max() < 1e-14


@pytest.mark.parametrize("order", [4, 5, 6])
def test_batches_lengths_signs_and_float32(order):
    frames = keyframes(SE3, 5, 1.2, (2, 3))
    points = phantom_points(frames, SE3, order)
    for i in range(2):
        for j in range(3):
            assert torch.allclose(points[i, j], phantom_points(frames[i, j], SE3, order), rtol=0, atol=1e-14)
    other = torch.stack([scaled(SE3, row, seed) for seed, row in enumerate(frames.flatten(0, 1))])
    other_points = phantom_points(other, SE3, order)
    assert distance(SE3, other_points, points.flatten(0, 1)) < 1e-13
    single = phantom_points(frames.float(), SE3, order)
    assert single.dtype == F32
    met, _ = ends(single, SE3, order)
    assert distance(SE3, met.double(), frames[..., [0, -1], :]) < 5e-6


@pytest.mark.parametrize(("group", "order"), [(SO3, 4), (SE3, 4), (SE3, 6), (SO3, 7)], ids=str)
def test_gradients_of_phantom_points(group, order):
    frames = keyframes(group, 4, 1.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: phantom_points(x, group, order), (frames,))
    at_rest = keyframes(group, 4, 0.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: phantom_points(x, group, order), (at_rest,))


def test_gradients_reach_the_pose_at_the_end():
    """The end pose is the last keyframe, so its gradient by the other keyframes has to vanish."""
    frames = keyframes(SE3, 5, 1.0).requires_grad_()
    points = phantom_points(frames, SE3, 6)
    end = BSpline(points, group=SE3, order=6, dt=1.0)(torch.tensor([4.0], dtype=F64))
    (gradient,) = torch.autograd.grad(end.sum(), frames)
    assert gradient[:-1].abs().max() < 1e-13
    assert gradient[-1].norm() > 1.0


# ---------------------------------------------------------------------- a first guess of control points


def naive_guess(t, poses, group, order, dt, t0, count):
    """One control point after the other, in Python."""
    stamps, rows = t.tolist(), []
    for i in range(count):
        at = t0 + (i - (order - 2) / 2) * dt
        if at <= stamps[0]:
            rows.append(poses[0])
        elif at >= stamps[-1]:
            rows.append(poses[-1])
        else:
            k = next(k for k, stamp in enumerate(stamps) if stamp > at) - 1
            rows.append(
                group.interpolate(poses[k], poses[k + 1], (at - stamps[k]) / (stamps[k + 1] - stamps[k]))
            )
    return torch.stack(rows)


@GROUPS
@pytest.mark.parametrize("order", [2, 3, 4, 5, 6])
def test_first_guess_equals_the_naive_loop(group, order):
    t = torch.tensor([1.0, 1.1, 1.5, 3.0, 3.2, 4.0], dtype=F64)
    poses = scaled(group, keyframes(group, 6, 0.9))
    case = {
        "order": order,
        "dt": 0.31,
        "t0": 0.5,
        "count": 15,
    }  # from before the first pose to past the last one
    guess = initial_control_points(t, poses, group=group, **case)
    assert guess.shape == (15, group.point_size)
    assert distance(group, guess, naive_guess(t, poses, group, **case)) < 1e-13
    assert distance(group, guess[0], poses[0]) < 1e-14
    assert distance(group, guess[-1], poses[-1]) < 1e-14
    for start, stop in group.arithmetic.sign_blocks:
        q = guess[:, start:stop]
        assert torch.allclose(q.norm(dim=-1), torch.ones(15, dtype=F64), rtol=0, atol=1e-15)
        assert ((q[1:] * q[:-1]).sum(-1) > 0).all()


def test_first_guess_acts_where_the_basis_peaks():
    """On a straight line travelled evenly the guess is already the exact answer, for every order."""
    t = torch.linspace(-5, 15, 40, dtype=F64)
    for order in range(2, 8):
        guess = initial_control_points(
            t, 3 * t[:, None] + 1, group=Rn(1), order=order, dt=0.7, t0=1.0, count=12
        )
        spline = BSpline(guess, group=Rn(1), order=order, dt=0.7, t0=1.0)
        at = torch.linspace(*spline.domain, 30, dtype=F64)
        assert torch.allclose(spline(at)[:, 0], 3 * at + 1, rtol=0, atol=1e-13)


def test_first_guess_from_one_pose_and_in_float32():
    pose = SE3.random(1, generator=generator(0))
    guess = initial_control_points(
        torch.zeros(1, dtype=F64), -2 * pose, group=SE3, order=4, dt=0.1, t0=0.0, count=3
    )
    assert guess.shape == (3, 7)
    assert torch.allclose(guess[:, 3:], -pose[:, 3:].expand(3, 4), rtol=0, atol=1e-15)
    poses = keyframes(SE3, 5).float()
    case = {"group": SE3, "order": 4, "dt": 0.3, "t0": 0.2, "count": 8}
    t = torch.arange(5)
    single = initial_control_points(t.float(), poses, **case)
    double = initial_control_points(t.double(), poses.double(), **case)
    assert single.dtype == F32
    assert distance(SE3, single.double(), double) < 2e-6


# ---------------------------------------------------------------------- quaternions of consistent sign


@pytest.mark.parametrize("group", [SO3, SE3, product(R3, SO3), product(SO3, SE3)], ids=str)
@pytest.mark.parametrize("gap", [0.0, 1e-6, 0.8, 3.1])
def test_neighbours_lie_on_one_side(group, gap):
    points = torch.stack(
        [scaled(group, row, seed) for seed, row in enumerate(keyframes(group, 12, gap, (5,)))]
    )
    result = consistent_signs(points, group)
    assert torch.equal(result[..., 0, :], group.normalize(points)[..., 0, :])
    flips = 0
    for start, stop in group.arithmetic.sign_blocks:
        q, before = result[..., start:stop], group.normalize(points)[..., start:stop]
        assert ((q[..., 1:, :] * q[..., :-1, :]).sum(-1) >= 0).all()
        sign = (q * before).sum(-1, keepdim=True).sign()
        assert torch.allclose(q, sign * before, rtol=0, atol=1e-15)
        flips += int((sign < 0).sum())
    assert flips > 0  # else the input would have been no test
    others = torch.ones(group.point_size, dtype=torch.bool)
    for start, stop in group.arithmetic.sign_blocks:
        others[start:stop] = False
    assert torch.allclose(result[..., others], points[..., others], rtol=0, atol=1e-13)
    again = consistent_signs(result, group)
    assert torch.allclose(again, result, rtol=0, atol=1e-13)


def test_signs_through_several_turns():
    """A rotation about z by 6 turns: half the angle, continued, is what the quaternions have to show."""
    angle = torch.linspace(0, 12 * torch.pi, 100, dtype=F64)
    half = 0.5 * angle
    smooth = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], dim=-1)
    shaken = smooth * torch.randn(100, 1, generator=generator(1), dtype=F64)
    result = consistent_signs(shaken, SO3)
    assert torch.allclose(result, smooth * shaken[0, 0].sign(), rtol=0, atol=1e-14)


def test_one_point_and_groups_without_quaternions():
    point = -3 * SO3.random(2, 1, generator=generator(2))
    assert torch.allclose(consistent_signs(point, SO3), point / 3, rtol=0, atol=1e-15)
    numbers = torch.randn(4, 2, dtype=F64, generator=generator(2))
    assert torch.equal(consistent_signs(numbers, Rn(2)), numbers)


@pytest.mark.parametrize("count", [1, 4])
def test_gradients_of_consistent_signs(count):
    points = keyframes(SE3, count, 1.0) * torch.tensor([1.0, -2.0, 0.5, -1.0], dtype=F64)[:count, None]
    assert torch.autograd.gradcheck(lambda x: consistent_signs(x, SE3), (points.requires_grad_(),))
    (gradient,) = torch.autograd.grad(consistent_signs(points, SE3).square()[..., 3:].sum(), points)
    assert gradient.abs().max() < 1e-14  # unit whatever the length
