"""Noise in the units people have, and the files they keep it in."""

import inspect
import math

import pytest
import torch

from torchspline import SE3, SO3, imu, io
from torchspline.imu import ImuNoise
from torchspline.io import ImuParameters, read_imu_parameters, write_imu_parameters

F64 = torch.float64
EUROC = ImuNoise(1.6968e-4, 2.0e-3, 1.9393e-5, 3.0e-3)
DENSITIES = (
    "gyroscope_noise_density",
    "accelerometer_noise_density",
    "gyroscope_random_walk",
    "accelerometer_random_walk",
)
KALIBR_FILE = """\
#Accelerometers
accelerometer_noise_density: 1.86e-03   #Noise density (continuous-time)
accelerometer_random_walk:   4e-4   # YAML 1.1 takes this for text

#Gyroscopes
gyroscope_noise_density:     1.87e-04
gyroscope_random_walk:       2.66e-05

rostopic:                    /imu0
update_rate:                 200.0      #Hz
"""
EUROC_FILE = """\
%YAML:1.0
#Default imu sensor yaml file
sensor_type: imu
comment: VI-Sensor IMU (ADIS16448)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.5,
         1.0, 0.0, 0.0, -0.25,
         0.0, 0.0, 1.0, 2.0,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 200

gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]   ( gyro "white noise" )
gyroscope_random_walk: 1.9393e-05       # [ rad / s^2 / sqrt(Hz) ] ( gyro bias diffusion )
accelerometer_noise_density: 2.0000e-3  # [ m / s^2 / sqrt(Hz) ]   ( accel "white noise" )
accelerometer_random_walk: 3.0000e-3    # [ m / s^3 / sqrt(Hz) ].  ( accel bias diffusion )
"""
RESULT_FILE = """\
imu0:
  T_i_b:
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  accelerometer_noise_density: 0.01
  accelerometer_random_walk: 0.0002
  accelerometers:
    M:
    - [1.01, 0.0, 0.0]
    - [0.02, 0.99, 0.0]
    - [-0.03, 0.04, 1.02]
  gyroscope_noise_density: 0.005
  gyroscope_random_walk: 4.0e-06
  gyroscopes:
    A:
    - [0.001, 0.0, 0.0]
    - [0.0, 0.002, 0.0]
    - [0.0, 0.0, 0.003]
    C_gyro_i:
    - [0.0, 1.0, 0.0]
    - [-1.0, 0.0, 0.0]
    - [0.0, 0.0, 1.0]
    M:
    - [0.98, 0.0, 0.0]
    - [0.0, 1.0, 0.0]
    - [0.0, 0.0, 1.0]
  model: scale-misalignment
  rostopic: /imu0
  time_offset: 0.0
  update_rate: 200.0
"""


@pytest.fixture
def file(tmp_path):
    def write(text, name="imu.yaml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def test_data_sheet_units():
    noise = ImuNoise.from_datasheet(
        angle_random_walk=0.15,  # deg/sqrt(h)
        accelerometer_noise=60.0,  # ug/sqrt(Hz)
        gyroscope_bias_instability=8.0,  # deg/h
        acceleration_random_walk=0.6,
    )
    assert math.isclose(noise.gyroscope_noise_density, 0.15 * math.pi / 180 / 60, rel_tol=1e-12)
    assert math.isclose(noise.accelerometer_noise_density, 60e-6 * 9.80665, rel_tol=1e-12)
    assert math.isclose(noise.accelerometer_random_walk, 0.01, rel_tol=1e-12)
    bottom = noise.gyroscope_bias_instability * math.sqrt(2 * math.log(2) / math.pi)
    assert math.isclose(bottom, math.radians(8.0) / 3600, rel_tol=1e-12)
    same = ImuNoise.from_datasheet(gyroscope_noise=0.15 / 60, velocity_random_walk=60e-6 * 9.80665 * 60)
    for name in DENSITIES[:2]:
        assert math.isclose(getattr(same, name), getattr(noise, name), rel_tol=1e-12)
    slow = ImuNoise.from_datasheet(rate_random_walk=0.5)
    assert math.isclose(slow.gyroscope_random_walk, math.radians(0.5 / 3600) / 60, rel_tol=1e-12)


@pytest.mark.parametrize("name", inspect.signature(ImuNoise.from_datasheet).parameters)
def test_data_sheets_that_cannot_be_right(name):
    for bad in (None, "a", True, 1j):
        with pytest.raises(TypeError, match=f"{name}: expected a number, got {type(bad).__name__}"):
            ImuNoise.from_datasheet(**{name: bad})
    for bad in (math.nan, math.inf, -1.0):
        with pytest.raises(ValueError, match=f"{name}: expected a finite number of at least zero, got {bad}"):
            ImuNoise.from_datasheet(**{name: bad})


@pytest.mark.parametrize(
    "names", [("angle_random_walk", "gyroscope_noise"), ("velocity_random_walk", "accelerometer_noise")]
)
def test_one_quantity_under_two_names(names):
    with pytest.raises(ValueError, match=f"{names[0]}: got 0.1 and {names[1]}=0.2.*give one"):
        ImuNoise.from_datasheet(**dict(zip(names, (0.1, 0.2), strict=True)))


def test_inflation_leaves_times_alone():
    noise = ImuNoise(0.1, torch.tensor([1.0, 2.0, 3.0]), gyroscope_bias_sigma=2.0, gyroscope_bias_time=7.0)
    more = noise.inflated(10.0)
    assert (more.gyroscope_noise_density, more.gyroscope_bias_sigma, more.gyroscope_bias_time) == (
        1.0,
        20.0,
        7.0,
    )
    assert more.accelerometer_noise_density.tolist() == [10.0, 20.0, 30.0]


def test_kalibr_files_are_read(file):
    found = read_imu_parameters(file(KALIBR_FILE))
    assert [getattr(found.noise, name) for name in DENSITIES] == [1.87e-4, 1.86e-3, 2.66e-5, 4e-4]
    assert (found.rate, found.topic, found.T_body_imu) == (200.0, "/imu0", None)
    assert not found.calibration
    honest = read_imu_parameters(file(KALIBR_FILE), inflation=10.0)
    assert honest.noise.gyroscope_random_walk == 2.66e-6


def test_euroc_files_are_read(file):
    found = read_imu_parameters(file(EUROC_FILE))
    assert [getattr(found.noise, name) for name in DENSITIES] == [getattr(EUROC, name) for name in DENSITIES]
    assert found.rate == 200.0
    turn = SO3.exp(torch.tensor([0.0, 0.0, math.pi / 2], dtype=F64))
    assert torch.allclose(found.T_body_imu[:3], torch.tensor([0.5, -0.25, 2.0], dtype=F64))
    assert torch.allclose(found.T_body_imu[3:], turn)


def test_results_of_a_calibration_are_read_and_used(file):
    found = read_imu_parameters(file(RESULT_FILE))
    assert torch.allclose(found.T_body_imu, SE3.identity(dtype=F64))
    sensor = imu.Imu(rate=found.rate, **found.calibration)
    w, f = torch.tensor([0.1, 0.2, 0.3], dtype=F64), torch.tensor([1.0, 2.0, 3.0], dtype=F64)
    matrix = sensor._matrix(w)
    out = matrix @ torch.cat([w, f])
    # M C w + A C f by hand, with C w = (w_y, -w_x, w_z).
    gyro = torch.tensor([0.98 * 0.2 + 0.001 * 2.0, -0.1 - 0.002 * 1.0, 0.3 + 0.003 * 3.0], dtype=F64)
    accel = torch.tensor([1.01, 0.02 + 0.99 * 2.0, -0.03 + 0.08 + 1.02 * 3.0], dtype=F64)
    assert torch.allclose(out, torch.cat([gyro, accel]), atol=1e-14)


@pytest.mark.parametrize("format", ["kalibr", "euroc"])
def test_what_is_written_is_read(tmp_path, format):
    path = tmp_path / "imu.yaml"
    # 1e-05 and 1e+22 are written without the point that YAML wants.
    noise = ImuNoise(1e-5, 0.1 + 0.2, 1e22, torch.full((3,), 7.0, dtype=F64))
    pose = SE3.random(generator=torch.Generator().manual_seed(0), dtype=F64)
    whole = {"T_body_imu": pose} if format == "euroc" else {"topic": "/imu: 0 # it\n" + "is a long one " * 10}
    write_imu_parameters(path, ImuParameters(noise, 1 / 3, **whole), format=format)
    found = read_imu_parameters(path)
    assert found.rate == 1 / 3
    assert [getattr(found.noise, name) for name in DENSITIES] == [1e-5, 0.1 + 0.2, 1e22, 7.0]
    if format == "kalibr":
        assert found.topic == "/imu: 0 # it\n" + "is a long one " * 10
    else:
        assert torch.allclose(
            SE3.log(SE3.between(pose, found.T_body_imu)), torch.zeros(6, dtype=F64), atol=1e-14
        )
    write_imu_parameters(path, ImuParameters(EUROC, 200.0), format=format, inflation=16.0)
    assert read_imu_parameters(path).noise.gyroscope_random_walk == 16 * EUROC.gyroscope_random_walk
    assert (
        read_imu_parameters(path, inflation=16.0).noise.gyroscope_random_walk == EUROC.gyroscope_random_walk
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected keys such as .*, got NoneType"),
        ("- 1\n", "got list"),
        ("a: [1\nb: 2\n", "line 2: expected YAML"),
        (KALIBR_FILE.replace("update_rate", "rate"), "key update_rate is missing"),
        (KALIBR_FILE.replace("gyroscope_random_walk", "gyro"), "key gyroscope_random_walk is missing"),
        (KALIBR_FILE.replace("1.87e-04", "abc"), "key gyroscope_noise_density: expected a number, got 'abc'"),
        (KALIBR_FILE.replace("1.87e-04", "true"), "key gyroscope_noise_density: expected a number, got True"),
        (KALIBR_FILE.replace("1.87e-04", ".nan"), "key gyroscope_noise_density: .* got nan"),
        (KALIBR_FILE.replace("1.87e-04", "-1.0"), "key gyroscope_noise_density: .* got -1"),
        (KALIBR_FILE.replace("200.0", "0"), "key update_rate: expected a finite number above zero"),
        (KALIBR_FILE.replace("/imu0", "5"), "key rostopic: expected text, got 5"),
        (EUROC_FILE.replace("0.5,", ""), "key T_BS: expected 4 x 4 numbers"),
        (EUROC_FILE.replace("0.0, 1.0]", "0.5, 1.0]"), "key T_BS: expected a last row 0 0 0 1"),
        (EUROC_FILE.replace("-1.0, 0.0", "-1.5, 0.0"), "key T_BS: expected a rotation"),
        (EUROC_FILE.replace("[0.0, -1.0", "[.nan, -1.0"), "key T_BS: expected finite numbers"),
        (EUROC_FILE.replace("data", "date"), "key T_BS: expected cols, rows and data"),
        (
            RESULT_FILE.replace("[1.01, 0.0", "[1.01, 0.1"),
            "key accelerometers.M: expected a lower triangular",
        ),
        (
            RESULT_FILE.replace("time_offset: 0.0", "time_offset: 0.01"),
            "key time_offset: expected 0, .* got 0.01",
        ),
        (
            RESULT_FILE.replace("time_offset: 0.0", "time_offset: .nan"),
            "key time_offset: expected a finite number",
        ),
        (RESULT_FILE.replace("C_gyro_i", "rx_i"), "key gyroscopes.rx_i: expected M, A or C_gyro_i"),
        (
            RESULT_FILE.replace("  model", "  accelerometers: 5\n  model"),
            "key accelerometers: expected matrices",
        ),
    ],
)
def test_malformed_files(file, text, message):
    path = file(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_imu_parameters(path)
    assert str(caught.value).startswith(str(path))


def test_files_that_are_none(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_imu_parameters(tmp_path / "nothing.yaml")
    with pytest.raises(ValueError, match="got a folder"):
        read_imu_parameters(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="no text"):
        read_imu_parameters(tmp_path / "binary.yaml")
    assert io.ImuParameters is ImuParameters


def test_files_that_cannot_be_written(tmp_path):
    with pytest.raises(ValueError, match="expected a file, got a folder"):
        write_imu_parameters(tmp_path, ImuParameters(EUROC, 200.0))
    with pytest.raises(ValueError, match=r"one gyroscope_noise_density for all axes, got \[\]"):
        write_imu_parameters(tmp_path / "imu.yaml", ImuParameters(ImuNoise(torch.ones(0, 3)), 200.0))
