"""Where the board was in each image by itself: a homography, the pose in it, and least squares on pixels.

Images are worked on in blocks of similar numbers of corners, padded to the same number: whole arrays, small enough to
stay in the processor's cache. Threads do not help: the interpreter starts small operations one at a time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.calibrate.recording import Corners
from torchspline.fit.residuals import ReprojectionEquidistant, ReprojectionRadtan
from torchspline.groups.group import SO3
from torchspline.io.camera import Camera

#: Images a block.
_BLOCK = 64
#: Fewest corners of an image whose pose is looked for; four determine it without a check.
FEWEST = 8
#: Corners on the board have to spread this much across their longest direction.
_NARROW = 0.03
#: Errors beyond (px) count linearly only [Huber], so that single wrong corners do not pull a pose away.
_OUTLIER = 2.0
#: Root mean square (px) above which an image does not show this board through this camera.
MISFIT = 5.0
#: A corner behind the camera costs as much as an error of this many pixels.
_HIDDEN = 1e3
_ITERATIONS = 30
#: The cost of an image has settled when a step changes it by less than this share.
_SETTLED = 1e-7
#: Angle to the optical axis up to which corners take part in a homography.
_WIDEST = math.radians(80.0)
_MODELS: dict[str, Any] = {"radtan": ReprojectionRadtan, "equidistant": ReprojectionEquidistant}
#: Why an image has no pose.
REASONS = ("", f"fewer than {FEWEST} corners", "corners on a line", f"more than {MISFIT:g} px RMS")


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
    first = corners.first
    counts = first.diff()
    reason = torch.zeros(len(counts), dtype=torch.int64)
    reason[_narrow(corners, counts)] = 2
    reason[counts < FEWEST] = 1
    pose = torch.full((len(counts), 7), math.nan, dtype=torch.float64)
    rms = torch.full((len(counts),), math.nan, dtype=torch.float64)
    error = torch.full((len(corners), 2), math.nan, dtype=torch.float64)

    tried = torch.nonzero(reason == 0).flatten()
    tried = tried[torch.argsort(counts[tried], stable=True)]

    def solve(images: Tensor) -> None:
        block = _gather(corners, first[images], counts[images])
        rotation, translation, residual = _refine(camera, block, *_start(camera, block))
        pose[images] = torch.cat([translation, SO3.from_matrix(rotation)], dim=1)
        rms[images] = (residual.square().sum(dim=(0, 2)) / counts[images]).sqrt()
        error[block.rows[block.there]] = residual[:, block.there].T

    with torch.no_grad():
        for images in tried.split(_BLOCK):
            solve(images)
    reason[rms > MISFIT] = 3
    pose[reason != 0] = math.nan
    notes = [
        f"{camera.name}: {count} of {len(counts)} images have no board pose: {REASONS[why]}"
        for why in range(1, len(REASONS))
        if (count := int((reason == why).sum()))
    ]
    return BoardPoses(corners.t_ns, pose, rms, error, reason, notes)


def _narrow(corners: Corners, counts: Tensor) -> Tensor:
    """(F,) whether the corners of an image lie on a line of the board, or nearly so."""
    frame, x, y = corners.frame, corners.xyz[:, 0], corners.xyz[:, 1]
    n = counts.clamp_min(1).to(torch.float64)

    def mean(z: Tensor) -> Tensor:
        return torch.zeros(len(counts), dtype=torch.float64).index_add_(0, frame, z) / n

    x, y = x - mean(x)[frame], y - mean(y)[frame]
    xx, xy, yy = mean(x * x), mean(x * y), mean(y * y)
    # Variances along and across the longest direction.
    middle, half = 0.5 * (xx + yy), torch.hypot(0.5 * (xx - yy), xy)
    return middle - half <= _NARROW**2 * (middle + half)


class _Block(NamedTuple):
    """Corners of B images, padded to C: rows of `Corners` and whether they are there; pixels and board coordinates."""

    rows: Tensor
    there: Tensor
    u: Tensor
    v: Tensor
    x: Tensor
    y: Tensor


def _gather(corners: Corners, first: Tensor, counts: Tensor) -> _Block:
    steps = torch.arange(int(counts.max()))
    there = steps < counts[:, None]
    rows = torch.where(there, first[:, None] + steps, first[:, None])
    return _Block(rows, there, *corners.uv[rows].unbind(-1), *corners.xyz[rows][..., :2].unbind(-1))


# ---------------------------------------------------------------------- a start from nothing


def _start(camera: Camera, block: _Block) -> tuple[Tensor, Tensor]:
    """Rotation matrices (B, 3, 3) and translations (B, 3), board to camera, from homographies."""
    a, b, valid = _undistort(camera, block.u, block.v)
    weight = (block.there & valid).to(torch.float64)
    H = _homography(block.x, block.y, a, b, weight)
    # Depth is positive where the corners are.
    n = weight.sum(dim=1).clamp_min(1.0)
    mean = torch.stack(
        [(weight * block.x).sum(1) / n, (weight * block.y).sum(1) / n, torch.ones_like(n)], dim=1
    )
    depth = (H[:, 2] * mean).sum(dim=1)
    size = (H[:, :, 0].norm(dim=1) * H[:, :, 1].norm(dim=1)).sqrt().clamp_min(1e-12)
    H = H * (torch.where(depth < 0, -1.0, 1.0) / size)[:, None, None]
    matrix = torch.stack([H[..., 0], H[..., 1], torch.linalg.cross(H[..., 0], H[..., 1])], dim=-1)
    U, _, Vh = torch.linalg.svd(matrix)
    turn = torch.linalg.det(U @ Vh)
    U = torch.cat([U[..., :2], U[..., 2:] * turn[:, None, None]], dim=-1)
    return U @ Vh, H[..., 2]


def _undistort(camera: Camera, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates x/z and y/z of the rays through pixels, by Newton's method, and whether it found them."""
    fu, fv, pu, pv = camera.intrinsics
    k = camera.coefficients
    x, y = (u - pu) / fu, (v - pv) / fv
    if camera.distortion == "equidistant":
        r = torch.hypot(x, y)
        theta = r.clone()
        for _ in range(8):
            s = theta * theta
            value = theta * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
            slope = 1 + s * (3 * k[0] + s * (5 * k[1] + s * (7 * k[2] + s * 9 * k[3])))
            theta = theta - (value - r) / slope
        found = ((value - r).abs() < 1e-6) & (theta < _WIDEST) & (theta >= 0)
        stretch = torch.where(found, theta.clamp(0.0, _WIDEST).tan(), 0.0) / r.clamp_min(1e-12)
        return x * stretch, y * stretch, found
    model, one = _MODELS[camera.distortion], torch.ones_like(x)
    a, b = x, y
    for _ in range(8):
        at = (a, b, one)
        p, q = model._distort(at, k)
        (paa, pab, _), _ = model._distort_reverse(at, k, (1.0, 0.0))
        (qaa, qab, _), _ = model._distort_reverse(at, k, (0.0, 1.0))
        determinant = paa * qab - pab * qaa
        da, db = (qab * (p - x) - pab * (q - y)) / determinant, (paa * (q - y) - qaa * (p - x)) / determinant
        a, b = a - da, b - db
        if bool(torch.maximum(da.abs(), db.abs()).max() < 1e-7):
            break
    found = (torch.hypot(da, db) < 1e-6) & (torch.hypot(a, b) < math.tan(_WIDEST))
    return torch.where(found, a, 0.0), torch.where(found, b, 0.0), found


def _homography(x: Tensor, y: Tensor, a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """(B, 3, 3) from the plane (x, y) to the plane (a, b), by the normalised direct linear transform."""
    n = weight.sum(dim=1, keepdim=True).clamp_min(1.0)

    def normal(p: Tensor, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coordinates with mean 0 and mean distance sqrt(2), and the matrix that makes them so."""
        centre = (weight * p).sum(1, keepdim=True) / n, (weight * q).sum(1, keepdim=True) / n
        p, q = p - centre[0], q - centre[1]
        scale = math.sqrt(2.0) / ((weight * torch.hypot(p, q)).sum(1, keepdim=True) / n).clamp_min(1e-12)
        zero, one = torch.zeros_like(scale), torch.ones_like(scale)
        rows = ([scale, zero, -scale * centre[0]], [zero, scale, -scale * centre[1]], [zero, zero, one])
        return p * scale, q * scale, torch.stack([torch.cat(row, dim=1) for row in rows], dim=1)

    x, y, from_board = normal(x, y)
    a, b, from_image = normal(a, b)
    m = torch.stack([x, y, torch.ones_like(x)], dim=1)  # (B, 3, C)

    def moment(factor: Tensor) -> Tensor:
        return (m * (weight * factor)[:, None]) @ m.mT

    S, A, B, both = moment(torch.ones_like(a)), moment(-a), moment(-b), moment(a * a + b * b)
    zero = torch.zeros_like(S)
    rows = ([S, zero, A], [zero, S, B], [A, B, both])
    matrix = torch.cat([torch.cat(row, dim=2) for row in rows], dim=1)
    H = torch.linalg.eigh(matrix).eigenvectors[..., 0].reshape(-1, 3, 3)
    return torch.linalg.solve(from_image, H @ from_board)


# ---------------------------------------------------------------------- least squares on pixels


class _State(NamedTuple):
    """Robust cost (B,), residuals (2, B, C) px, normal matrix (B, 6, 6) and gradient (B, 6)."""

    cost: Tensor
    residual: Tensor
    matrix: Tensor
    gradient: Tensor


def _linearize(camera: Camera, block: _Block, R: Tensor, t: Tensor) -> _State:
    """At poses `p_cam = R p_board + t`; steps (v, w) change p_cam by v + w x p_cam."""
    model, k = _MODELS[camera.distortion], camera.coefficients
    fu, fv, pu, pv = camera.intrinsics
    x, y = block.x, block.y
    p = [R[:, i, 0, None] * x + R[:, i, 1, None] * y + t[:, i, None] for i in range(3)]
    point, shown = model._visible(tuple(p))
    plane = model._distort(point, k)
    there = block.there.to(torch.float64) * shown
    residual = torch.stack([(fu * plane[0] + pu - block.u) * there, (fv * plane[1] + pv - block.v) * there])
    length = (residual[0] * residual[0] + residual[1] * residual[1]).sqrt()
    far = length > _OUTLIER
    weight = torch.where(far, _OUTLIER / length.clamp_min(_OUTLIER), 1.0) * there
    cost = torch.where(far, _OUTLIER * (2.0 * length - _OUTLIER), length.square())
    cost = cost + (block.there & (shown == 0)) * _HIDDEN**2
    root = weight.sqrt()
    rows = []
    for focal, unit, e in zip((fu, fv), ((1.0, 0.0), (0.0, 1.0)), residual, strict=True):
        (gx, gy, gz), _ = model._distort_reverse(point, k, unit)
        f = focal * root
        gx, gy, gz = gx * f, gy * f, gz * f
        turning = (p[1] * gz - p[2] * gy, p[2] * gx - p[0] * gz, p[0] * gy - p[1] * gx)
        rows.append(torch.stack([gx, gy, gz, *turning, e * root], dim=1))
    J = torch.cat(rows, dim=2)  # (B, 7, 2C)
    gram = J @ J.mT
    return _State(cost.sum(dim=1), residual, gram[:, :6, :6], gram[:, :6, 6])


def _refine(camera: Camera, block: _Block, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Poses at the minimum of the robust cost and their residuals (2, B, C), px."""
    state = _linearize(camera, block, R, t)
    damping = torch.full_like(state.cost, 1e-6)
    done = torch.zeros_like(state.cost, dtype=torch.bool)
    for _ in range(_ITERATIONS):
        diagonal = state.matrix.diagonal(dim1=1, dim2=2)
        damped = state.matrix + torch.diag_embed(damping[:, None] * diagonal + 1e-12)
        step = -torch.linalg.solve_ex(damped, state.gradient).result
        turn = SO3.to_matrix(SO3.exp(step[:, 3:], validate=False), validate=False)
        tried = turn @ R, (turn @ t[..., None])[..., 0] + step[:, :3]
        after = _linearize(camera, block, *tried)
        better = after.cost <= state.cost
        done |= (
            ((state.cost - after.cost).abs() <= _SETTLED * state.cost)
            | (state.cost < 1e-12)
            | (damping > 1e8)
        )
        R, t = _choose(better, tried, (R, t))
        state = _State(
            *_choose(better, after[:1], state[:1]),
            torch.where(better[None, :, None], after.residual, state.residual),
            *_choose(better, after[2:], state[2:]),
        )
        damping = torch.where(better, damping * 0.1, damping * 10.0).clamp_min(1e-12)
        if bool(done.all()):
            break
    return R, t, state.residual


def _choose(condition: Tensor, yes: Sequence[Tensor], no: Sequence[Tensor]) -> list[Tensor]:
    return [
        torch.where(condition.reshape(-1, *(1,) * (a.ndim - 1)), a, b) for a, b in zip(yes, no, strict=True)
    ]
