"""Normal equations of whole problems against dense ones by automatic differentiation, whatever they are made of."""

import copy
import pickle

import numpy as np
import pytest
import torch
from batteries import generator, normal
from fit_cases import PAIRS, SPLIT, before_the_camera, bias_spline, build, of_slot, sample, spread, trajectory
from fit_oracle import Oracle, check_assembly, of_system

from torchspline import R3, SE3, SO3, use_kernels
from torchspline.fit import (
    Accelerometer,
    Cauchy,
    Clock,
    Direction,
    GemanMcClure,
    Gyroscope,
    Huber,
    Point,
    Pose,
    Position,
    Problem,
    RelativePose,
    ReprojectionEquidistant,
    ReprojectionRadtan,
    StateJerk,
    StateValue,
    Variable,
    smoothness,
)  # fmt: skip
from torchspline.fit.solving import terms
from torchspline.fit.solving.system import BandSystem

# ---------------------------------------------------------------------- each residual


@pytest.mark.parametrize(("kind", "group"), PAIRS, ids=lambda x: getattr(x, "__name__", str(x)))
def test_every_residual_with_everything_unknown(kind, group):
    problem, indices = build(kind, group, sigma=0.7)
    expected = check_assembly(problem, indices)
    used = expected.jacobian.any(dim=0)
    for variable in problem.variables.values():
        if (group.name, variable.name) == ("R3", "lever_arm") and kind.derivatives > 0:
            continue  # without rotation a lever arm does not change velocities
        columns = problem.prepare().model.columns[id(variable)]
        assert used[columns.reshape(-1)].all(), variable.name


@pytest.mark.parametrize("order", [2, 3, 5, 6])
@pytest.mark.parametrize("group", [SE3, SPLIT], ids=str)
def test_orders(order, group):
    spline = trajectory(group, order=order)
    problem = Problem(spline)
    t = spread(spline, 20)
    problem.add(
        Gyroscope(t, normal(20, 3, seed=1), bias=Variable("bias", torch.zeros(3, dtype=torch.float64)))
    )
    if order > 2:
        problem.add(Accelerometer(t, normal(20, 3, seed=2), sigma=0.1))
    problem.add(Pose(t, SE3.random(20, generator=generator(3))))
    check_assembly(problem)


@pytest.mark.slow
@pytest.mark.parametrize("group", [SE3, SPLIT, SO3, R3], ids=str)
def test_compiled_kernels_give_the_same_equations(group):
    spline = trajectory(group)
    results = []
    for mode in ("reference", "fused"):
        with use_kernels(mode):
            problem, t = Problem(spline), spread(spline, 300)
            if group is not R3:
                problem.add(Gyroscope(t, normal(300, 3, seed=1), bias=bias_spline(spline)))
            if group in (SE3, SPLIT):
                pair = spread(spline, 40, seed=5).reshape(2, 20)
                problem.add(RelativePose(pair, SE3.random(20, generator=generator(3)), sigma=0.3))
            clock = Clock(offset=Variable("offset", torch.tensor([0.004], dtype=torch.float64)))
            problem.add(
                StateValue(t, sample(StateValue, group, 300)["measured"], clock=clock, loss=Huber(1.0))
            )
            linearizer = problem.prepare()
            assert linearizer.fused == (mode == "fused")
            results.append(of_system(linearizer))
    for reference, fused in zip(*results, strict=True):
        assert np.abs(fused - reference).max() <= 1e-11 * np.abs(reference).max()


# ---------------------------------------------------------------------- unknowns of every kind


def test_a_bias_that_is_a_spline():
    for spline in (trajectory(SPLIT), trajectory(SE3, order=5)):
        problem, bias = Problem(spline), bias_spline(spline)
        other = bias_spline(spline, order=2, count=5, seed=6)
        t = spread(spline, 25)
        problem.add(Gyroscope(t, normal(25, 3, seed=1), bias=bias, sigma=0.2))
        problem.add(
            Accelerometer(
                t,
                normal(25, 3, seed=1),
                bias=other,
                gravity=Variable("g", torch.tensor([0.3, 0, -9.7]).double(), sphere=True),
            )
        )
        assert isinstance(problem.prepare()(problem.prepare().model.state()), BandSystem)
        check_assembly(problem)


def test_time_offset_skew_and_line_delay():
    spline = trajectory(SE3, order=5)
    number = lambda name, x: Variable(name, torch.tensor([x], dtype=torch.float64))  # noqa: E731
    offset, skew, delay = number("offset", 0.02), number("skew", 3e-3), number("delay", 1e-4)
    t = spread(spline, 20, margin=0.1)
    late = torch.arange(20, dtype=torch.float64)
    for mid in (None, spline.domain[0] + 0.3, spline.domain[0]):
        problem = Problem(spline)
        clock = Clock(offset=offset, skew=skew, mid=mid, delay=delay, late=late)
        problem.add(Gyroscope(t, normal(20, 3, seed=1), clock=clock, bias=bias_spline(spline)))
        pair = spread(spline, 20, seed=7, margin=0.1).reshape(2, 10)
        problem.add(
            RelativePose(pair, SE3.random(10, generator=generator(3)), clock=Clock(offset, skew, mid))
        )
        problem.add(Accelerometer(t, normal(20, 3, seed=2), clock=Clock(offset=offset)))
        check_assembly(problem)
    problem.freeze(skew)
    check_assembly(problem)


def test_the_default_of_mid_keeps_offset_and_skew_apart():
    spline = trajectory(SE3, t0=1.6e9)
    offset, skew = (Variable(n, torch.zeros(1, dtype=torch.float64)) for n in ("offset", "skew"))
    problem = Problem(spline)
    t = torch.linspace(*spline.domain, 60, dtype=torch.float64)[1:-1]
    problem.add(Gyroscope(t, normal(58, 3, seed=1), clock=Clock(offset, skew)))
    matrix, _, _ = of_system(problem.prepare())
    i, j = (int(problem.prepare().model.columns[id(v)][0, 0]) for v in (offset, skew))
    assert abs(matrix[i, j]) < 0.5 * np.sqrt(matrix[i, i] * matrix[j, j])


def test_measurements_that_a_clock_moves_out_take_no_part():
    spline = trajectory(SE3)
    low, high = spline.domain
    t = torch.linspace(low, high, 20, dtype=torch.float64)
    offset = Variable("offset", torch.tensor([0.4], dtype=torch.float64))
    measured = normal(20, 3, seed=1)
    problem = Problem(spline)
    problem.add(Gyroscope(t, measured, clock=Clock(offset=offset), sigma=0.5, loss=Huber(0.3)))
    check_assembly(problem)
    inside = t - 0.4 >= low
    alone = Problem(spline)
    alone.add(Gyroscope(t[inside], measured[inside], clock=Clock(offset=offset), sigma=0.5, loss=Huber(0.3)))
    for a, b in zip(of_system(problem.prepare()), of_system(alone.prepare()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("group", [SE3, SPLIT], ids=str)
def test_whole_nanoseconds(group):
    start = 1_600_000_000_123_456_789
    spline = trajectory(group, dt_ns=300_000_000, t0_ns=start)
    t, problem = spread(spline, 20), Problem(spline)
    clock = Clock(*(Variable(n, torch.tensor([1e-3], dtype=torch.float64)) for n in ("offset", "skew")))
    problem.add(Gyroscope(t, normal(20, 3, seed=1), bias=bias_spline(spline), clock=clock))
    problem.add(Pose(t, SE3.random(20, generator=generator(3)), sigma=0.2))
    mid = start + 10**9
    problem.add(Position(t, normal(20, 3, seed=4), clock=Clock(clock.offset, clock.skew, mid)))
    problem.add(smoothness(spline, sigma=2.0))
    check_assembly(problem)
    seconds = trajectory(group)
    same = Problem(seconds)
    same.add(Pose((t - start).double() * 1e-9, problem.residuals[1].measured, sigma=0.2))
    only = Problem(spline)
    only.add(problem.residuals[1])
    for a, b in zip(of_system(only.prepare()), of_system(same.prepare()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-7)


def test_measurements_at_the_ends_of_the_domain_in_seconds_since_an_epoch():
    for i in range(20):
        spline = trajectory(R3, dt=0.03 + 0.001 * i, t0=1.6e9 + 0.1 * i + 0.037)
        low, high = spline.domain
        for count in (2, 7):
            problem, t = Problem(spline), torch.linspace(low, high, count, dtype=torch.float64)
            problem.add(Position(t, normal(len(t), 3, seed=1)))
            with torch.no_grad():
                expected = 0.5 * (spline(t) - problem.residuals[0].measured).square().sum()
            assert of_system(problem.prepare())[2] == pytest.approx(float(expected), rel=1e-5)


def test_a_residual_that_is_refused_leaves_no_trace():
    spline = trajectory(SE3)
    problem, t = Problem(spline), spread(spline, 9)
    problem.add(Gyroscope(t, normal(9, 3, seed=1), bias=Variable("bias", torch.zeros(3))))
    new = {"gravity": Variable("gravity", torch.ones(3)), "bias": Variable("bias", torch.ones(3))}
    with pytest.raises(ValueError, match="two called 'bias'"):
        problem.add(Accelerometer(t, normal(9, 3, seed=1), **new))
    assert list(problem.variables) == ["bias"]
    assert len(problem.residuals) == 1


def test_derivatives_that_a_spline_does_not_have_are_refused():
    spline = trajectory(SE3, order=2)
    with pytest.raises(
        ValueError, match=r"Accelerometer depends on the derivative number 2.*expected order 3"
    ):
        Problem(spline).add(Accelerometer(spread(spline, 5), normal(5, 3, seed=1)))


def test_control_points_made_in_inference_mode_are_refused():
    with torch.inference_mode():
        spline = trajectory(SE3)
    with pytest.raises(ValueError, match=r"trajectory: .*torch\.inference_mode.*clone"):
        Problem(spline)


def test_names_that_reports_give_to_splines_are_refused():
    spline = trajectory(SE3)
    problem, t = Problem(spline), spread(spline, 9)
    for name in ("trajectory", "spline 1"):
        with pytest.raises(ValueError, match="expected another name"):
            problem.add(Gyroscope(t, normal(9, 3, seed=1), bias=Variable(name, torch.zeros(3))))
    assert not problem.variables


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_keep_frozen_parts(copied):
    spline, bias = trajectory(SE3), Variable("bias", normal(3, seed=1))
    problem, t = Problem(spline), spread(spline, 20)
    problem.add(Gyroscope(t, normal(20, 3, seed=1), bias=bias))
    keep = torch.arange(12) < 5
    problem.freeze(spline, keep)
    problem.freeze(bias)
    other = copied(problem)
    other.solve(max_iterations=2)
    torch.testing.assert_close(other.variables["bias"].value, bias.value, rtol=0, atol=0)
    before, after = (x.trajectory.control_points.detach() for x in (problem, other))
    torch.testing.assert_close(after[keep], before[keep], rtol=0, atol=0)
    assert (after - before)[~keep].abs().max() > 0
    other.release(other.trajectory)
    assert other.prepare().model.total == 12 * 6


def test_one_variable_for_two_parts_of_a_clock():
    spline = trajectory(SE3)
    t = spread(spline, 20).clamp(spline.domain[0] + 0.2, spline.domain[1] - 0.2)
    v = Variable("lag", torch.full((1,), 0.01, dtype=torch.float64))
    problem = Problem(spline)
    clock = Clock(offset=v, delay=v, late=normal(20, seed=3))
    problem.add(Pose(t, SE3.random(20, generator=generator(5)), clock=clock))
    check_assembly(problem)


def test_the_order_of_arguments_does_not_matter():
    t = torch.zeros(1, dtype=torch.float64)
    given = {"bias": torch.zeros(3), "scaling": torch.ones(9)}
    first, second = (
        Gyroscope(t, torch.zeros(1, 3), **dict(x)) for x in (given.items(), reversed(given.items()))
    )
    assert list(first.arguments) == list(second.arguments)


def test_landmarks_and_cameras():
    spline = trajectory(SE3, gap=0.2)
    t = spread(spline, 30)
    with torch.no_grad():
        pose = spline(t)
    index = torch.randint(0, 6, (30,), generator=generator(1))
    map_points = 5.0 * normal(6, 3, seed=2)
    extrinsics = Variable("T_body_camera", SE3.random(generator=generator(4)), group=SE3)
    landmarks = Variable("landmarks", map_points)
    known = before_the_camera(pose, extrinsics.value.expand(30, 7), seed=3)
    intrinsics = Variable("camera", of_slot(ReprojectionRadtan, "intrinsics", 1)[0])
    problem = Problem(spline)
    problem.add(Point(t, normal(30, 3, seed=5), landmark=landmarks, T_body_sensor=extrinsics), landmark=index)
    problem.add(
        ReprojectionRadtan(
            t, 300 + normal(30, 2, seed=6), landmark=known, intrinsics=intrinsics, T_body_camera=extrinsics
        )
    )
    problem.add(
        ReprojectionEquidistant(
            t, 300 + normal(30, 2, seed=6), landmark=landmarks, intrinsics=intrinsics.value, sigma=20.0
        ),
        landmark=index,
    )
    check_assembly(problem, {"Point": {"landmark": index}, "ReprojectionEquidistant": {"landmark": index}})


def test_one_variable_in_two_places():
    spline, both = trajectory(SE3), Variable("both", normal(3, seed=1))
    problem = Problem(spline)
    problem.add(
        Accelerometer(spread(spline, 15), normal(15, 3, seed=2), bias=both, lever_arm=both, gravity=both)
    )
    check_assembly(problem)


def test_each_measurement_has_its_own_known_value_in_any_order():
    spline = trajectory(SE3)
    t, measured = spread(spline, 15), normal(15, 3, seed=2)
    known = normal(15, 3, seed=3)
    problem, split = Problem(spline), Problem(spline)
    problem.add(Direction(t, measured, direction=known, sigma=0.3))
    for i in range(15):
        split.add(Direction(t[i : i + 1], measured[i : i + 1], direction=known[i], sigma=0.3, name=str(i)))
    for a, b in zip(of_system(problem.prepare()), of_system(split.prepare()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)


# ---------------------------------------------------------------------- weights and losses


def positive_definite(*shape, seed):
    x = normal(*shape, 6, 6, seed=seed)
    return x @ x.mT + 0.5 * torch.eye(6, dtype=x.dtype)


WEIGHTS = {
    "number": {"sigma": 0.3},
    "0-dim tensor": {"sigma": torch.tensor(0.3)},
    "(R,)": {"sigma": torch.linspace(0.1, 2.0, 6)},
    "(N, 1)": {"sigma": torch.linspace(0.1, 2.0, 9, dtype=torch.float64)[:, None]},
    "(N, R)": {"sigma": 0.1 + normal(9, 6, seed=1).abs()},
    "covariance": {"covariance": positive_definite(seed=2)},
    "covariances": {"covariance": positive_definite(9, seed=3)},
    "information": {"information": positive_definite(seed=4)},
    "informations": {"information": positive_definite(9, seed=5)},
}


@pytest.mark.parametrize("loss", [None, Huber(0.8), Cauchy(2.0), GemanMcClure(3.0)], ids=str)
@pytest.mark.parametrize("weights", WEIGHTS.values(), ids=WEIGHTS)
def test_weights_and_losses(weights, loss):
    spline = trajectory(SPLIT)
    for count in (9, 6):  # six measurements of six numbers: shapes must not be mistaken
        options = {
            k: x[:count] if getattr(x, "ndim", 0) and x.shape[0] == 9 else x for k, x in weights.items()
        }
        t = spread(spline, count)
        problem = Problem(spline)
        measured = SE3.random(count, generator=generator(3))
        with torch.no_grad():
            measured[::2] = SE3.compose(spline(t[::2]), SE3.exp(0.1 * normal(len(t[::2]), 6, seed=1)))
        problem.add(Pose(t, measured, loss=loss, **options))
        expected = check_assembly(problem)
        if loss is not None:  # some are inliers, some are not
            squared = Oracle(problem).weighted(
                problem.residuals[0], torch.zeros(problem.prepare().model.total).double()
            )
            slopes = loss.weight(squared.square().sum(-1))
            assert slopes.min() < 0.9
            assert slopes.max() > slopes.min()
        assert expected.cost > 0


@pytest.mark.parametrize("loss", [Huber(0.8), Cauchy(2.0), GemanMcClure(3.0)], ids=str)
def test_losses(loss):
    s = torch.logspace(-6, 6, 200, dtype=torch.float64, requires_grad=True)
    rho = loss.rho(s)
    torch.testing.assert_close(torch.autograd.grad(rho.sum(), s)[0], loss.weight(s), rtol=1e-10, atol=1e-14)
    zero = torch.zeros(1, dtype=torch.float64)
    assert loss.rho(zero) == 0
    assert loss.weight(zero) == 1
    assert (rho <= s).all()
    assert (loss.weight(s).diff() <= 0).all()


# ---------------------------------------------------------------------- frozen parts and several residuals


def test_frozen_parts():
    spline, bias = trajectory(SE3), Variable("bias", normal(3, seed=1))
    spline_bias = bias_spline(spline)
    t, problem = spread(spline, 20), Problem(spline)
    problem.add(Gyroscope(t, normal(20, 3, seed=1), bias=spline_bias))
    problem.add(Accelerometer(t, normal(20, 3, seed=2), bias=bias))
    free = problem.prepare().model.total
    keep = torch.zeros(12, dtype=torch.bool)
    keep[[0, 1, 5, 11]] = True
    for unknown_, points, gone in ((spline, keep, 24), (bias, None, 3), (spline_bias, keep[:8], 9)):
        problem.freeze(unknown_, points) if points is not None else problem.freeze(unknown_)
        assert problem.prepare().model.total == free - gone
        check_assembly(problem)
        problem.release(unknown_)
    assert problem.prepare().model.total == free
    problem.freeze(spline)
    check_assembly(problem)
    problem.freeze(spline_bias)
    check_assembly(problem)


def test_many_residuals_together():
    spline = trajectory(SE3, count=14)
    gyro_bias, accel_bias = Variable("gyro", normal(3, seed=1)), Variable("accel", normal(3, seed=2))
    T = Variable("T", SE3.random(generator=generator(3)), group=SE3)
    rotation = Variable("R", SO3.random(generator=generator(4)), group=SO3)
    problem = Problem(spline)
    problem.add(
        Gyroscope(spread(spline, 30), normal(30, 3, seed=1), bias=gyro_bias, rotation=rotation, sigma=0.1)
    )
    problem.add(Accelerometer(spread(spline, 30), normal(30, 3, seed=1), bias=accel_bias, rotation=rotation))
    problem.add(
        Pose(
            spread(spline, 9, seed=2),
            SE3.random(9, generator=generator(5)),
            T_body_sensor=T,
            loss=Cauchy(1.0),
        )
    )
    pair = spread(spline, 12, seed=6).reshape(2, 6)
    problem.add(RelativePose(pair, SE3.random(6, generator=generator(6)), T_body_sensor=T))
    problem.add(StateJerk(spread(spline, 9, seed=8), normal(9, 6, seed=9), sigma=3.0))
    problem.add(smoothness(spline, sigma=4.0))
    check_assembly(problem)


def test_no_measurements_in_a_residual():
    spline = trajectory(SE3)
    problem = Problem(spline)
    problem.add(Pose(spread(spline, 9), SE3.random(9, generator=generator(5))))
    before = of_system(problem.prepare())
    problem.add(Gyroscope(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64)))
    for a, b in zip(before, of_system(problem.prepare()), strict=True):
        np.testing.assert_array_equal(a, b)


def test_more_measurements_than_fit_one_chunk(monkeypatch):
    spline = trajectory(R3)
    t, measured = spread(spline, 300), normal(300, 3, seed=1)
    problem = Problem(spline)
    problem.add(Position(t, measured, lever_arm=Variable("arm", normal(3, seed=2))))
    whole = of_system(problem.prepare())
    for chunk in (1, 7, 40):
        monkeypatch.setattr(terms, "CHUNK", chunk)
        for a, b in zip(of_system(problem.prepare()), whole, strict=True):
            assert np.abs(a - b).max() <= 1e-12 * np.abs(b).max()
