"""What holds for every family of splines on any group, order, clock, batch and control points, looked for with
Hypothesis."""

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from batteries import generator, hat, normal, rescaled, rotation_blocks, tangents
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from spline_cases import chain
from torch import Tensor

from torchspline import BSpline, Group, HermiteSpline, KeyframeSpline, NonuniformBSpline, State, Trajectory
from torchspline.splines.interpolation import SCHEMES
from torchspline.splines.trajectory import MECHANICS

F32, F64 = torch.float32, torch.float64
EPS = torch.finfo(F64).eps
GROUPS = ("SO3", "SE3", "DualQuaternion", "SO2", "SE2", "R1", "R3", "R3xSO3", "SE2xR2xSO3")
ABELIAN = ("SO2", "R1", "R3")
#: Schemes that add up stored numbers, such as quaternions.
BLENDS = ("linear", "bernstein", "bspline", "composite_bezier")

some = examples(10)
each_family = pytest.mark.parametrize("family", ["uniform", "nonuniform", "hermite", "keyframes"])

#: Rotation between neighbours; other components move about as far.
gaps = st.one_of(st.sampled_from([0.0, 1e-200, 1e-12, 1e-8, 1e-4, 0.01, 0.8, 3.1]), st.floats(0.0, 3.1))
spacings = st.one_of(st.sampled_from([0.5, 1.0]), st.floats(-4.0, 3.0).map(lambda e: 10.0**e))
seeds = st.integers(0, 10**6)


@dataclass(frozen=True)
class Curve:
    """A trajectory of any family with what it is made of, so that another can be made from it."""

    group: Group
    points: Tensor
    #: Ends of segments in seconds, or nanoseconds: (S + 1,), and how often each comes where that means something.
    knots: Tensor
    family: str
    order: int = 0
    repeats: tuple[int, ...] = ()
    rates: tuple[Tensor, ...] = ()
    options: tuple[tuple[str, str], ...] = ()

    def trajectory(self, **more: Any) -> Trajectory:
        options: dict[str, Any] = {"group": self.group, "learnable": False, **dict(self.options), **more}
        if self.family == "uniform":
            start, unit = self.knots[0], self.knots[1] - self.knots[0]
            clock = {"t0": start, "dt": unit}
            if self.knots.dtype == torch.int64:
                clock = {"t0_ns": int(start), "dt_ns": int(unit)}
            return BSpline(self.points, order=self.order, **clock, **options)
        if self.family == "nonuniform":
            return NonuniformBSpline(self.points, knots=self.all_knots(), order=self.order, **options)
        if self.family == "hermite":
            return HermiteSpline(self.points, *self.rates, times=self.knots, **options)
        method = options.pop("method")
        return KeyframeSpline(method, self.points, self.knots, **options)

    def all_knots(self) -> Tensor:
        """Of a nonuniform spline: inner knots as often as they come, those at the ends `order` times."""
        return torch.repeat_interleave(self.knots, torch.tensor(self.repeats))

    def times(self, places: list[float]) -> Tensor:
        """One in every segment and more: place i is u in (0, 1) within segment i, over and over."""
        segments = len(self.knots) - 1
        index = torch.arange(max(len(places), segments)) % segments
        u = torch.tensor([places[i % len(places)] for i in range(len(index))], dtype=F64)
        return self.knots[index] + u * self.knots.diff()[index]

    def smoothness(self) -> int:
        """Number of derivatives that are continuous at inner knots."""
        if self.family == "uniform":
            return self.order - 2
        if self.family == "nonuniform":
            return self.order - 1 - max(self.repeats[1:-1], default=1)
        if self.family == "hermite":
            return 2
        declared = SCHEMES[dict(self.options)["method"]].properties
        return 3 if declared.continuity is None else declared.continuity


@st.composite
def curves(draw, family, groups=GROUPS, batch=()):
    group = Group(draw(st.sampled_from(groups)))
    order, segments = draw(st.integers(2, 7)), draw(st.integers(1, 5))
    repeats: tuple[int, ...] = ()
    rates: tuple[Tensor, ...] = ()
    options = {}
    if family == "nonuniform":
        inner = tuple(draw(st.integers(1, order - 1)) for _ in range(segments - 1))
        repeats = (order, *inner, order)
        count = order + sum(inner)
    elif family == "uniform":
        count = segments + order - 1
    elif family == "hermite":
        count = segments + 1
        options = {
            "coordinates": draw(st.sampled_from(["product", "logarithm"])),
            "frame": draw(st.sampled_from(["body", "world"])),
        }
    else:
        scheme = draw(st.sampled_from(sorted(SCHEMES)))
        options = {"method": scheme}
        segments = max(segments, 2)
        count = segments + 1

    unit, seed = draw(spacings), draw(seeds)
    start = unit * draw(st.one_of(st.sampled_from([0.0, 1.0]), st.floats(-1e3, 1e3)))
    steps = [1.0] * segments
    if family != "uniform":
        steps = [draw(st.floats(0.2, 2.0)) for _ in range(segments)]
    knots = start + unit * torch.tensor([0.0, *steps], dtype=F64).cumsum(0)

    gap, reach = draw(gaps), draw(st.sampled_from([1e-3, 1.0, 1e3]))
    size = torch.Size(batch).numel()
    moves = tangents(group, [1.0], each=size * (count - 1), seed=seed) * gap
    moves = (moves * lengths(group, reach)).reshape(*batch, count - 1, -1)
    points = chain(group, moves, seed)
    signs = normal(points.shape[:-1].numel(), seed=seed + 1).sign().tolist()
    points = rescaled(group, points.reshape(-1, group.point_size), signs).reshape(points.shape)
    if family == "hermite":
        speed = draw(st.sampled_from([0.0, 1.0, 5.0])) / unit
        drawn = normal(2, *points.shape[:-1], group.tangent_size, seed=seed + 2) * lengths(group, reach)
        rates = (speed * drawn[0], speed**2 * drawn[1])
    return Curve(group, points, knots, family, order, repeats, rates, tuple(options.items()))


def lengths(group: Group, reach: float) -> Tensor:
    """(D,): ones where a tangent turns, `reach` where it moves."""
    turning = [i for block in rotation_blocks(group.name) for i in block]
    scale = torch.full((group.tangent_size,), reach, dtype=F64)
    scale[turning] = 1.0
    return scale


def by_segment(state: State, curve: Curve, t: Tensor) -> list[Tensor]:
    """Value as a matrix, rates per duration of the segment in which times are: numbers of comparable size."""
    segment = (torch.searchsorted(curve.knots, t, right=True) - 1).clamp(0, len(curve.knots) - 2)
    h = curve.knots.diff()[segment][:, None].to(state.value.dtype)
    rates = [x * h**r for r, x in enumerate(state[1:], start=1) if x is not None]
    return [curve.group.to_matrix(state.value).flatten(-2), *rates]


def rounding(curve: Curve) -> float:
    """How many roundings a place within a segment is off: large where the clock starts far from zero."""
    return float(curve.knots.abs().max() / curve.knots.diff().min())


def assert_same(found: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    """Against the largest of all numbers: a rate is as exact as what it is put together from."""
    scale = 1.0 + max(x.abs().max().item() for x in expected)
    for r, (a, b) in enumerate(zip(found, expected, strict=True)):
        assert a.shape == b.shape
        error = (a.double() - b.double()).abs().max().item() / scale
        assert error <= tolerance, (
            f"derivative {r}: {error:.2e} of {scale:.1e} apart, {tolerance:.1e} allowed"
        )


places = st.lists(st.floats(0.01, 0.99), min_size=1, max_size=3)


@each_family
def test_moving_the_world_moves_the_curve(family):
    """`Y X(t)` is the curve of `Y X_i`, with the same rates in the body frame."""

    @some
    @given(curves(family), places, seeds)
    def check(curve, u, seed):
        t, group = curve.times(u), curve.group
        Y = group.exp(tangents(group, [2.0], each=1, seed=seed)[0])
        rates = curve.rates
        if ("frame", "world") in curve.options:
            rates = tuple(group.adjoint_act(Y, x) for x in rates)
        moved = replace(curve, points=group.compose(Y, curve.points), rates=rates).trajectory().evaluate(t, 3)
        state = curve.trajectory().evaluate(t, 3)
        expected = state._replace(value=group.compose(Y, state.value))
        # Near a half-turn neighbours are a rounding of their product apart, times the inverse Jacobian there.
        assert_same(by_segment(moved, curve, t), by_segment(expected, curve, t), 1e-11)

    check()


@each_family
def test_a_clock_may_start_anywhere_and_run_at_any_speed(family):
    @some
    @given(curves(family), places, st.floats(-3.0, 3.0), st.floats(-100.0, 100.0))
    def check(curve, u, exponent, shift):
        speed, t = 10.0**exponent, curve.times(u)
        shift = shift * speed * curve.knots.diff().max().item()
        rates = tuple(x / speed**r for r, x in enumerate(curve.rates, start=1))
        other = replace(curve, knots=curve.knots * speed + shift, rates=rates)
        state = other.trajectory().evaluate(t * speed + shift, 3)
        expected = by_segment(curve.trajectory().evaluate(t, 3), curve, t)
        tolerance = 1e-12 + 100 * EPS * (rounding(curve) + rounding(other))
        assert_same(by_segment(state, other, other.times(u)), expected, tolerance)

    check()


@each_family
def test_rates_are_derivatives(family):
    """By forward-mode differentiation of the value's matrix, of the velocity and of the acceleration by time; those of
    mechanics, in the world frame, likewise."""

    @some
    @given(curves(family), places)
    def check(curve, u):
        t, group = curve.times(u), curve.group
        trajectory = curve.trajectory(validate=False)

        def fields(t):
            value, *rates = trajectory.evaluate(t, 3)
            return group.to_matrix(value, validate=False), *rates

        (matrix, v, a, j), (rate, dv, da, _) = torch.func.jvp(fields, (t,), (torch.ones_like(t),))
        state = State(group.identity(len(t)), v, a, j)
        exact = State(group.identity(len(t)), v, dv, da)
        assert_same(by_segment(state, curve, t), by_segment(exact, curve, t), 1e-11)
        turned = (matrix @ hat(group, v)).flatten(-2)
        scale = 1.0 + max(x.abs().max().item() for x in (turned, matrix @ hat(group, v.abs())))
        assert (turned - rate.flatten(-2)).abs().max() <= 1e-11 * scale * (1.0 + matrix.abs().max())

        if group.name not in MECHANICS:
            return
        motion, moving = torch.func.jvp(lambda t: tuple(x for x in trajectory.kinematics(t) if x is not None),
                                        (t,), (torch.ones_like(t),))  # fmt: skip
        motion, moving = named(motion, group), named(moving, group)
        h = (curve.knots.diff().min()).item()
        for of, derivative, power in (("position", "velocity", 1), ("velocity", "acceleration", 2),
                                      ("angular_velocity", "angular_acceleration", 2)):  # fmt: skip
            if of in motion:
                size = 1.0 + max(
                    x.abs().max().item() * h**power for x in (motion[derivative], a, v * v.norm())
                )
                assert ((moving[of] - motion[derivative]) * h**power).abs().max() <= 1e-11 * size

    check()


def named(values: tuple[Tensor, ...], group: Group) -> dict[str, Tensor]:
    turning = ("rotation", "angular_velocity", "angular_acceleration")
    moving = ("position", "velocity", "acceleration")
    if group.name in ("SO3", "R3"):
        return dict(zip(turning if group.name == "SO3" else moving, values, strict=True))
    return dict(zip(("rotation", *moving, *turning[1:]), values, strict=True))


@each_family
def test_continuity_at_knots(family):
    """As many derivatives go on across a knot as were promised: they differ by no more than the next ones allow."""

    @some
    @given(curves(family))
    def check(curve):
        t, h = curve.knots[1:-1], curve.knots.diff().min().item()
        if len(t) == 0:
            return
        step = (1e-5 + 4 * EPS * rounding(curve)) * h
        trajectory = curve.trajectory()
        before, after = (trajectory.evaluate(t + side * step, 3) for side in (-1.0, 1.0))
        rates = [[x * h**r for r, x in enumerate(state[1:], start=1)] for state in (before, after)]
        group = curve.group
        gap = group.log(group.between(before.value, after.value))
        largest = [max(x.abs().max().item() for x in pair) for pair in zip(*rates, strict=True)]
        sizes = [*largest, largest[-1]]
        assert gap.abs().max() <= 4e-5 * sizes[0] + 1e-11 * (1.0 + curve.points.abs().max()), (
            "the value jumps"
        )
        for r in range(1, min(curve.smoothness(), 2) + 1):
            jump = (rates[1][r - 1] - rates[0][r - 1]).abs().max()
            bound = 4e-5 * sizes[r] + 1e-9 * (1.0 + max(largest))
            assert jump <= bound, f"derivative {r} jumps by {jump:.1e}, {bound:.1e} allowed"

    check()


@each_family
def test_ends_of_the_domain(family):
    """They belong to it; beyond it holds what `extrapolate` says."""

    @some
    @given(curves(family), st.floats(1e-2, 3.0))
    def check(curve, beyond):
        h, group = curve.knots.diff(), curve.group
        ends = curve.knots[[0, -1]]
        outside = ends + torch.tensor([-1.0, 1.0]) * beyond * h[[0, -1]]
        trajectory = curve.trajectory()
        assert trajectory.domain == pytest.approx(tuple(ends.tolist()), rel=1e-13, abs=1e-13 * h.max().item())
        at_ends = trajectory.evaluate(ends, 3)
        assert all(torch.isfinite(x).all() for x in at_ends)
        with pytest.raises(ValueError, match=r"^t: .* outside the domain"):
            trajectory.evaluate(outside)
        held = curve.trajectory(extrapolate="clamp").evaluate(outside, 3)
        still = at_ends._replace(**{name: torch.zeros_like(x) for name, x in at_ends._asdict().items()
                                    if name != "value"})  # fmt: skip
        tolerance = 1e-12 + 100 * EPS * rounding(curve)
        assert_same(by_segment(held, curve, ends), by_segment(still, curve, ends), tolerance)
        drifting = curve.trajectory(extrapolate="linear").evaluate(outside, 3)
        way = (outside - ends)[:, None] * at_ends.velocity
        value = group.compose(at_ends.value, group.exp(way, validate=False))
        straight = still._replace(value=value, velocity=at_ends.velocity)
        scale = 1.0 + way.abs().max().item()
        assert_same(
            by_segment(drifting, curve, ends), by_segment(straight, curve, ends), tolerance * scale**2
        )

    check()


@each_family
def test_batches_are_loops(family):
    """Of trajectories, of times, and both; one time without a dimension of its own."""

    @some
    @given(
        st.sampled_from([(2,), (3, 2), (1,)]).flatmap(lambda b: curves(family, batch=b)),
        places,
        st.booleans(),
    )
    def check(curve, u, own):
        batch = curve.points.shape[:-2]
        t = curve.times(u)
        whole = curve.trajectory().evaluate(t.expand(*batch, -1).clone() if own else t, 3)
        one = curve.trajectory().evaluate(t[0], 3)
        alone = [
            replace(curve, points=points, rates=tuple(x.reshape(-1, *x.shape[-2:])[i] for x in curve.rates))
            for i, points in enumerate(curve.points.reshape(-1, *curve.points.shape[-2:]))
        ]
        states = [x.trajectory().evaluate(t, 3) for x in alone]
        for field, first, *single in zip(whole, one, *states, strict=True):
            expected = torch.stack(single).reshape(*batch, len(t), -1)
            scale = expected.abs().amax(dim=(-1, -2), keepdim=True) + 1e-300
            assert field.shape == expected.shape
            assert ((field - expected) / scale).abs().max() <= 1e-13
            assert ((first - expected[..., 0, :]) / scale[..., 0]).abs().max() <= 1e-13

    check()


@each_family
def test_single_precision(family):
    """float32 numbers give the curve of those numbers, up to float32 rounding."""

    @some
    @given(curves(family), places)
    def check(curve, u):
        t = curve.times(u)
        coarse = replace(curve, points=curve.points.float(), rates=tuple(x.float() for x in curve.rates))
        fine = replace(coarse, points=coarse.points.double(), rates=tuple(x.double() for x in coarse.rates))
        state = coarse.trajectory().evaluate(t, 3)
        assert {x.dtype for x in state} == {F32}
        # Rates in fast clocks leave the range of float32 before those of the segment do.
        wide = State(*(x.double() for x in state))
        if all(torch.isfinite(x).all() for x in wide):
            expected = by_segment(fine.trajectory().evaluate(t, 3), curve, t)
            assert_same(by_segment(wide, curve, t), expected, 2e-4)

    check()


@each_family
def test_whole_nanoseconds(family):
    """The same curve by int64 times, which may be an epoch from zero."""

    @some
    @given(curves(family), places, st.sampled_from([0, 1_700_000_000_123_456_789]))
    def check(curve, u, epoch):
        h = curve.knots.diff()
        steps = (h / h.min() * 10_000_000).round().to(torch.int64)
        knots = torch.cat([steps.new_zeros(1), steps.cumsum(0)])
        seconds = replace(curve, knots=knots.double() * 1e-9)
        exact = replace(curve, knots=knots + epoch)
        t = (seconds.times(u) * 1e9).round().to(torch.int64)
        state = exact.trajectory().evaluate(t + epoch, 3)
        expected = seconds.trajectory().evaluate(t.double() * 1e-9, 3)
        at = t.double() * 1e-9
        assert_same(by_segment(state, seconds, at), by_segment(expected, seconds, at), 1e-11)

    check()


@each_family
def test_gradients_are_finite_and_the_same_both_ways(family):
    """Reverse against forward mode along a random direction, by control points, rates and times."""

    @some
    @given(curves(family), places, seeds)
    def check(curve, u, seed):
        t = curve.times(u)
        given = (curve.points, *curve.rates, t)

        def fields(points, *rest):
            made = replace(curve, points=points, rates=rest[:-1])
            return by_segment(made.trajectory(validate=False).evaluate(rest[-1], 2), curve, t)

        h = curve.knots.diff().min()
        ways = [normal(*x.shape, seed=seed + i) * x.abs().max() for i, x in enumerate(given)]
        ways[-1] = normal(*t.shape, seed=seed) * h
        outputs, moved = torch.func.jvp(lambda *x: tuple(fields(*x)), given, tuple(ways))
        leaves = [x.clone().requires_grad_() for x in given]
        out = fields(*leaves)
        cotangents = [normal(*x.shape, seed=seed + 7 + i) for i, x in enumerate(outputs)]
        found = torch.autograd.grad(out, leaves, cotangents)
        assert all(torch.isfinite(x).all() for x in (*found, *moved))
        ahead = [(x * y) for x, y in zip(moved, cotangents, strict=True)]
        back = [(x * y) for x, y in zip(found, ways, strict=True)]
        scale = 1.0 + sum(x.abs().sum().item() for x in (*ahead, *back))
        error = abs(sum(x.sum().item() for x in ahead) - sum(x.sum().item() for x in back))
        assert error <= 1e-10 * scale, f"{error:.1e} of {scale:.1e} apart"

    check()


@each_family
def test_uniform_motion_is_reproduced(family):
    """Points of one steady motion, where the family has its knots: the curve is that motion, of any duration."""

    @some
    @given(curves(family), places, seeds)
    def check(curve, u, seed):
        group, count, at = curve.group, len(curve.points), curve.knots
        method = dict(curve.options).get("method")
        if family == "uniform":
            at = (torch.arange(count, dtype=F64) - (curve.order - 2) / 2) * (at[1] - at[0]) + at[0]
        elif family == "nonuniform":  # Greville's places
            at = curve.all_knots().unfold(0, curve.order + 1, 1)[:, 1:-1].mean(-1)
        elif method in BLENDS and group.name not in ("R1", "R3"):
            return  # blends of numbers do not turn steadily
        elif method not in (None, "geodesic", "linear"):
            at = at[0] + torch.arange(count, dtype=F64) * (at[-1] - at[0]) / (count - 1)
        speed = tangents(group, [2.0], each=1, seed=seed)[0] / at.diff().max()
        start = group.random(generator=generator(seed))

        def motion(t):
            return group.compose(start, group.exp((t - at[0])[:, None] * speed, validate=False))

        rates = ()
        if family == "hermite":
            v = speed.expand(count, -1)
            v = group.adjoint_act(motion(at), v) if ("frame", "world") in curve.options else v
            rates = (v, torch.zeros_like(v))
        knots = at if family == "keyframes" else curve.knots
        steady = replace(curve, points=motion(at), rates=rates, knots=knots)
        t = steady.times(u)
        state = steady.trajectory().evaluate(t, 3)
        still = torch.zeros_like(state.velocity)
        exact = State(motion(t), speed.expand_as(still), still, still)
        tolerance = 1e-11 + 1e3 * EPS * rounding(steady)
        assert_same(by_segment(state, steady, t), by_segment(exact, steady, t), tolerance)

    check()


@pytest.mark.parametrize("family", ["uniform", "nonuniform", "keyframes"])
def test_time_may_run_backwards(family):
    """On groups that commute every curve, on others those that treat both of their ends alike."""

    @some
    @given(curves(family), places)
    def check(curve, u):
        method = dict(curve.options).get("method")
        if curve.group.name not in ABELIAN and (family != "keyframes" or method == "cumulative_bspline"):
            return
        t = curve.times(u)
        back = replace(
            curve, points=curve.points.flip(-2), knots=-curve.knots.flip(0), repeats=curve.repeats[::-1]
        )
        state, mirrored = curve.trajectory().evaluate(t, 3), back.trajectory().evaluate(-t, 3)
        signs = (1.0, -1.0, 1.0, -1.0)
        turned = State(*(x * s for x, s in zip(mirrored, signs, strict=True)))
        tolerance = 1e-11 + 1e3 * EPS * rounding(curve)
        assert_same(by_segment(turned, curve, t), by_segment(state, curve, t), tolerance)

    check()
