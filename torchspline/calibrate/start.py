"""Where a calibration starts, from nothing but the recording: no extrinsics, offsets or gravity given by hand."""

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchspline import checks
from torchspline.calibrate.board import FEWEST, MISFIT, BoardPoses, board_poses, contradictions
from torchspline.calibrate.recording import Corners, Recording
from torchspline.fit import Alignment, align_imu, fit_poses
from torchspline.groups.group import SE3, SO3
from torchspline.io.camera import Camera
from torchspline.io.records import ImuRecord
from torchspline.splines.bspline import BSpline
from torchspline.units import SECOND

Array = NDArray[Any]
#: Fewest images with a board pose, and the largest share of images with corners that may contradict the board.
_FEWEST_IMAGES, _MOST_MISFITS = 20, 0.3
#: Share of corners far off in good images that is worth a note.
_SPOILED = 0.002
#: Of the latter so many are looked at closely: a good part of an image's corners have to agree before others are
#: blamed, and of a tag's corners such a part has to be off before the tag is named.
_LOOKED_AT, _AGREEING, _MISLABELLED, _MOST_TAGS = 12, 0.3, 0.75, 0.8
#: Knots of the first spline: this many image intervals apart, at least so many seconds.
_KNOT_INTERVALS, _SHORTEST_KNOT = 2.0, 0.05
_ORDER = 6
#: Of that spline: enough to lead it calmly through gaps between images, too little to be felt where there are some.
_SMOOTHNESS = 1e-3
#: Poses this many times farther from the spline than the median are left out of it.
_STRAY = 50.0
#: IMU readings are averaged until only so many are left for each image: faster, and all that the first spline can use.
_READINGS_PER_IMAGE = 2.5
#: Images of each camera that are tried with the intrinsics of the others, too, and by how much those have to do better
#: (difference of mean logarithms of the RMS, a camera): two units of one model differ by a tenth.
_TRIED, _BETTER = 50, 0.05
#: Clocks farther apart than this (s) are worth a note, as are directions of gravity (rad).
_APART, _TILTED = 0.1, math.radians(3.0)
#: Median length of an accelerometer's readings as a share of gravity.
_AROUND_GRAVITY = (0.5, 2.0)
#: Least shares of the variance of gyroscope and accelerometer that the aligned spline explains, and errors (m/s^2)
#: of the latter below which that does not matter.
_TURNS_EXPLAINED, _FORCE_EXPLAINED, _SMALL_FORCE = 0.5, 0.9, 0.5
#: The size of a board that is so many times wrong is in another unit, in one of these if it is this near.
_WRONG_UNIT, _LIKE = 4.0, 0.15
_UNITS = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254, "km": 1e3}


@dataclass(frozen=True, eq=False)
class Start:
    """Initial values of a calibration of C cameras and I IMUs; the first IMU is the body, the board is the world.

    Good to about a centimetre, a degree and some milliseconds where the motion tells them.
    """

    #: (C, 7) SE3: maps points of the camera into the frame of the first IMU.
    T_imu_cam: Tensor
    #: (C,) s: `t_imu = t_cam + time_offset`, with the clock of the first IMU.
    time_offset: Tensor
    #: (I, 7) SE3: maps points of IMU i into the frame of the first IMU; the first is the identity.
    T_imu0_imu: Tensor
    #: (I,) s: `t_imu_i = t_imu0 + imu_time_offset`; the first is zero.
    imu_time_offset: Tensor
    #: (3,) acceleration vector in the frame of the board, m/s^2.
    gravity: Tensor
    #: (I, 3) what each IMU reads too much, rad/s and m/s^2.
    gyro_bias: Tensor
    accel_bias: Tensor
    #: (N,) int64 nanoseconds on the clock of the first IMU, ascending, and (N, 7) SE3: poses of the first IMU on the
    #: board, points of the IMU into the frame of the board.
    t_ns: Tensor
    T_board_imu: Tensor
    #: Of each camera, image by image.
    boards: tuple[BoardPoses, ...]
    #: Things a careful user wants to know, in words.
    notes: list[str] = field(default_factory=list)


def find_start(recording: Recording, *, max_offset: float | None = 10.0) -> Start:
    """Initial values from nothing: poses of the board, a spline through them, and its alignment with each IMU.

    For each camera: `board_poses`; a split spline of order 6 through them; `fit.align_imu`, which finds the time offset
    by correlation of angular speeds, the rotation from Wahba's problem, lever arm, biases and gravity.

    Args:
        recording: with at least one camera and one IMU.
        max_offset: how far the clocks of cameras and IMUs may be apart, s, beyond time offsets that the recording
            knows; None for any distance at which they overlap.
    Returns:
        Start.
    Raises:
        TypeError, ValueError: a wrong type; no IMU; corners that contradict the board, too few images, no motion, no
        overlap, or readings and images that have nothing in common: the message says what to look at.
    """
    checks.instance("recording", recording, Recording, "a torchspline.calibrate.Recording")
    if not recording.imus:
        raise ValueError("recording: expected at least one IMU, got none")
    if max_offset is not None:
        checks.positive("max_offset", max_offset)
    boards = tuple(map(board_poses, recording.cameras, recording.corners))
    notes = [note for board in boards for note in board.notes]
    swapped = _swapped(recording, boards)
    for i, board in enumerate(boards):
        _check_images(recording, i, board, swapped, notes)
    notes += [swapped] if swapped else []
    splines = [_spline(recording, i, board, notes) for i, board in enumerate(boards)]
    aligned = [_aligned(recording, i, 0, spline, max_offset, notes) for i, spline in enumerate(splines)]
    best = max(range(len(boards)), key=lambda i: int(boards[i].good.sum()))
    others = [
        _aligned(recording, best, j, splines[best], max_offset, notes) for j in range(1, len(recording.imus))
    ]
    _compare(recording, aligned, best, notes)
    T_cam_imu = torch.stack([x.T_body_imu for x in aligned])
    T_imu_cam = SE3.inverse(T_cam_imu)
    offset = torch.tensor([x.time_offset for x in aligned], dtype=torch.float64)
    imus = [aligned[best], *others]
    t_ns, T_board_imu = _poses(boards, T_cam_imu, offset, best)
    return Start(
        T_imu_cam=T_imu_cam,
        time_offset=offset,
        T_imu0_imu=torch.stack([SE3.compose(T_imu_cam[best], x.T_body_imu) for x in imus]),
        imu_time_offset=torch.tensor(
            [x.time_offset - aligned[best].time_offset for x in imus], dtype=torch.float64
        ),
        gravity=_known(aligned[best].gravity),
        gyro_bias=torch.stack([x.gyro_bias for x in imus]),
        accel_bias=torch.stack([_known(x.accel_bias) for x in imus]),
        t_ns=t_ns,
        T_board_imu=T_board_imu,
        boards=boards,
        notes=notes,
    )


def with_known_offsets(start: Start, recording: Recording) -> Start:
    """A start with the time offsets that the recording knows, for where they shall stay."""
    if recording.time_offset is None:
        return start
    found = start.time_offset.tolist()
    offsets = [y if x is None else x for x, y in zip(recording.time_offset, found, strict=True)]
    return replace(start, time_offset=torch.tensor(offsets, dtype=torch.float64))


def _known(x: Tensor | None) -> Tensor:
    assert x is not None  # there was an accelerometer
    return x


# ---------------------------------------------------------------------- images


def _check_images(recording: Recording, i: int, board: BoardPoses, swapped: str, notes: list[str]) -> None:
    """Enough of them, and not too many that contradict the board."""
    corners, name = recording.corners[i], recording.cameras[i].name
    where = f"{corners.source or f'corners[{i}]'} ({name})"
    looked = board.reason != 1
    wrong = torch.nonzero(board.reason == 3).flatten()
    good = int(board.good.sum())
    if len(wrong) > _MOST_MISFITS * max(int(looked.sum()), 1):
        camera = recording.cameras[i]
        fits = f", that of the others {float(board.rms[board.good].median()):.2f} px" if good else ""
        raise ValueError(
            f"{where}: expected corners of one flat board seen through the intrinsics given, but {len(wrong)} of "
            f"{int(looked.sum())} images have many corners off by more than {MISFIT:g} px, images {_ranges(wrong)}; "
            f"the median of their RMS is {float(board.rms[wrong].median()):.1f} px{fits}. "
            f"{_suspect(camera, corners, wrong)}"
            f"{f' {swapped}' if swapped else ''}"
        )
    shown = board.good[corners.frame]
    off = shown & (board.error.norm(dim=1) > MISFIT)
    if int(off.sum()) > _SPOILED * int(shown.sum()):
        share = float(off.sum()) / float(shown.sum())
        notes.append(
            f"{name}: {int(off.sum())} corners ({share:.1%}) are more than {MISFIT:g} px off"
            f"{_blamed(corners.tag_id[shown], corners.tag_id[off])}"
        )
    if good < _FEWEST_IMAGES:
        raise ValueError(
            f"{where}: expected at least {_FEWEST_IMAGES} images with {FEWEST} corners or more of the board, got "
            f"{good} of {len(board.t_ns)} images"
        )


def _ranges(rows: Tensor) -> str:
    """Rows in words, such as 3-7, 9, 12-30 and 5 more."""
    numbers = rows.tolist()
    edges = [0, *(i for i, (a, b) in enumerate(pairwise(numbers), 1) if b != a + 1), len(numbers)]
    words = [f"{numbers[a]}-{numbers[b - 1]}" if b > a + 1 else str(numbers[a]) for a, b in pairwise(edges)]
    return ", ".join(words[:6]) + (f" and {len(words) - 6} more stretches" if len(words) > 6 else "")


def _suspect(camera: Camera, corners: Corners, wrong: Tensor) -> str:
    """What may be wrong in these images: some tags, single corners, or everything."""
    looked = wrong[torch.linspace(0, len(wrong) - 1, min(_LOOKED_AT, len(wrong))).long()]
    rows, agreeing = contradictions(camera, corners, looked)
    if float(agreeing.median()) < _AGREEING:
        return (
            "Hardly any corners of an image agree on where the board is: are they mislabelled throughout, is it "
            "another board, or are the intrinsics those of another camera?"
        )
    share = f"{1.0 - float(agreeing.mean()):.0%} of the corners contradict the rest of their image"
    blamed = _blamed(corners.tag_id[torch.isin(corners.frame, looked)], corners.tag_id[rows])
    return f"{share}{blamed or ', all over the board'}: are they mislabelled?"


def _blamed(seen: Tensor, off: Tensor) -> str:
    """In words, tags most of whose corners are off, unless those are almost all there are."""
    names, counts = seen.unique(return_counts=True)
    tags = names[torch.stack([(off == name).sum() for name in names]) > _MISLABELLED * counts].tolist()
    few = 0 < len(tags) < _MOST_TAGS * len(names)
    return f", above all those of tags {', '.join(map(str, tags))}" if few else ""


def _swapped(recording: Recording, boards: tuple[BoardPoses, ...]) -> str:
    """In words, if the images fit the intrinsics of other cameras clearly better; else nothing.

    A look at some images of each camera.
    """
    from scipy.optimize import linear_sum_assignment

    count = len(recording.cameras)
    if count < 2:
        return ""
    cost, median = np.zeros((count, count)), np.zeros((count, count))
    for i, (corners, board) in enumerate(zip(recording.corners, boards, strict=True)):
        usable = torch.nonzero((board.reason != 1) & (board.reason != 2)).flatten()
        if not len(usable):
            return ""
        chosen = torch.zeros(len(board.t_ns), dtype=torch.bool)
        chosen[usable[torch.linspace(0, len(usable) - 1, min(_TRIED, len(usable))).long()]] = True
        some = corners.select(chosen)
        for j, camera in enumerate(recording.cameras):
            rms = board.rms[chosen] if i == j else board_poses(camera, some).rms
            # Image by image: they differ among themselves by more than the intrinsics make.
            cost[i, j], median[i, j] = float((rms + 0.01).log().mean()), float(rms.median())
    rows, columns = linear_sum_assignment(cost)
    if cost[rows, columns].sum() > np.trace(cost) - count * _BETTER:
        return ""
    names = [camera.name for camera in recording.cameras]
    listed = "; ".join(
        f"the corners of {names[i]} fit the intrinsics of {names[j]} with {median[i, j]:.2f} px RMS, their own with "
        f"{median[i, i]:.2f} px"
        for i, j in zip(rows, columns, strict=True)
        if i != j
    )
    return f"Cameras seem to be swapped: {listed}."


# ---------------------------------------------------------------------- motion


def _spline(recording: Recording, i: int, board: BoardPoses, notes: list[str]) -> BSpline:
    """Through the poses of the camera on the board, those that stray far from it left out."""
    t, poses = board.t_ns[board.good], SE3.inverse(board.T_cam_board[board.good])
    dt = max(_KNOT_INTERVALS * float(t.diff().to(torch.float64).median()) / SECOND, _SHORTEST_KNOT)

    def fit(t: Tensor, poses: Tensor) -> Any:
        options: dict[str, Any] = {"smoothness": _SMOOTHNESS, "max_iterations": 10, "tolerance": 1e-4}
        return fit_poses(t, poses, dt=dt, order=_ORDER, progress=False, **options)

    found = fit(t, poses)
    miss = torch.stack([found.position_residual.norm(dim=1), found.rotation_residual.norm(dim=1)])
    limit = _STRAY * miss.median(dim=1, keepdim=True).values + 1e-9
    stray = (miss > limit).any(dim=0)
    # A wrong pose drags the spline along, and with it the residuals of its neighbours.
    if bool(stray.any()):
        found = fit(t[~stray], poses[~stray])
        notes.append(
            f"{recording.cameras[i].name}: {int(stray.sum())} board poses do not fit into the motion"
        )
    return found.trajectory


def _aligned(
    recording: Recording, i: int, j: int, spline: BSpline, max_offset: float | None, notes: list[str]
) -> Alignment:
    """Camera i with IMU j."""
    names = f"{recording.cameras[i].name} with imu{j}"
    imu = _thinned(recording.imus[j], recording.corners[i])
    # IMUs share a clock more likely than not: what is known of the first is where the search begins for all.
    known = (recording.time_offset and recording.time_offset[i]) or 0.0
    imu = replace(imu, time_ns=imu.time_ns - round(known * SECOND))
    length = float(imu.accelerometer.norm(dim=1).median()) if len(imu) else recording.gravity
    if not _AROUND_GRAVITY[0] <= length / recording.gravity <= _AROUND_GRAVITY[1]:
        raise ValueError(
            f"imu{j}: accelerometer: expected specific forces around gravity, {recording.gravity:.4g} m/s^2, got a "
            f"median length of {length:.4g}: are the readings in m/s^2?"
        )
    try:
        found = align_imu(
            spline,
            imu.time_ns,
            imu.gyroscope,
            imu.accelerometer,
            max_offset=max_offset,
            estimate_skew=False,
            estimate_delay=False,
            gravity_magnitude=recording.gravity,
        )
    except ValueError as error:
        raise ValueError(f"{names}: {error}") from None
    found = replace(found, time_offset=found.time_offset + known)
    turns = _explained(imu.gyroscope, found.gyro_rms)
    force, miss = _explained(imu.accelerometer, found.accel_rms or 0.0), found.accel_rms or 0.0
    if turns < _TURNS_EXPLAINED:
        raise ValueError(
            f"{names}: gyroscope: expected readings of the motion that the images show, but no rotation of the sensor "
            f"makes it explain more than {max(turns, 0.0):.0%} of their variance: are axes mirrored or swapped?"
        )
    size, left = _size(spline, imu, found)
    if not 1.0 / _WRONG_UNIT < size < _WRONG_UNIT and left < 0.5 * miss:
        source = recording.corners[i].source or f"corners[{i}]"
        unit = next((name for name, x in _UNITS.items() if abs(size / x - 1.0) < _LIKE), "")
        raise ValueError(
            f"{names}: {source}: expected corners of the board in m, but the motion that they tell is that of the "
            f"accelerometer only if it is multiplied by {size:.3g}{f': they seem to be in {unit}' if unit else ''}"
        )
    if force < _FORCE_EXPLAINED and miss > _SMALL_FORCE:
        notes.append(
            f"{names}: the motion explains {max(force, 0.0):.0%} of the accelerometer's variance only: are its "
            "axes those of the gyroscope, and are the size of the board and the focal lengths right?"
        )
    # Readings far off are the rule here: the first spline is too stiff for the fastest motion. Where they are so far
    # off that more must be wrong, the words above say so.
    usual = "standard deviations off", "the motion leaves"
    notes += [f"{names}: {note}" for note in found.notes if not any(words in note for words in usual)]
    if abs(found.time_offset - known) > _APART:
        notes.append(
            f"{names}: the clocks are {found.time_offset:.3f} s apart (t_imu = t_cam + {found.time_offset:.3f} s)"
        )
    return found


def _size(spline: BSpline, imu: ImuRecord, found: Alignment) -> tuple[float, float]:
    """By what the motion would have to be multiplied for the accelerometer to read it, and what is then left, m/s^2.

    Rotation and clock do not depend on the size of the board: with those the readings are linear in the factor,
    gravity, bias and lever arm.
    """
    t = found.pose_time(imu.time_ns)
    inside = (t >= spline.domain[0]) & (t <= spline.domain[1])
    with torch.no_grad():
        motion = spline.kinematics(t[inside])
    R, a, w, alpha = (
        motion.rotation,
        motion.acceleration,
        motion.angular_velocity,
        motion.angular_acceleration,
    )
    assert R is not None
    assert a is not None
    assert w is not None
    assert alpha is not None
    back, count = SO3.inverse(R), int(inside.sum())
    read = SO3.act(SO3.inverse(found.rotation_imu_body), imu.accelerometer[inside].to(torch.float64))
    axes = [e.expand(count, 3) for e in torch.eye(3, dtype=torch.float64)]
    cross = torch.linalg.cross
    lever = [cross(alpha, e) + cross(w, cross(w, e)) for e in axes]
    columns = [SO3.act(back, a), *(SO3.act(back, e) for e in axes), *lever, *axes]
    matrix = torch.stack(columns, dim=-1).reshape(3 * count, -1)
    scale = matrix.norm(dim=0).clamp_min(1e-300)
    # Without tilting gravity and bias are one: the least of both will do.
    solved = torch.linalg.lstsq(matrix / scale, read.reshape(-1, 1), rcond=1e-6, driver="gelsd").solution
    x = solved[:, 0] / scale
    left = (matrix @ x - read.reshape(-1)).square().mean().sqrt()
    return float(x[0]), float(left)


def _explained(readings: Tensor, rms: float) -> float:
    """Share of their variance that errors of this root mean square leave explained."""
    return 1.0 - rms**2 / max(float(readings.var(dim=0).mean()), 1e-12)


def _thinned(imu: ImuRecord, corners: Corners) -> ImuRecord:
    """Means of neighbouring readings, still several an image."""
    if len(imu) < 2 or len(corners.t_ns) < 2:
        return imu
    intervals = (float(x.diff().to(torch.float64).median()) for x in (corners.t_ns, imu.time_ns))
    ratio = next(intervals) / next(intervals)
    size = max(1, int(ratio / _READINGS_PER_IMAGE))
    count = len(imu) // size
    if size == 1 or count < 2:
        return imu
    begin = imu.time_ns[0]

    def means(x: Tensor) -> Tensor:
        return x[: count * size].reshape(count, size, -1).to(torch.float64).mean(dim=1)

    t = begin + means(imu.time_ns - begin)[:, 0].round().to(torch.int64)
    return ImuRecord(t, means(imu.gyroscope), means(imu.accelerometer), imu.source)


def _compare(recording: Recording, aligned: list[Alignment], best: int, notes: list[str]) -> None:
    """All cameras see the same board: gravity has one direction on it."""
    down = _known(aligned[best].gravity)
    for camera, found in zip(recording.cameras, aligned, strict=True):
        gravity = _known(found.gravity)
        angle = math.atan2(float(torch.linalg.cross(down, gravity).norm()), float(down @ gravity))
        if angle > _TILTED:
            notes.append(
                f"{camera.name}: the direction of gravity on the board differs by {math.degrees(angle):.1f} degrees "
                f"from that found with {recording.cameras[best].name}: do both cameras see the same board at rest?"
            )


def _poses(
    boards: tuple[BoardPoses, ...], T_cam_imu: Tensor, offset: Tensor, best: int
) -> tuple[Tensor, Tensor]:
    """Of the IMU on the board: those of the best camera, and of the others where it has none nearby."""
    t_ns, poses = _of_imu(boards[best], T_cam_imu[best], offset[best])
    near = 0.4 * float(t_ns.diff().to(torch.float64).median())
    for i, board in enumerate(boards):
        if i == best:
            continue
        t, more = _of_imu(board, T_cam_imu[i], offset[i])
        after = torch.searchsorted(t_ns, t).clamp(1, len(t_ns) - 1)
        distance = torch.minimum((t - t_ns[after - 1]).abs(), (t_ns[after] - t).abs())
        alone = distance > near
        t_ns, poses = torch.cat([t_ns, t[alone]]), torch.cat([poses, more[alone]])
        order = torch.argsort(t_ns, stable=True)
        t_ns, poses = t_ns[order], poses[order]
    return t_ns, poses


def _of_imu(board: BoardPoses, T_cam_imu: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    t = board.t_ns[board.good] + round(float(offset) * SECOND)
    return t, SE3.compose(SE3.inverse(board.T_cam_board[board.good]), T_cam_imu)
