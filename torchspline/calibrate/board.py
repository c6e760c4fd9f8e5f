"""Where the board was in each image by itself: a homography, the pose in it, and least squares on pixels.

Images are worked on in blocks of similar numbers of corners, padded to the same number: whole arrays, small enough to
stay in the processor's cache. NumPy's, since PyTorch would spread each of these small operations over threads.
"""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchspline import checks
from torchspline.arithmetic.camera import CAMERA_MODELS
from torchspline.calibrate.recording import Corners
from torchspline.groups.group import SO3
from torchspline.io.camera import Camera

Array = NDArray[Any]
#: Images a block.
_BLOCK = 64
#: Fewest corners of an image whose pose is looked for; four determine it without a check.
FEWEST = 8
#: Corners on the board have to spread this much across their longest direction.
_NARROW = 0.03
#: Errors beyond (px) count linearly only [Huber], so that single wrong corners do not pull a pose away.
_OUTLIER = 2.0
#: An image does not show this board through this camera where more than a share of its corners is farther off (px).
MISFIT, _WRONG = 5.0, 0.2
#: A corner behind the camera counts as an error of this many pixels.
_HIDDEN = 1e4
_ITERATIONS = 30
#: The cost of an image has settled when a step changes it by less than this share.
_SETTLED = 1e-7
#: Angle to the optical axis up to which corners take part in a homography.
_WIDEST = math.radians(80.0)
#: Trials to find corners that agree, and errors (px) up to which they do, at first and in the end.
_TRIALS, _AGREEING = 80, (8.0, MISFIT)
#: Why an image has no pose.
REASONS = (
    "",
    f"fewer than {FEWEST} corners",
    "corners on a line",
    f"too many corners off by more than {MISFIT:g} px",
)


@dataclass(frozen=True, eq=False)
class BoardPoses:
    """Pose of the board in each of F images, found from that image alone."""

    #: (F,) int64 nanoseconds on the camera's clock.
    t_ns: Tensor
    #: (F, 7) SE3: maps points of the board into the frame of the camera. NaN where `reason` is not 0.
    T_cam_board: Tensor
    #: (F,) root mean square length of the reprojection errors, px; NaN where no pose was looked for.
    rms: Tensor
    #: (C, 2) where the corners should have been seen, minus where they were, px; NaN where no pose was looked for.
    error: Tensor
    #: (F,) int64: 0 where the pose is good, else an index into `board.REASONS`.
    reason: Tensor
    #: Things a careful user wants to know, in words.
    notes: list[str] = field(default_factory=list)

    @property
    def good(self) -> Tensor:
        """(F,) bool, whether there is a pose."""
        return self.reason == 0

    def median_error(self) -> float:
        """Median length of the reprojection errors of corners in good images, px; NaN if there are none."""
        lengths = self.error.norm(dim=1)
        return float(lengths[~lengths.isnan()].median()) if len(lengths) else math.nan


def board_poses(camera: Camera, corners: Corners) -> BoardPoses:
    """Pose of the board in each image, from nothing but its corners and the intrinsics.

    Corners are undistorted; a homography from the plane of the board comes from the normalised direct linear transform
    [Hartley and Zisserman, algorithm 4.2] and gives a pose [Zhang 2000, section 3.1]; Levenberg-Marquardt on the
    distorted pixels refines it, errors beyond 2 px counted linearly. Cost is linear in corners.

    Args:
        camera: intrinsics and distortion, taken as known.
        corners: of that camera.
    Returns:
        BoardPoses. Images with too few corners, with corners on a line or with errors that no pose explains have none.
    Raises:
        TypeError: a wrong type.
    """
    checks.instance("camera", camera, Camera, "a torchspline.calibrate.Camera")
    checks.instance("corners", corners, Corners, "torchspline.calibrate.Corners")
    first = corners.first.numpy()
    counts = np.diff(first)
    reason = np.zeros(len(counts), np.int64)
    reason[_narrow(corners, counts)] = 2
    reason[counts < FEWEST] = 1
    pose, rotation = np.full((len(counts), 7), math.nan), np.tile(np.eye(3), (len(counts), 1, 1))
    rms = np.full(len(counts), math.nan)
    error = np.full((len(corners), 2), math.nan)
    tried = np.flatnonzero(reason == 0)
    tried = tried[np.argsort(counts[tried], kind="stable")]
    for begin in range(0, len(tried), _BLOCK):
        images = tried[begin : begin + _BLOCK]
        block = _gather(corners, first[images], counts[images])
        R, t, residual = _refine(camera, block, *_start(camera, block))
        rotation[images], pose[images, :3] = R, t
        rms[images] = np.sqrt((residual**2).sum(axis=(0, 2)) / counts[images])
        error[block.rows[block.there]] = residual[:, block.there].T
    pose[:, 3:] = SO3.from_matrix(torch.from_numpy(rotation)).numpy()
    far = np.bincount(corners.frame.numpy(), np.hypot(*error.T) > MISFIT, len(counts))
    reason[(reason == 0) & (far > _WRONG * counts)] = 3
    pose[reason != 0] = math.nan
    notes = [
        f"{camera.name}: {count} of {len(counts)} images have no board pose: {REASONS[why]}"
        for why in range(1, len(REASONS))
        if (count := int((reason == why).sum()))
    ]
    pose_, rms_, error_, reason_ = map(torch.from_numpy, (pose, rms, error, reason))
    return BoardPoses(corners.t_ns, pose_, rms_, error_, reason_, notes)


def _narrow(corners: Corners, counts: Array) -> Array:
    """(F,) whether the corners of an image lie on a line of the board, or nearly so."""
    frame, (x, y, _) = corners.frame.numpy(), corners.xyz.numpy().T
    n = counts.clip(1)

    def mean(z: Array) -> Array:
        return np.bincount(frame, z, len(counts)) / n

    x, y = x - mean(x)[frame], y - mean(y)[frame]
    xx, xy, yy = mean(x * x), mean(x * y), mean(y * y)
    # Variances along and across the longest direction.
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    return middle - half <= _NARROW**2 * (middle + half)


def contradictions(camera: Camera, corners: Corners, images: Tensor) -> tuple[Tensor, Tensor]:
    """Corners of some images that contradict the largest number of others that agree on a pose of the board.

    Homographies from four corners at a time; of those the one with which most corners agree, as long as a good part of
    them does [Fischler and Bolles 1981].

    Args:
        images: (B,) which, each with as many corners as a pose needs.
    Returns:
        Rows of corners that do not agree, and for each image the share of its corners that do, (B,).
    """
    first = corners.first.numpy()
    chosen = images.numpy()
    block = _gather(corners, first[chosen], np.diff(first)[chosen])
    a, b, valid = _undistort(camera, block.u, block.v)
    usable = block.there & valid
    random = np.random.default_rng(0).random((len(chosen), _TRIALS, usable.shape[1])) + ~usable[:, None]
    four = np.argsort(random, axis=2)[:, :, :4]
    weight = np.zeros(random.shape)
    np.put_along_axis(weight, four, 1.0, axis=2)

    def agreeing(weight: Array, limit: float) -> Array:
        """(B, trials, C) corners that agree with the homography from those of some weight."""
        trials = weight.shape[1]
        x, y, p, q = (np.repeat(z, trials, axis=0) for z in (block.x, block.y, a, b))
        H = _homography(x, y, p, q, weight.reshape(-1, weight.shape[2]))
        seen = H @ np.stack([x, y, np.ones_like(x)], axis=1)
        depth = np.where(np.abs(seen[:, 2]) < 1e-12, 1e-12, seen[:, 2])
        error = np.hypot(
            (seen[:, 0] / depth - p) * camera.intrinsics[0], (seen[:, 1] / depth - q) * camera.intrinsics[1]
        )
        return (error < limit).reshape(weight.shape) & usable[:, None]

    found = agreeing(weight, _AGREEING[0])
    best = found[np.arange(len(chosen)), found.sum(axis=2).argmax(axis=1)]
    for _ in range(3):
        best = agreeing(best[:, None].astype(np.float64), _AGREEING[1])[:, 0]
    share = best.sum(axis=1) / usable.sum(axis=1).clip(1)
    return torch.from_numpy(block.rows[usable & ~best]), torch.from_numpy(share)


class _Block(NamedTuple):
    """Corners of B images, padded to C: rows of `Corners` and whether they are there; pixels and board coordinates."""

    rows: Array
    there: Array
    u: Array
    v: Array
    x: Array
    y: Array


def _gather(corners: Corners, first: Array, counts: Array) -> _Block:
    steps = np.arange(counts.max())
    there = steps < counts[:, None]
    rows = np.where(there, first[:, None] + steps, first[:, None])
    u, v = corners.uv.numpy().T
    x, y, _ = corners.xyz.numpy().T
    return _Block(rows, there, u[rows], v[rows], x[rows], y[rows])


# ---------------------------------------------------------------------- a start from nothing


def _start(camera: Camera, block: _Block) -> tuple[Array, Array]:
    """Rotation matrices (B, 3, 3) and translations (B, 3), board to camera, from homographies."""
    a, b, valid = _undistort(camera, block.u, block.v)
    weight = (block.there & valid).astype(np.float64)
    H = _homography(block.x, block.y, a, b, weight)
    # Depth is positive where the corners are.
    n = weight.sum(axis=1).clip(1.0)
    mean = np.stack([(weight * block.x).sum(1) / n, (weight * block.y).sum(1) / n, np.ones_like(n)], axis=1)
    depth = (H[:, 2] * mean).sum(axis=1)
    size = np.sqrt(np.linalg.norm(H[:, :, 0], axis=1) * np.linalg.norm(H[:, :, 1], axis=1)).clip(1e-12)
    H = H * (np.where(depth < 0, -1.0, 1.0) / size)[:, None, None]
    matrix = np.stack([H[..., 0], H[..., 1], np.cross(H[..., 0], H[..., 1])], axis=-1)
    U, _, Vh = np.linalg.svd(matrix)
    turn = np.linalg.det(U @ Vh)
    U = np.concatenate([U[..., :2], U[..., 2:] * turn[:, None, None]], axis=-1)
    return U @ Vh, H[..., 2]


def _undistort(camera: Camera, u: Array, v: Array) -> tuple[Array, Array, Array]:
    """Coordinates x/z and y/z of the rays through pixels, by Newton's method, and whether it found them."""
    fu, fv, pu, pv = camera.intrinsics
    k = camera.coefficients
    x, y = (u - pu) / fu, (v - pv) / fv
    if camera.distortion == "equidistant":
        r = np.hypot(x, y)
        theta = r
        for _ in range(8):
            s = theta * theta
            value = theta * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
            slope = 1 + s * (3 * k[0] + s * (5 * k[1] + s * (7 * k[2] + s * 9 * k[3])))
            theta = theta - (value - r) / slope
        found = (np.abs(value - r) < 1e-6) & (theta < _WIDEST) & (theta >= 0)
        stretch = np.where(found, np.tan(theta.clip(0.0, _WIDEST)), 0.0) / r.clip(1e-12)
        return x * stretch, y * stretch, found
    model, one = CAMERA_MODELS[camera.distortion], np.ones_like(x)
    a, b = x, y
    for _ in range(8):
        at = (a, b, one)
        p, q = model.distort(at, k)
        (paa, pab, _), _ = model.distort_reverse(at, k, (1.0, 0.0))
        (qaa, qab, _), _ = model.distort_reverse(at, k, (0.0, 1.0))
        determinant = paa * qab - pab * qaa
        da, db = (qab * (p - x) - pab * (q - y)) / determinant, (paa * (q - y) - qaa * (p - x)) / determinant
        a, b = a - da, b - db
        if max(np.abs(da).max(), np.abs(db).max()) < 1e-7:
            break
    found = (np.hypot(da, db) < 1e-6) & (np.hypot(a, b) < math.tan(_WIDEST))
    return np.where(found, a, 0.0), np.where(found, b, 0.0), found


def _homography(x: Array, y: Array, a: Array, b: Array, weight: Array) -> Array:
    """(B, 3, 3) from the plane (x, y) to the plane (a, b), by the normalised direct linear transform."""
    n = weight.sum(axis=1, keepdims=True).clip(1.0)

    def normal(p: Array, q: Array) -> tuple[Array, Array, Array]:
        """Coordinates with mean 0 and mean distance sqrt(2), and the matrix that makes them so."""
        centre = (weight * p).sum(1, keepdims=True) / n, (weight * q).sum(1, keepdims=True) / n
        p, q = p - centre[0], q - centre[1]
        scale = math.sqrt(2.0) / ((weight * np.hypot(p, q)).sum(1, keepdims=True) / n).clip(1e-12)
        zero, one = np.zeros_like(scale), np.ones_like(scale)
        rows = ([scale, zero, -scale * centre[0]], [zero, scale, -scale * centre[1]], [zero, zero, one])
        return p * scale, q * scale, np.stack([np.concatenate(row, axis=1) for row in rows], axis=1)

    x, y, from_board = normal(x, y)
    a, b, from_image = normal(a, b)
    m = np.stack([x, y, np.ones_like(x)], axis=1)  # (B, 3, C)

    def moment(factor: Array) -> Array:
        return (m * (weight * factor)[:, None]) @ m.swapaxes(1, 2)

    S, A, B, both = moment(np.ones_like(a)), moment(-a), moment(-b), moment(a * a + b * b)
    zero = np.zeros_like(S)
    rows = ([S, zero, A], [zero, S, B], [A, B, both])
    matrix = np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1)
    H = np.linalg.eigh(matrix)[1][..., 0].reshape(-1, 3, 3)
    return np.linalg.solve(from_image, H @ from_board)


# ---------------------------------------------------------------------- least squares on pixels


class _State(NamedTuple):
    """Robust cost (B,), residuals (2, B, C) px, normal matrix (B, 6, 6) and gradient (B, 6)."""

    cost: Array
    residual: Array
    matrix: Array
    gradient: Array


def _linearize(camera: Camera, block: _Block, R: Array, t: Array) -> _State:
    """At poses `p_cam = R p_board + t`; steps (v, w) change p_cam by v + w x p_cam."""
    model, k = CAMERA_MODELS[camera.distortion], camera.coefficients
    fu, fv, pu, pv = camera.intrinsics
    x, y = block.x, block.y
    p = [R[:, i, 0, None] * x + R[:, i, 1, None] * y + t[:, i, None] for i in range(3)]
    point, shown = model.visible(tuple(p))
    plane = model.distort(point, k)
    there = block.there.astype(np.float64) * shown
    hidden = _HIDDEN * (block.there & (shown == 0))
    residual = np.stack(
        [(fu * plane[0] + pu - block.u) * there + hidden, (fv * plane[1] + pv - block.v) * there]
    )
    length = np.sqrt(residual[0] * residual[0] + residual[1] * residual[1])
    far = length > _OUTLIER
    weight = np.where(far, _OUTLIER / length.clip(_OUTLIER), 1.0) * there
    cost = np.where(far, _OUTLIER * (2.0 * length - _OUTLIER), length * length)
    root = np.sqrt(weight)
    rows = []
    for focal, unit, e in zip((fu, fv), ((1.0, 0.0), (0.0, 1.0)), residual, strict=True):
        (gx, gy, gz), _ = model.distort_reverse(point, k, unit)
        f = focal * root
        gx, gy, gz = gx * f, gy * f, gz * f
        turning = (p[1] * gz - p[2] * gy, p[2] * gx - p[0] * gz, p[0] * gy - p[1] * gx)
        rows.append(np.stack([gx, gy, gz, *turning, e * root], axis=1))
    J = np.concatenate(rows, axis=2)  # (B, 7, 2C)
    gram = J @ J.swapaxes(1, 2)
    return _State(cost.sum(axis=1), residual, gram[:, :6, :6], gram[:, :6, 6])


def _refine(camera: Camera, block: _Block, R: Array, t: Array) -> tuple[Array, Array, Array]:
    """Poses at the minimum of the robust cost and their residuals (2, B, C), px."""
    state = _linearize(camera, block, R, t)
    damping = np.full_like(state.cost, 1e-6)
    done = np.zeros_like(state.cost, dtype=bool)
    for _ in range(_ITERATIONS):
        diagonal = state.matrix[:, range(6), range(6)]
        damped = state.matrix.copy()
        damped[:, range(6), range(6)] += damping[:, None] * diagonal + 1e-9
        step = -np.linalg.solve(damped, state.gradient[..., None])[..., 0]
        turn = Rotation.from_rotvec(step[:, 3:]).as_matrix()
        tried = turn @ R, (turn @ t[..., None])[..., 0] + step[:, :3]
        after = _linearize(camera, block, *tried)
        better = after.cost <= state.cost
        done |= (
            (np.abs(state.cost - after.cost) <= _SETTLED * state.cost)
            | (state.cost < 1e-12)
            | (damping > 1e8)
        )
        R, t = np.where(better[:, None, None], tried[0], R), np.where(better[:, None], tried[1], t)
        state = _State(
            np.where(better, after.cost, state.cost),
            np.where(better[:, None], after.residual, state.residual),
            np.where(better[:, None, None], after.matrix, state.matrix),
            np.where(better[:, None], after.gradient, state.gradient),
        )
        damping = np.where(better, damping * 0.1, damping * 10.0).clip(1e-12)
        if done.all():
            break
    return R, t, state.residual
