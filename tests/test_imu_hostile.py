"""Sensors in odd company: batches with stamps of their own, shared generators, lost samples, nothing at all."""

import pytest
import torch

from torchspline import R3, SE3, BSpline, imu, use_kernels

F64 = torch.float64
ONES = (1.0,) * 10


def spline(*batch, seed=0):
    points = SE3.random(*batch, 14, generator=torch.Generator().manual_seed(seed), dtype=F64)
    return BSpline(points, group=SE3, order=4, dt=0.1, learnable=False)


def generators(count, seed=0):
    return [imu.item_generator(seed, i) for i in range(count)]


def sensors(**options):
    """All of them, with the sampling of `options`."""
    return {
        "imu": imu.Imu(noise=imu.ImuNoise(0.1, 0.1, 0.1, 0.1), averaging=2, **options),
        "magnetometer": imu.Magnetometer((20.0, 0.0, -40.0), noise_density=0.1, random_walk=0.1, **options),
        "barometer": imu.Barometer(noise_density=0.1, random_walk=0.1, **options),
    }


@pytest.mark.parametrize("name", ["imu", "magnetometer", "barometer"])
def test_an_item_does_not_depend_on_the_rate_of_others(name):
    """Twice: the density of its white noise, and the interval over which an IMU averages."""
    trajectory, sensor = spline(2), sensors(jitter=1e-4)[name]
    t = torch.stack([torch.linspace(0.0, 1.0, 50, dtype=F64), torch.linspace(0.2, 0.3, 50, dtype=F64)])
    both = sensor(trajectory, t, generators(2))
    first = BSpline(trajectory.control_points[:1], group=SE3, order=4, dt=0.1, learnable=False)
    alone = sensor(first, t[:1], generators(1))
    for x, y in zip(both, alone, strict=True):
        assert torch.equal(x[:1], y)


def test_white_noise_goes_with_the_rate_of_each_row():
    t = torch.stack([torch.arange(4000, dtype=F64) / rate for rate in (4000.0, 40000.0)])
    still = BSpline(SE3.identity(14, dtype=F64), group=SE3, order=4, dt=0.1)
    sensor = imu.Imu(noise=imu.ImuNoise(0.01))
    spread = sensor(still, t, imu.item_generator(0, 0)).gyroscope.std((-1, -2))
    assert torch.allclose(spread, 0.01 * torch.tensor([4000.0, 40000.0], dtype=F64).sqrt(), rtol=0.03)


@pytest.mark.parametrize("name", ["imu", "magnetometer", "barometer"])
def test_items_of_a_batch_have_jitter_and_losses_of_their_own(name):
    """Also where one generator serves all of them and they share their stamps."""
    t = torch.linspace(0.1, 1.0, 40, dtype=F64)
    out = sensors(jitter=1e-4, drop_probability=0.5)[name](spline(3), t, imu.item_generator(0, 0))
    assert out.instants.shape == out.valid.shape == (3, 40)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert not torch.equal(out.valid[i], out.valid[j])
        assert (out.instants[i] != out.instants[j]).all()


def test_sensors_on_one_trajectory_have_jitter_of_their_own():
    constant = torch.zeros(2, 14, 3, dtype=F64)
    for bias in (constant[:, 0], BSpline(constant, group=R3, order=4, dt=0.1)):
        sensor = imu.Imu(gyroscope_bias=bias, jitter=1e-4)
        instants = sensor(spline(), torch.linspace(0.1, 1.0, 5, dtype=F64), imu.item_generator(0, 0)).instants
        assert instants.shape == (2, 5)
        assert (instants[0] != instants[1]).all()


def test_generators_of_a_wrong_number_are_named_whatever_draws():
    t = torch.linspace(0.1, 1.0, 5, dtype=F64)
    for sensor in (imu.Imu(jitter=1e-4), imu.Imu(drop_probability=0.1), imu.Imu(noise=imu.ImuNoise(0.1))):
        with pytest.raises(ValueError, match=r"generator: expected one, or one for each row.*got 2"):
            sensor(spline(3), t, generators(2))


def test_a_generator_that_several_rows_share_fills_them_in_order():
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        shared = imu.item_generator(0, 0)
        made = imu.white_noise((16, 8000, 3), 1.0, 1.0, [shared] * 16)
    finally:
        torch.set_num_threads(threads)
    again = imu.item_generator(0, 0)
    assert torch.equal(made, torch.cat([imu.white_noise((1, 8000, 3), 1.0, 1.0, [again]) for _ in range(16)]))


def test_lost_samples_are_not_integrated_as_zeros():
    t = torch.linspace(0.0, 1.0, 30, dtype=F64)
    sensor = imu.Imu(drop_probability=0.3)
    out = sensor(spline(), t, imu.item_generator(0, 0))
    lost = int((~out.valid).sum())
    with pytest.raises(ValueError, match=f"readings: expected samples that all arrived, got {lost} lost"):
        sensor.increments(out, t)
    kept = imu.ImuReading(out.gyroscope[out.valid], out.accelerometer[out.valid])
    assert sensor.increments(kept, t[out.valid]).angle.shape == (29 - lost, 3)


def test_a_single_stamp_of_a_batch_is_corrected_as_a_row_of_one():
    sensor = imu.Imu(
        gyroscope_bias=torch.randn(3, 3, dtype=F64), accelerometer_scale=1.0 + torch.rand(3, 3, dtype=F64)
    )
    trajectory = spline(3)
    t = torch.tensor([0.4], dtype=F64)
    row, one = sensor(trajectory, t), sensor(trajectory, t[0])
    expected, got = sensor.correct(row), sensor.correct(one)
    given = sensor.correct(one, one.gyroscope_bias, one.accelerometer_bias)
    for x, y, z in zip(expected, got, given, strict=True):
        assert torch.equal(x[:, 0], y)
        assert torch.equal(y, z)


@pytest.mark.parametrize("count", [0, 1])
def test_no_trajectories_and_few_samples(count):
    noise = imu.ImuNoise(*ONES)
    options = {"noise": noise, "rate": 100.0, "jitter": 1e-5, "drop_probability": 0.1, "averaging": 2}
    sensor = imu.Imu(**options, gyroscope_filter=imu.LowPass(50.0))
    t = torch.linspace(0.1, 0.2, count, dtype=F64)
    with torch.no_grad():
        for trajectory, batch in ((spline(), ()), (spline(2), (2,)), (spline(0), (0,))):
            out = sensor(trajectory, t)
            assert out.gyroscope.shape == (*batch, count, 3)
            assert out.valid.shape == (*batch, count)


@pytest.mark.parametrize("mode", ["reference", "auto"])
def test_empty_batches_are_integrated(mode):
    w, t = torch.zeros(0, 4, 3, dtype=F64, requires_grad=True), torch.arange(4, dtype=F64)
    start = imu.Navigation(SE3.identity(dtype=F64)[3:], w.new_zeros(3), w.new_zeros(3))
    with use_kernels(mode):
        rotations = imu.integrate_gyroscope(w, t)
        assert rotations.shape == (0, 4, 4)
        (gradient,) = torch.autograd.grad(rotations.sum(), w)
        assert gradient.shape == w.shape
        assert imu.strapdown(imu.Increments(w[:, 1:], w[:, 1:]), t, start).position.shape == (0, 4, 3)


@pytest.mark.parametrize("name", ["gravity", "earth_rate"])
def test_vectors_of_the_world_are_not_taken_for_samples(name):
    """(3, 3) is one for each of three trajectories to the caller, and one for each of three intervals to the sum."""
    t, g = torch.linspace(0.1, 0.4, 4, dtype=F64), torch.randn(3, 3, dtype=F64)
    message = rf"{name}: expected shape \(3,\), or \(\*batch, 1, 3\), got \(3, 3\)"
    increments = imu.increments(spline(3), t)
    start = imu.Navigation(*(x[:, 0] for x in spline(3).kinematics(t)[:3]))
    start = imu.Navigation(start.rotation, start.position, start.velocity)
    with pytest.raises(ValueError, match=message):
        imu.strapdown(increments, t, start, **{name: g})
    together = imu.strapdown(increments, t, start, **{name: g[:, None]})
    for i in range(3):
        one = imu.strapdown(
            imu.Increments(*(x[i] for x in increments)),
            t,
            imu.Navigation(*(x[i] for x in start)),
            **{name: g[i]},
        )
        assert torch.allclose(together.position[i], one.position, atol=1e-12)


def test_sensors_with_range_resolution_and_averaging_under_vmap():
    trajectory, t = spline(), torch.linspace(0.2, 1.0, 7, dtype=F64)

    def read(bias):
        sensor = imu.Imu(gyroscope_bias=bias, gyroscope_resolution=0.1, gyroscope_range=1.0, averaging=2)
        return sensor(trajectory, t).gyroscope

    biases = torch.rand(3, 3, dtype=F64)
    assert torch.allclose(torch.vmap(read)(biases), torch.stack([read(b) for b in biases]), atol=1e-12)


def test_a_ratio_of_correlation_times_beyond_numbers():
    with pytest.raises(ValueError, match="correlation_times: expected a ratio"):
        imu.flicker_noise((5, 1), 1.0, torch.arange(5.0), correlation_times=(1e-300, 1e300))


@pytest.mark.parametrize("name", ["imu", "magnetometer"])
def test_filters_need_jitter_that_keeps_the_order(name):
    filtered = {"imu": "gyroscope_filter", "magnetometer": "low_pass"}[name]
    t = torch.linspace(0.1, 1.0, 40, dtype=F64)
    sensor = sensors(jitter=0.05)[name]
    assert sensor(spline(), t, imu.item_generator(0, 0)).instants.diff().min() < 0
    setattr(sensor, filtered, imu.LowPass(20.0))
    with pytest.raises(ValueError, match="jitter: expected instants that increase"):
        sensor(spline(), t, imu.item_generator(0, 0))


def test_single_precision_that_leaves_nothing_of_intervals_is_refused():
    """An eighth of a revolution a second: 1 % of an interval is lost after 1000 s, a fifth after 10,000 s."""
    t, w = torch.arange(400, dtype=F64) * 0.005, torch.full((400, 3), 0.45, dtype=F64)
    exact = imu.integrate_gyroscope(w, t)
    late = imu.integrate_gyroscope(w, (1000.0 + t).float())
    assert (late - exact).abs().max() < 1e-4
    for use in (
        lambda t: imu.integrate_gyroscope(w, t),
        lambda t: imu.random_walk((400, 1), 1.0, t),
        lambda t: imu.LowPass(10.0)(w, t),
    ):
        use(10000.0 + t)
        with pytest.raises(
            ValueError, match=r"t: float32 rounds times near 1e.04 s .* of the interval of 0.005 s"
        ):
            use((10000.0 + t).float())
