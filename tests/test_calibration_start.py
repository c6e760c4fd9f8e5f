"""Board poses and the start of a calibration: against simulated truth, OpenCV, and recordings that are wrong."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchspline import SE3, SO3
from torchspline.calibrate import Corners, Recording, board_poses, calibrate, find_start, read_recording
from torchspline.calibrate.simulate import Simulation, simulate
from torchspline.calibrate.start import with_known_offsets
from torchspline.io import ImuRecord

NS = 1_000_000_000


@pytest.fixture(scope="module")
def simulated() -> Simulation:
    """Ten seconds, two cameras at 20 Hz, IMU at 200 Hz."""
    return simulate(seconds=10.0, images=200, samples=2000, order=6, spacing=0.05, seed=3)


@pytest.fixture(scope="module")
def recording(simulated) -> Recording:
    return simulated.recording


def truth(simulated: Simulation, i: int) -> torch.Tensor:
    """Board to camera in each image."""
    t = simulated.recording.corners[i].t_ns + round(float(simulated.time_offset[i]) * NS)
    with torch.no_grad():
        T_board_imu = simulated.trajectory(t)
    if T_board_imu.shape[-1] != 7:
        raise AssertionError(T_board_imu.shape)
    return SE3.inverse(SE3.compose(T_board_imu, simulated.T_imu_cam[i]))


def apart(a: torch.Tensor, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances in m and rad of poses."""
    between = SE3.compose(SE3.inverse(a), b)
    return between[..., :3].norm(dim=-1), SO3.log(between[..., 3:]).norm(dim=-1)


# ---------------------------------------------------------------------- time offsets that are known


def test_known_time_offsets_are_where_the_search_begins(simulated, recording):
    """Kalibr's `t_imu = t_cam + timeshift_cam_imu`: 25 s apart, and looked for within half a second."""
    late = replace(recording.imus[0], time_ns=recording.imus[0].time_ns + 25 * NS)
    apart = replace(recording, imus=(late,), time_offset=(25.0, 24.8))
    found = find_start(apart, max_offset=0.5)
    assert torch.allclose(found.time_offset, simulated.time_offset + 25.0, atol=5e-3)
    assert any("cam1 with imu0: the clocks are 25.0" in note for note in found.notes)
    assert not any("cam0 with imu0: the clocks" in note for note in found.notes)
    assert abs(int(found.t_ns[0]) - int(late.time_ns[0])) < NS
    kept = with_known_offsets(found, apart)
    assert kept.time_offset.tolist() == [25.0, 24.8]
    some = with_known_offsets(found, replace(apart, time_offset=(None, 24.8)))
    assert some.time_offset.tolist() == [float(found.time_offset[0]), 24.8]
    with pytest.raises(ValueError, match=r"cam0 with imu0: "):
        find_start(replace(apart, time_offset=(-25.0, None)), max_offset=0.5)
    part = apart.between(2.0, 4.0)
    assert float(part.imus[0].time_ns[0] - part.corners[0].t_ns[0]) == pytest.approx(24.8 * NS, abs=0.1 * NS)
    assert apart.only(1).time_offset == (24.8,)


def test_known_time_offsets_stay_where_they_are_not_estimated(simulated, recording):
    offsets = tuple(simulated.time_offset.tolist())
    known = replace(recording, time_offset=offsets).between(0.0, 4.0).only(0)
    options = {"spacing": 0.1, "reweigh": False, "stretch": None, "max_iterations": 3}
    found = calibrate(known, estimate=(), **options)
    assert found.cameras[0].time_offset == offsets[0]
    assert found.cameras[0].time_offset_sigma is None


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "mm"), (1e-3, "km"), (7.0, None)])
def test_boards_in_other_units_are_named(recording, factor, unit):
    """The motion they tell is not that of the accelerometer: its scale says by how much, before anything is solved."""
    wrong = replace(recording.corners[0], xyz=recording.corners[0].xyz * factor, source="cam0.npz")
    with pytest.raises(
        ValueError, match=r"cam0 with imu0: cam0.npz: expected corners of the board in m"
    ) as caught:
        find_start(replace(recording.only(0), corners=(wrong,)))
    told = float(re.search(r"multiplied by ([0-9.e+-]+[0-9])", str(caught.value)).group(1))
    assert told == pytest.approx(1.0 / factor, rel=0.15)
    assert (f"seem to be in {unit}" in str(caught.value)) if unit else "seem to be" not in str(caught.value)


# ---------------------------------------------------------------------- board poses


@pytest.mark.parametrize("distortion", ["radtan", "equidistant"])
def test_exact_corners_give_exact_poses(distortion):
    made = simulate(
        seconds=2.0,
        images=12,
        samples=400,
        cameras=1,
        order=6,
        spacing=0.05,
        distortion=distortion,
        pixel_sigma=0.0,
    )
    found = board_poses(made.recording.cameras[0], made.recording.corners[0])
    assert bool(found.good.all())
    position, rotation = apart(truth(made, 0), found.T_cam_board)
    assert float(position.max()) < 1e-8
    assert float(rotation.max()) < 1e-8
    assert float(found.rms.max()) < 1e-6
    assert found.median_error() < 1e-6


def test_noisy_poses_are_as_good_as_noise_allows(simulated):
    """The sum of squares at the minimum has as many degrees of freedom as numbers less unknowns."""
    recording = simulated.recording
    found = board_poses(recording.cameras[1], recording.corners[1])
    n = recording.corners[1].first.diff().double()
    chi2 = found.rms.square() * n / simulated.pixel_sigma**2
    freedom = 2.0 * n - 6.0
    assert float(((chi2 - freedom).sum() / (2.0 * freedom.sum()).sqrt()).abs()) < 4.0
    position, rotation = apart(truth(simulated, 1), found.T_cam_board)
    assert float(position.median()) < 2e-3
    assert float(rotation.median()) < 2e-3


def test_a_pose_is_a_minimum_of_the_reprojection_error(recording):
    """Any small step away makes the errors larger; an oracle of its own, with the textbook's model written out."""
    camera, corners = recording.cameras[0], recording.corners[0]
    found = board_poses(camera, corners)
    frame = 7
    rows = corners.frame == frame
    fu, fv, pu, pv = camera.intrinsics
    k1, k2, p1, p2 = camera.coefficients

    def cost(pose: torch.Tensor) -> float:
        x, y, z = SE3.act(pose, corners.xyz[rows]).unbind(-1)
        a, b = x / z, y / z
        r2 = a * a + b * b
        c = 1 + k1 * r2 + k2 * r2 * r2
        u = fu * (a * c + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + pu
        v = fv * (b * c + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + pv
        error = torch.stack([u, v], dim=1) - corners.uv[rows]
        length = error.norm(dim=1)
        # Written out from the definition of Huber's loss at 2 px.
        return float(torch.where(length <= 2.0, length.square(), 4.0 * length - 4.0).sum())

    best = found.T_cam_board[frame]
    least = cost(best)
    assert least == pytest.approx(float(found.rms[frame]) ** 2 * int(rows.sum()), rel=1e-2)
    for step in 1e-4 * torch.cat([torch.eye(6), -torch.eye(6)]).double():
        assert cost(SE3.compose(SE3.exp(step), best)) > least


def test_opencv_agrees(recording):
    cv2 = pytest.importorskip("cv2")
    camera, corners = recording.cameras[0], recording.corners[0]
    found = board_poses(camera, corners)
    fu, fv, pu, pv = camera.intrinsics
    matrix = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1.0]])
    first = corners.first.tolist()
    for frame in range(0, len(corners.t_ns), 25):
        rows = slice(first[frame], first[frame + 1])
        if float(found.error[rows].norm(dim=1).max()) > 2.0:  # from there on other losses
            continue
        xyz, uv = corners.xyz[rows].numpy(), corners.uv[rows].numpy()
        _, turn, position = cv2.solvePnP(xyz, uv, matrix, np.array(camera.coefficients))
        theirs = SE3.compose(
            torch.cat([torch.from_numpy(position[:, 0]), SO3.identity()]),
            torch.cat([torch.zeros(3).double(), SO3.exp(torch.from_numpy(turn[:, 0]))]),
        )
        distance, angle = apart(found.T_cam_board[frame], theirs)
        assert float(distance) < 2e-4
        assert float(angle) < 2e-4


def test_single_wrong_corners_do_not_pull_a_pose_away(simulated):
    recording = simulated.recording
    camera, corners = recording.cameras[0], recording.corners[0]
    uv = corners.uv.clone()
    spoiled = corners.first[:-1] + 5
    uv[spoiled, 0] = (uv[spoiled, 0] + 60.0) % camera.resolution[0]
    before, after = board_poses(camera, corners), board_poses(camera, replace(corners, uv=uv))
    good = after.good & before.good
    position, rotation = apart(before.T_cam_board[good], after.T_cam_board[good])
    # 60 px among some 250 numbers would move a least-squares pose by far more than its noise of a millimetre.
    assert float(position.median()) < 1e-3
    assert float(rotation.median()) < 1e-3


def test_images_that_show_too_little_have_no_pose(recording):
    camera, corners = recording.cameras[0], recording.corners[0]
    first = corners.first
    keep = torch.ones(len(corners), dtype=torch.bool)
    keep[int(first[2]) + 7 : int(first[3])] = False
    keep[int(first[5]) : int(first[6])] = False
    line = (corners.frame == 9) & (corners.xyz[:, 1] > 0.001)
    kept = keep & ~line
    columns = {name: getattr(corners, name)[kept] for name in ("frame", "uv", "xyz", "tag_id", "corner")}
    found = board_poses(camera, replace(corners, **columns))
    assert found.reason[[2, 5, 9, 3]].tolist() == [1, 1, 2, 0]
    assert bool(found.T_cam_board[[2, 5, 9]].isnan().all())
    assert not bool(found.T_cam_board[3].isnan().any())
    assert len(found.notes) == 2
    assert "2 of 200 images" in found.notes[0]


# ---------------------------------------------------------------------- the start


def check_start(found, made: Simulation, offsets: torch.Tensor) -> None:
    position, rotation = apart(found.T_imu_cam, made.T_imu_cam)
    assert float(position.max()) < 0.03
    assert float(rotation.max()) < math.radians(0.5)
    assert float((found.time_offset - offsets).abs().max()) < 1e-3
    assert float((found.gravity - made.gravity).norm()) < 0.3
    assert float((found.gyro_bias[0] - made.gyro_bias).norm()) < 0.01
    assert float((found.accel_bias[0] - made.accel_bias).norm()) < 0.4
    with torch.no_grad():
        exact = made.trajectory(found.t_ns)
    position, rotation = apart(exact, found.T_board_imu)
    assert float(position.median()) < 0.03
    assert float(rotation.median()) < math.radians(0.5)


def test_a_start_from_nothing(simulated):
    found = find_start(simulated.recording)
    check_start(found, simulated, simulated.time_offset)
    assert len(found.t_ns) == 200
    assert bool((found.t_ns.diff() > 0).all())
    assert found.T_imu0_imu.tolist()[0] == pytest.approx([0, 0, 0, 1, 0, 0, 0], abs=1e-12)
    assert not found.notes


def test_clocks_five_seconds_apart_are_brought_together(simulated):
    recording = simulated.recording
    late = tuple(replace(c, t_ns=c.t_ns - 5 * NS) for c in recording.corners)
    found = find_start(replace(recording, corners=late))
    check_start(found, simulated, simulated.time_offset + 5.0)
    assert sum("5.00" in note and "clocks" in note for note in found.notes) == 2


def test_several_imus_have_places_and_clocks_of_their_own(simulated):
    recording = simulated.recording
    T_imu0_imu1 = SE3.exp(torch.tensor([0.1, -0.05, 0.02, 0.3, -0.2, 0.4], dtype=torch.float64))
    first, late = recording.imus[0], 0.5
    R, arm = SO3.to_matrix(T_imu0_imu1[3:]), T_imu0_imu1[:3]
    with torch.no_grad():
        state = simulated.trajectory.kinematics(first.time_ns)
    w, dw = state.angular_velocity, state.angular_acceleration
    force = first.accelerometer - simulated.accel_bias
    force = (
        force
        + torch.linalg.cross(dw, arm.expand_as(dw))
        + torch.linalg.cross(w, torch.linalg.cross(w, arm.expand_as(w)))
    )
    second = ImuRecord(
        first.time_ns + round(late * NS), (first.gyroscope - simulated.gyro_bias) @ R, force @ R, "second"
    )
    found = find_start(
        replace(recording, imus=(first, second), noise=recording.noise * 2, cameras=recording.cameras[:1],
                corners=recording.corners[:1])
    )  # fmt: skip
    position, rotation = apart(found.T_imu0_imu[1], T_imu0_imu1)
    assert float(position) < 0.03
    assert float(rotation) < math.radians(0.5)
    assert float(found.imu_time_offset[1]) == pytest.approx(late, abs=1e-3)
    assert float(found.gyro_bias[1].norm()) < 0.01


# ---------------------------------------------------------------------- wrong recordings


def message_of(recording: Recording, **options) -> str:
    with pytest.raises(ValueError) as caught:
        find_start(recording, **options)
    return str(caught.value)


def scrambled(corners: Corners, rows: torch.Tensor) -> Corners:
    """These rows, marked True, get the board's points of others among them."""
    xyz = corners.xyz.clone()
    chosen = torch.nonzero(rows).flatten()
    xyz[chosen] = xyz[chosen[torch.randperm(len(chosen), generator=torch.Generator().manual_seed(0))]]
    return replace(corners, xyz=xyz)


def with_first(recording: Recording, corners: Corners) -> Recording:
    return replace(recording, corners=(corners, *recording.corners[1:]))


def test_half_the_corners_mislabelled(recording):
    corners = recording.corners[0]
    message = message_of(with_first(recording, scrambled(corners, torch.arange(len(corners)) % 2 == 0)))
    assert "cam0" in message
    assert "200 of 200 images" in message
    share = int(
        re.search(r"(\d+)% of the corners contradict the rest of their image, all over", message).group(1)
    )
    assert share == pytest.approx(50, abs=5)


def test_half_the_images_mislabelled(recording):
    corners = recording.corners[0]
    message = message_of(with_first(recording, scrambled(corners, corners.frame >= 100)))
    assert "100 of 200 images" in message
    assert "images 100-199" in message


def moved(corners: Corners, tags: dict[int, int]) -> Corners:
    """Tags taken for others of the board of 6 x 6."""
    xyz = corners.xyz.clone()
    for tag, other in tags.items():
        delta = torch.tensor([(other % 6 - tag % 6) * 0.1144, (other // 6 - tag // 6) * 0.1144, 0.0])
        xyz[corners.tag_id == tag] += delta.double()
    return replace(corners, xyz=xyz)


def test_two_mislabelled_tags_are_named(recording):
    """Too few to spoil a pose."""
    some = with_first(recording, moved(recording.corners[0], {14: 21, 21: 14})).only(0)
    (note,) = find_start(some).notes
    assert "more than 5 px off, above all those of tags 14, 21" in note


def test_many_mislabelled_tags_are_named(recording):
    """In disorder: if all were moved alike, it would be a pose."""
    wrong = {tag: (7 * tag + 4) % 19 for tag in range(19)}
    message = message_of(with_first(recording, moved(recording.corners[0], wrong)))
    named = re.search(r"above all those of tags ([\d, ]*): are they mislabelled", message)
    assert named
    tags = {int(x) for x in named.group(1).split(",")}
    assert tags <= set(wrong)
    assert len(tags) >= 10


def test_all_corners_mislabelled(recording):
    corners = recording.corners[0]
    message = message_of(
        with_first(recording, scrambled(corners, torch.ones(len(corners), dtype=torch.bool)))
    )
    assert "mislabelled throughout" in message


def test_swapped_cameras(recording):
    """Another focal length is another distortion at the same pixel: poses make up for the one, not for the other."""
    one, two = recording.cameras
    fu, fv, pu, pv = two.intrinsics
    middle = torch.tensor([pu, pv], dtype=torch.float64)
    seen = replace(recording.corners[1], uv=middle + 0.8 * (recording.corners[1].uv - middle))
    right = replace(
        recording,
        cameras=(one, replace(two, intrinsics=(0.8 * fu, 0.8 * fv, pu, pv))),
        corners=(recording.corners[0], seen),
    )
    assert not any("swapped" in note for note in find_start(right).notes)
    (note,) = (x for x in find_start(replace(right, corners=right.corners[::-1])).notes if "swapped" in x)
    assert "the corners of cam0 fit the intrinsics of cam1" in note


def test_no_motion(recording):
    still = recording.corners[0].select(torch.arange(200) == 0)
    again = replace(
        still,
        t_ns=recording.corners[0].t_ns,
        frame=torch.arange(200).repeat_interleave(len(still)),
        **{name: getattr(still, name).repeat(200, *[1] * (getattr(still, name).ndim - 1))
           for name in ("uv", "xyz", "tag_id", "corner")},
    )  # fmt: skip
    imu = recording.imus[0]
    resting = replace(
        imu,
        gyroscope=torch.full_like(imu.gyroscope, 0.01),
        accelerometer=torch.full_like(imu.accelerometer, 5.66),
    )
    message = message_of(replace(recording.only(0), corners=(again,), imus=(resting,)))
    assert "cam0 with imu0" in message
    assert "so little turning" in message


def test_too_few_images(recording):
    message = message_of(recording.between(0.0, 0.5))
    assert "expected at least 20 images" in message


def test_images_and_imu_that_never_overlap(recording):
    imu = recording.imus[0]
    later = replace(imu, time_ns=imu.time_ns + 3600 * NS)
    message = message_of(replace(recording, imus=(later,)))
    assert "overlap" in message
    assert "cam0 with imu0" in message


def test_an_imu_of_another_recording(recording):
    imu = recording.imus[0]
    generator = torch.Generator().manual_seed(0)
    steps = torch.randn(len(imu) // 40, 3, generator=generator, dtype=torch.float64).repeat_interleave(
        40, dim=0
    )
    other = replace(imu, gyroscope=steps, accelerometer=imu.accelerometer.flip(0))
    message = message_of(replace(recording.only(0), imus=(other,)))
    assert "same recording" in message


def test_readings_in_other_units(recording):
    imu = recording.imus[0]
    weights = replace(imu, accelerometer=imu.accelerometer / 9.80665)
    assert "imu0: accelerometer: expected specific forces" in message_of(replace(recording, imus=(weights,)))
    degrees = replace(imu, gyroscope=imu.gyroscope.rad2deg())
    assert "are the readings in rad/s" in message_of(replace(recording, imus=(degrees,)))


def test_mirrored_axes(recording):
    imu = recording.imus[0]
    mirrored = replace(imu, gyroscope=imu.gyroscope * torch.tensor([1.0, 1.0, -1.0]))
    message = message_of(replace(recording.only(0), imus=(mirrored,)))
    assert "cam0 with imu0: gyro" in message
    other = replace(imu, accelerometer=imu.accelerometer[:, [1, 0, 2]])
    found = find_start(replace(recording.only(0), imus=(other,)))
    (note,) = found.notes
    assert "of the accelerometer's variance only: are its axes those of the gyroscope" in note


def test_gaps_between_images(simulated):
    """Three seconds of ten without images: the spline through the poses has to be led through calmly."""
    recording = simulated.recording
    gap = [(c.t_ns - c.t_ns[0] < 4 * NS) | (c.t_ns - c.t_ns[0] > 7 * NS) for c in recording.corners]
    some = replace(
        recording, corners=tuple(c.select(images) for c, images in zip(recording.corners, gap, strict=True))
    )
    check_start(find_start(some), simulated, simulated.time_offset)


def test_no_imu(recording):
    assert "at least one IMU" in message_of(replace(recording, imus=(), noise=()))


# ---------------------------------------------------------------------- the real recording


@pytest.mark.realdata
@pytest.mark.slow
def test_real_recording(shared_data):
    real = shared_data / "camera_imu_april"
    recording = read_recording(
        real / "config.yaml", [real / "cam0_corners.npz", real / "cam1_corners.npz"], [real / "imu0.csv.gz"]
    )
    found = find_start(recording)
    # What independent poses of each image reach, see the data's own notes.
    assert [float(board.rms.median()) for board in found.boards] == pytest.approx([0.46, 0.48], abs=0.01)
    assert all(bool(board.good.all()) for board in found.boards)
    # The stereo pair is 11 cm wide and almost parallel; its cameras see the same board.
    between = SE3.compose(SE3.inverse(found.T_imu_cam[0]), found.T_imu_cam[1])
    assert float(between[:3].norm()) == pytest.approx(0.110, abs=0.01)
    assert float(SO3.log(between[3:]).norm()) < math.radians(1.5)
    assert float(found.time_offset.abs().max()) < 2e-3
    # Swapping the cameras' files still gives poses, and is not an error; but the fit says so.
    swapped = replace(recording, corners=recording.corners[::-1])
    assert any("swapped" in note for note in find_start(swapped).notes)
