"""Knots in whole nanoseconds: the curves are those in seconds, and an epoch of decades costs no digits."""

import pytest
import torch
from batteries import generator, normal

from torchspline import R3, SE3, HermiteSpline, KeyframeSpline, NonuniformBSpline, product
from torchspline.groups import convert
from torchspline.splines.interpolation import SURVEY

float64 = torch.float64
#: Of 2023, in nanoseconds: float64 seconds there are 240 ns apart.
EPOCH = 1_700_000_000_123_456_789
TIMES = torch.tensor([0, 130_000_001, 250_000_003, 420_000_000, 500_000_007, 640_000_000])
T = torch.tensor([0, 1, 130_000_000, 130_000_001, 333_333_333, 499_999_999, 640_000_000])


def poses(seed=0):
    steps = SE3.exp(0.4 * normal(6, 6, seed=seed))
    found = [SE3.random(generator=generator(seed))]
    for step in steps[1:]:
        found.append(SE3.compose(found[-1], step))
    return torch.stack(found)


def hermite(times, **options):
    rates = normal(6, 6, seed=1), normal(6, 6, seed=2)
    return HermiteSpline(poses(), *rates, group=SE3, times=times, **options)


def nonuniform(times):
    steps = times.diff()
    knots = torch.cat([times[:1] - steps[:3].flip(0).cumsum(0).flip(0), times, times[-1:] + steps[:1]])
    return NonuniformBSpline(poses(), group=SE3, knots=knots)


def keyframes(name):
    group = SURVEY[name].group
    keys = convert.pose_to_dual_quaternion(poses()) if group == "DualQuaternion" else poses()
    keys = keys[:, 3:] if group == "SO3" else keys[:, :3] if group == "Rn" else keys
    return lambda times: KeyframeSpline(name, keys, times)


MAKERS = {
    "hermite": hermite,
    "hermite, logarithm": lambda times: hermite(times, coordinates="logarithm"),
    "hermite, world": lambda times: hermite(times, frame="world"),
    "nonuniform": nonuniform,
    **{name: keyframes(name) for name in SURVEY},
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS.keys())
def test_an_epoch_changes_nothing(make):
    near, far, seconds = make(TIMES), make(TIMES + EPOCH), make(TIMES.to(float64) * 1e-9)
    start, end = near.domain
    assert (start + EPOCH, end + EPOCH) == far.domain
    assert isinstance(start, int)
    t = T if end > T[-1] - 1 else T[:-2]
    expected, ours = seconds.evaluate(t.to(float64) * 1e-9, 3), near.evaluate(t, 3)
    for a, b, c in zip(ours, far.evaluate(t + EPOCH, 3), expected, strict=True):
        assert torch.equal(a, b)
        at_knots = torch.isin(t, TIMES)  # a rounded second may fall on the other side of a jump there
        assert torch.allclose(
            a[~at_knots], c[~at_knots], rtol=1e-12, atol=1e-6 * float(c.detach().abs().amax()) * 1e-6
        )
    with pytest.raises(ValueError, match=f"the first is {end + EPOCH + 1}"):
        far(torch.tensor([end + EPOCH + 1]))
    with pytest.raises(TypeError, match="t: expected int64 nanoseconds"):
        near(t.to(float64))


@pytest.mark.parametrize(
    "make", [hermite, nonuniform, keyframes("SpFus")], ids=["hermite", "nonuniform", "keys"]
)
def test_extrapolation_state_and_conversion(make):
    spline = make(TIMES + EPOCH)
    start, end = spline.domain
    beyond = torch.tensor([start - 10**9, end + 10**9])
    spline.extrapolate = "linear"
    ends = spline.evaluate(torch.tensor([start, end]), 1)
    group = product(R3, R3) if spline.group == R3 else spline.group
    drift = group.exp(torch.tensor([[-1.0], [1.0]], dtype=float64) * ends.velocity)
    assert torch.allclose(
        group.to_matrix(spline(beyond)), group.to_matrix(group.compose(ends.value, drift)), atol=1e-12
    )
    t = T + EPOCH
    t = t[(t >= start) & (t <= end)]
    single = make(TIMES + EPOCH).to(torch.float32)
    assert torch.allclose(single(t).double(), spline(t), atol=1e-5)
    # A state of nanoseconds loads into a module made with seconds, and remains nanoseconds.
    other = make(TIMES.to(float64) * 1e-9)
    other.load_state_dict(spline.state_dict())
    assert other.domain == spline.domain
    assert torch.allclose(other(t), spline(t), rtol=0, atol=1e-13)


def test_differentials_and_knot_insertion():
    near, seconds = hermite(TIMES + EPOCH), hermite(TIMES.to(float64) * 1e-9)
    t = torch.tensor([200_000_000, 600_000_000])
    ours, theirs = (
        near.differentials(t + EPOCH).jacobian,
        seconds.differentials(t.to(float64) * 1e-9).jacobian,
    )
    assert torch.allclose(ours, theirs, rtol=1e-11, atol=1e-11)
    spline, plain = nonuniform(TIMES + EPOCH), nonuniform(TIMES.to(float64) * 1e-9)
    start = spline.domain[0]
    finer, expected = spline.insert_knot(start + 60_000_000), plain.insert_knot(plain.domain[0] + 0.06)
    assert finer.knots.dtype == torch.int64
    assert torch.allclose(finer.control_points, expected.control_points, atol=1e-13)
    with pytest.raises(TypeError, match="time: expected a whole number of nanoseconds"):
        spline.insert_knot(0.06)
    with pytest.raises(ValueError, match=f"time: expected one inside the domain .* ns, got {start - 1}"):
        spline.insert_knot(start - 1)
