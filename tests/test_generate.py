"""Recipes, distributions and data sets made on the fly."""

import math
from pathlib import Path

import pytest
import torch
import yaml
from torch.utils.data import DataLoader

from torchspline import SplitBSpline, imu
from torchspline.generate import GeneratedDataset, Recipe, items_per_block
from torchspline.generate.blocks import compute_block
from torchspline.generate.distributions import (
    Choice,
    Constant,
    LogUniform,
    Normal,
    Parameter,
    Uniform,
    distribution_of,
)
from torchspline.generate.processes import rank_and_world

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "generate.yaml"
ANY = Parameter("m", Constant(0.0), least=-math.inf)
#: Small and imperfect in every way.
SMALL = Recipe(
    motions={"smooth": {"bandwidth": 1.0}, "drone": {"weight": 0.5}, "walking": None},
    sensor={
        "gyroscope_noise_density": {"log_uniform": [1e-4, 1e-3]},
        "accelerometer_random_walk": 1e-3,
        "gyroscope_bias": {"normal": [0.0, 0.02]},
        "gyroscope_scale": {"uniform": [0.99, 1.01]},
        "accelerometer_misalignment": {"normal": [0.0, 0.01]},
        "gyroscope_rotation": {"normal": [0.0, 0.01]},
        "g_sensitivity": {"normal": [0.0, 1e-3]},
        "lever_arm": {"uniform": [-0.1, 0.1]},
        "accelerometer_arms": {"normal": [0.0, 0.01]},
        "time_offset": {"uniform": [-0.01, 0.01]},
        "jitter": 1e-4,
        "drop_probability": 0.1,
        "accelerometer_range": 30.0,
        "gyroscope_resolution": 1e-3,
    },
    duration=1.0,
    rate=50.0,
    dtype="float64",
)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (2, Constant(2.0)),
        ({"uniform": [1, 2.5]}, Uniform(1.0, 2.5)),
        ({"log_uniform": [1e-3, 1.0]}, LogUniform(1e-3, 1.0)),
        ({"normal": [1.0, 0.1]}, Normal(1.0, 0.1)),
        ({"choice": [1, 2, 4]}, Choice(1.0, 2.0, 4.0)),
    ],
)
def test_distributions_are_read_and_drawn_from(given, expected):
    found = distribution_of("key", given, ANY)
    assert found == expected
    x = found.sample((20_000,), torch.Generator().manual_seed(0))
    low, high = found.support
    assert x.dtype == torch.float64
    assert low <= x.min()
    assert x.max() <= high
    mean, deviation = moments(found)
    assert x.mean().item() == pytest.approx(mean, abs=4 * deviation / math.sqrt(20_000) + 1e-12)
    assert x.std().item() == pytest.approx(deviation, rel=0.03, abs=1e-12)


def moments(d) -> tuple[float, float]:
    match d:
        case Constant(value):
            return value, 0.0
        case Uniform(a, b):
            return (a + b) / 2, (b - a) / math.sqrt(12)
        case LogUniform(a, b):
            mean = (b - a) / math.log(b / a)
            return mean, math.sqrt((b * b - a * a) / 2 / math.log(b / a) - mean**2)
        case Normal(mean, deviation):
            return mean, deviation
    values = torch.tensor(d.values)
    return values.mean().item(), values.std(correction=0).item()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"uniform": [1.0]}, r"key\.uniform: expected 2 numbers, got 1"),
        ({"uniform": [2.0, 1.0]}, r"key\.uniform: expected \[least, most\] in this order"),
        ({"uniform": 3}, r"key\.uniform: expected a list of numbers, got 3"),
        ({"log_uniform": [0.0, 1.0]}, r"key\.log_uniform: .*above zero"),
        ({"normal": [0.0, -1.0]}, r"key\.normal: .*zero or more, got -1"),
        ({"choice": []}, r"key\.choice: expected at least one number"),
        ({"choice": [1, "b"]}, r"key\.choice: expected a number, got 'b'"),
        (
            {"gauss": [0, 1]},
            r"key: expected a number or one distribution out of uniform, log_uniform, normal",
        ),
        ({"uniform": [0, 1], "normal": [0, 1]}, r"key: expected a number or one distribution"),
        (math.nan, r"key: expected a finite number, got nan"),
        (True, r"key: expected a number, got True"),
        (None, r"key: expected a number, got None"),
    ],
)
def test_bad_distributions_name_their_key(given, message):
    with pytest.raises((TypeError, ValueError), match=message):
        distribution_of("key", given, ANY)


def test_yaml_s_own_idea_of_numbers_is_understood():
    """YAML 1.1 reads 1e-3, without a point, as text."""
    assert yaml.safe_load("1e-3") == "1e-3"
    assert distribution_of("key", {"uniform": ["1e-3", 1]}, ANY) == Uniform(1e-3, 1.0)


def test_ranges_of_parameters_are_kept():
    rate = Parameter("Hz", Constant(1.0), least=0.1, most=10.0)
    message = (
        r"key: expected values from 0.1 to 10 Hz, got Uniform\(least=0.0, most=1.0\) with values from 0 to 1"
    )
    with pytest.raises(ValueError, match=message):
        distribution_of("key", {"uniform": [0, 1]}, rate)
    with pytest.raises(ValueError, match="Normal"):
        distribution_of("key", {"normal": [1.0, 0.2]}, rate)
    distribution_of("key", {"normal": [1.0, 0.05]}, rate)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motions": {}}, "motions: expected at least one out of smooth"),
        ({"motions": []}, "motions: expected a mapping"),
        ({"motions": {"flying": {}}}, "motions.flying: expected one of smooth"),
        ({"motions": {"drone": 3}}, "motions.drone: expected a mapping"),
        ({"motions": {"drone": {"speed": 3}}}, "motions.drone.speed: expected a parameter out of bandwidth"),
        ({"motions": {"drone": {"weight": -1}}}, "motions.drone.weight: expected zero or more"),
        ({"motions": {"drone": {"weight": 0}}}, "motions: expected a weight above zero"),
        (
            {"motions": {"drone": {"bandwidth": {"uniform": [1]}}}},
            "motions.drone.bandwidth.uniform: expected 2",
        ),
        ({"motions": {"smooth": {"bandwidth": 8.0}}}, "motions.smooth: frequencies reach 8 Hz"),
        ({"sensor": {"bias": 1.0}}, "sensor.bias: expected one of gyroscope_noise_density"),
        ({"sensor": {"gyroscope_scale": -1.0}}, "sensor.gyroscope_scale: expected values from 0.001"),
        ({"sensor": None}, "sensor: expected a mapping"),
        ({"rest": -1.0}, "rest: expected values from 0"),
        ({"duration": 0.0}, "duration: expected a finite number above zero"),
        ({"duration": 0.001}, "duration: 0.001 s at 200.0 Hz makes no reading"),
        ({"rate": "fast"}, "rate: expected a number, got 'fast'"),
        ({"knot_spacing": math.inf}, "knot_spacing: expected a finite number"),
        ({"mounting": "sideways"}, "mounting: expected one of 'upright', 'random'"),
        ({"dtype": "half"}, "dtype: expected one of 'float32', 'float64'"),
    ],
)
def test_bad_recipes_name_their_key(changes, message):
    with pytest.raises((TypeError, ValueError), match=message):
        Recipe(**{"motions": {"smooth": {}}, **changes})


def test_recipes_are_read_from_files(tmp_path):
    recipe = Recipe.load(CONFIG)
    assert recipe.samples == 2000
    assert recipe.motion_distributions["smooth"]["bandwidth"] == LogUniform(0.3, 3.0)
    assert recipe.sensor_distributions["gyroscope_scale"] == Normal(1.0, 0.005)
    assert Recipe(**recipe.as_dict()).as_dict() == recipe.as_dict()
    said = Recipe({"drone": None}, {"gyroscope_bias": {"normal": ("0", "1e-3")}}, duration=3)
    same = Recipe({"drone": {}}, {"gyroscope_bias": {"normal": [0.0, 0.001]}}, duration=3.0)
    assert said.as_dict() == same.as_dict()
    path = tmp_path / "bad.yaml"
    for text, message in (
        ("recipe: {motions: {drone: {drag: {uniform: [0]}}}}", "motions.drone.drag.uniform: expected 2"),
        ("recipe: {motion: {}}", "recipe.motion: expected one of motions"),
        ("recipe: {duration: 3}", "recipe.motions: expected kinds of motion"),
        ("motions: {}", "expected a key `recipe`"),
        ("recipe: [", "expected YAML"),
    ):
        path.write_text(text)
        with pytest.raises((TypeError, ValueError), match=rf"bad.yaml(, line \d+)?: {message}"):
            Recipe.load(path)
    with pytest.raises(FileNotFoundError):
        Recipe.load(tmp_path / "absent.yaml")


def test_labels_are_exact():
    """The columns go together: readings are the sensor model's on the trajectory of the control points."""
    block = compute_block(SMALL, 3, 1)
    t = block["time"][0]
    assert torch.equal(t, torch.arange(50, dtype=torch.float64) / 50.0)
    spline = SplitBSpline(block["control_points"], order=6, dt=SMALL.knot_spacing, extrapolate="linear")
    motion = spline.kinematics(t)
    for name in ("rotation", "position", "velocity"):
        torch.testing.assert_close(block[name], getattr(motion, name))
    arm = block["sensor_lever_arm"]
    for i in (0, 5):
        one = SplitBSpline(block["control_points"][i], order=6, dt=SMALL.knot_spacing)
        mount = torch.cat([arm[i], torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)])
        ideal = imu.measure(one, t, T_body_imu=mount)
        torch.testing.assert_close(block["angular_velocity"][i], ideal.gyroscope)
        torch.testing.assert_close(block["specific_force"][i], ideal.accelerometer)
    arrived = block["valid"].bool()
    assert 0.85 < arrived.double().mean() < 0.95
    assert block["gyroscope"][~arrived].abs().max() == 0.0
    steps = block["gyroscope"] / block["sensor_gyroscope_resolution"][:, None, None]
    torch.testing.assert_close(steps, steps.round(), atol=1e-6, rtol=0)
    assert block["accelerometer"].abs().max() <= 30.0
    # A random walk starts from the constant bias, which accelerometers of this recipe have none of.
    assert block["accelerometer_bias"][:, 0].abs().max() == 0.0
    assert block["accelerometer_bias"][:, -1].abs().max() > 0.0
    error = (block["gyroscope"] - block["angular_velocity"] - block["gyroscope_bias"])[arrived]
    assert error.square().mean().sqrt() < 0.1 * block["gyroscope_bias"].abs().max() + 0.1


def test_a_perfect_sensor_reads_what_it_should():
    recipe = Recipe(motions={"figure_eight": {}}, duration=0.5, rate=40.0)
    block = compute_block(recipe, 0, 0)
    assert torch.equal(block["gyroscope"], block["angular_velocity"])
    assert torch.equal(block["accelerometer"], block["specific_force"])
    assert block["gyroscope"].dtype == torch.float32
    assert block["control_points"].dtype == torch.float64
    assert block["gyroscope_bias"].abs().max() == 0
    assert not [name for name in block if name.startswith("sensor_")]


def test_kinds_come_as_often_as_their_weights_say():
    recipe = Recipe(
        motions={"smooth": {"weight": 3.0}, "figure_eight": {}, "drone": {"weight": 0}},
        duration=0.1,
        rate=50.0,
    )
    words = [word for number in range(4) for word in compute_block(recipe, 0, number)["motion"]]
    assert set(words) == {"smooth", "figure_eight"}
    assert words.count("smooth") / len(words) == pytest.approx(0.75, abs=4 * math.sqrt(0.1875 / len(words)))


@pytest.mark.parametrize(("batch_size", "workers"), [(7, 0), (300, 2)])
def test_an_item_depends_on_seed_and_index_alone(batch_size, workers):
    count, start = 900, 13
    size = items_per_block(SMALL)
    wanted = {number: compute_block(SMALL, 5, number) for number in range((start + count) // size + 1)}
    dataset = GeneratedDataset(SMALL, seed=5, count=count, start=start)
    loader = DataLoader(dataset, batch_size=batch_size, num_workers=workers)
    seen = []
    for batch in loader:
        seen += batch["index"].tolist()
        for row in (0, -1):
            i = batch["index"][row].item()
            for name, column in wanted[i // size].items():
                expected, found = column[i % size], batch[name][row]
                assert expected == found if isinstance(found, str) else torch.equal(expected, found), name
    assert sorted(seen) == list(range(start, start + count))


def test_threads_and_processes_change_nothing(monkeypatch):
    before = torch.get_num_threads()
    first = compute_block(SMALL, 1, 0)
    try:
        torch.set_num_threads(2)
        second = compute_block(SMALL, 1, 0)
        assert torch.get_num_threads() == 2  # left as it was
    finally:
        torch.set_num_threads(before)
    for name, x in first.items():
        assert torch.equal(x, second[name]) if isinstance(x, torch.Tensor) else x == second[name]
    shares = []
    for rank in range(2):
        monkeypatch.setenv("RANK", str(rank))
        monkeypatch.setenv("WORLD_SIZE", "2")
        shares.append([item["index"].item() for item in GeneratedDataset(SMALL, seed=1, count=1024)])
    assert [len(share) for share in shares] == [512, 512]
    assert sorted(shares[0] + shares[1]) == list(range(1024))


def test_data_sets_without_end_go_on():
    items = iter(GeneratedDataset(SMALL, seed=1, start=10**6))
    assert [next(items)["index"].item() for _ in range(3)] == [10**6, 10**6 + 1, 10**6 + 2]


def test_ranks_come_from_the_environment(monkeypatch):
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "3")
    assert rank_and_world() == (1, 3)
    monkeypatch.setenv("RANK", "3")
    with pytest.raises(ValueError, match="RANK: expected a whole number below WORLD_SIZE=3, got 3"):
        rank_and_world()
    monkeypatch.setenv("WORLD_SIZE", "many")
    with pytest.raises(ValueError, match=r"WORLD_SIZE: expected a whole number .* got 'many'"):
        rank_and_world()


def test_items_differ_between_seeds_blocks_and_rows():
    first = compute_block(SMALL, 0, 0)["gyroscope"]
    for other in (
        compute_block(SMALL, 1, 0)["gyroscope"],
        compute_block(SMALL, 0, 1)["gyroscope"],
        first.roll(1, 0),
    ):
        assert (first - other).abs().amax((1, 2)).min() > 1e-3


def test_numbers_that_yaml_takes_for_text():
    """YAML 1.1 reads `1e2`, without a point, as text."""
    found = Recipe(motions={"smooth": {"bandwidth": "1e0"}}, duration="1e0", rate="5e1", knot_spacing="2e-2")
    assert (found.samples, found.duration, found.knot_spacing) == (50, 1.0, 0.02)
    plain = Recipe(motions={"smooth": {"bandwidth": 1.0}}, duration=1.0, rate=50.0)
    assert torch.equal(compute_block(found, 0, 0)["gyroscope"], compute_block(plain, 0, 0)["gyroscope"])
