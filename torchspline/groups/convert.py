"""Rotations and poses in the conventions of others: xyzw quaternions, matrices, Euler angles, dual quaternions, screws,
SciPy, PyPose, pytorch-kinematics.

A rotation q here is a quaternion [w, x, y, z], a pose is [x, y, z, qw, qx, qy, qz]; both take coordinates of the
body to coordinates of the world. Quaternions may have any length from 1e-15 to 1e15. What is made of tensors is
batched `(...)`, keeps dtype and device and is differentiable to any order unless its docstring says otherwise.
Functions raise `TypeError` for a wrong type or dtype and `ValueError` for a wrong shape or value (values are
looked at on the CPU only).
"""

from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchspline import checks
from torchspline.arithmetic import dual_quaternion, so3
from torchspline.groups.components import join, split
from torchspline.groups.group import SE3, SO3, DualQuaternion

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

#: Every sequence of axes that Euler angles know: upper case is intrinsic, lower case extrinsic, as in SciPy.
EULER_SEQUENCES = tuple(
    "".join(axes)
    for letters in ("XYZ", "xyz")
    for axes in product(letters, repeat=3)
    if axes[0] != axes[1] != axes[2]
)

_POSE_TO_XYZW = (0, 1, 2, 4, 5, 6, 3)
_POSE_FROM_XYZW = (0, 1, 2, 6, 3, 4, 5)

# ---------------------------------------------------------------------- scalar last


def to_xyzw(q: Tensor) -> Tensor:
    """Quaternions [w, x, y, z] as [x, y, z, w], `(..., 4)`; their length stays."""
    return _rotation("q", q).roll(-1, dims=-1)


def from_xyzw(q: Tensor) -> Tensor:
    """Quaternions [x, y, z, w] as [w, x, y, z], `(..., 4)`; their length stays."""
    return _rotation("q", q).roll(1, dims=-1)


def pose_to_xyzw(pose: Tensor) -> Tensor:
    """Poses `(..., 7)` as [x, y, z, qx, qy, qz, qw], the order of TUM files and PyPose; lengths stay."""
    return _reorder(_pose("pose", pose), _POSE_TO_XYZW)


def pose_from_xyzw(pose: Tensor) -> Tensor:
    """Poses `(..., 7)` from [x, y, z, qx, qy, qz, qw], the order of TUM files and PyPose; lengths stay."""
    checks.is_floating_tensor("pose", pose)
    checks.has_last("pose", pose, 7, "a pose [x, y, z, qx, qy, qz, qw]")
    checks.finite("pose", pose)
    checks.quaternions("pose", pose, ((3, 7),))
    return _reorder(pose, _POSE_FROM_XYZW)


# ---------------------------------------------------------------------- matrices and rotation vectors


def to_rotation_matrix(q: Tensor) -> Tensor:
    """Rotation matrices `(..., 3, 3)`, body to world, of quaternions `(..., 4)`."""
    return SO3.to_matrix(_rotation("q", q), validate=False)


def from_rotation_matrix(matrix: Tensor) -> Tensor:
    """Unit quaternions `(..., 4)` of rotation matrices `(..., 3, 3)`; differentiable at half-turns too.

    Gradients are exact along rotations; how the function goes on beside them, where a matrix is none, is arbitrary.

    Raises:
        ValueError: a matrix is off by more than 1e-3.
    """
    return SO3.from_matrix(matrix)


def to_rotation_vector(q: Tensor) -> Tensor:
    """Rotation vectors `(..., 3)`, radians, of quaternions `(..., 4)`; the short way round.

    At a rotation by exactly pi the first non-zero component is positive, and the gradient is that of this side.
    """
    return SO3.log(_rotation("q", q), validate=False)


def from_rotation_vector(vector: Tensor) -> Tensor:
    """Unit quaternions `(..., 4)` of rotation vectors `(..., 3)`, radians, of any length."""
    checks.is_floating_tensor("vector", vector)
    checks.has_last("vector", vector, 3, "a rotation vector")
    checks.finite("vector", vector)
    return SO3.exp(vector, validate=False)


def to_transform_matrix(pose: Tensor) -> Tensor:
    """Homogeneous matrices `(..., 4, 4)`, body to world, of poses `(..., 7)`."""
    return SE3.to_matrix(_pose("pose", pose), validate=False)


def from_transform_matrix(matrix: Tensor) -> Tensor:
    """Poses `(..., 7)` of homogeneous matrices `(..., 4, 4)`; differentiable at half-turns too.

    Raises:
        ValueError: a rotation block or a last row is off by more than 1e-3.
    """
    return SE3.from_matrix(matrix)


# ---------------------------------------------------------------------- Euler angles


def from_euler(angles: Tensor, sequence: str, degrees: bool = False) -> Tensor:
    """Unit quaternions `(..., 4)` of Euler angles `(..., 3)`, in the convention of SciPy.

    Args:
        angles: about the axes of `sequence` in the order they are named.
        sequence: three axes, neighbours different. "XYZ" (upper case) turns about the axes of the body as it
            turns, R = Rx(a0) Ry(a1) Rz(a2); "xyz" (lower case) about those of the world, R = Rz(a2) Ry(a1) Rx(a0).
        degrees: whether the angles are degrees instead of radians.
    Raises:
        ValueError: an unknown sequence.
    """
    checks.choice("sequence", sequence, EULER_SEQUENCES)
    checks.is_floating_tensor("angles", angles)
    checks.has_last("angles", angles, 3, "three angles")
    checks.finite("angles", angles)
    half = 0.5 * (torch.deg2rad(angles) if degrees else angles)
    turns = []
    for axis, cosine, sine in zip(sequence.lower(), split(half.cos()), split(half.sin()), strict=True):
        turns.append((cosine, *(sine if axis == letter else 0.0 for letter in "xyz")))
    first, second, third = turns if sequence.isupper() else reversed(turns)
    return join(so3.multiply(so3.multiply(first, second), third), angles)


def to_euler(q: Tensor, sequence: str, degrees: bool = False) -> Tensor:
    """Euler angles `(..., 3)` of quaternions `(..., 4)`, in the convention of SciPy (see `from_euler`).

    The first and third angle lie in [-pi, pi]; the middle one in [-pi/2, pi/2] if all axes differ, in [0, pi] if
    the first is the third.

    At gimbal lock, where the middle angle ends its range, only a sum or difference of the other two is
    determined. Within rounding of it (8 eps) the third angle is 0 and the middle one exactly at its end, both with
    gradient 0, and the first has the gradient of a turn about its own axis. Everywhere else gradients are exact;
    near gimbal lock they grow as the reciprocal of the distance to it. Values jump where an angle passes pi.

    Args:
        degrees: whether to return degrees instead of radians.
    Raises:
        ValueError: an unknown sequence.
    """
    checks.choice("sequence", sequence, EULER_SEQUENCES)
    w, *v = split(SO3.normalize(_rotation("q", q), validate=False))
    i, j, k = ("xyz".index(axis) for axis in sequence.lower())
    proper = i == k
    if proper:
        k = 3 - i - j
    # Let (i, j, k) be the axes and e_i e_j = sign e_k. Extrinsic turns are multiplied in the opposite order, and
    # quaternions with the order of all products reversed are quaternions with the other sign.
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    if sequence.islower():
        sign = -sign
    x, y, z = v[i], v[j], sign * v[k]
    if not proper:
        # A quarter turn about e_j takes e_k to e_i: q (1 + e_j)/sqrt 2 has the axes i, j, i, the angles
        # first, middle + pi/2, -sign third.
        w, x, y, z = (0.5**0.5 * c for c in (w - y, x - z, y + w, z + x))
    first, middle, third = _proper_angles(w, x, y, z)
    if not proper:
        middle, third = middle - 0.5 * torch.pi, -sign * third
    angles = torch.stack([first, middle, third], dim=-1)
    return torch.rad2deg(angles) if degrees else angles


def _proper_angles(w: Tensor, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """a, b, c of a unit quaternion w + x i + y j + z k = exp(i a/2) exp(j b/2) exp(i c/2).

    Two complex numbers tell them: w + x i = cos(b/2) exp(i (a + c)/2) and y + z i = sin(b/2) exp(i (a - c)/2).
    Their product has the phase a, that of the first with the conjugate of the second has the phase c. This is
    the idea of Bernardes and Viollet, PLoS ONE 17(11), 2022, without sums of angles that need wrapping.
    """
    near, far = w * w + x * x, y * y + z * z
    smallest = (4.0 * torch.finfo(w.dtype).eps) ** 2
    at_zero, at_pi = far <= smallest, near <= smallest
    cosine = torch.where(at_pi, 0.0, torch.where(at_pi, 1.0, near).sqrt())
    sine = torch.where(at_zero, 0.0, torch.where(at_zero, 1.0, far).sqrt())
    # The phase of a vanishing number is free: that of the other one makes c = 0.
    y, z = torch.where(at_zero, w, y), torch.where(at_zero, x, z)
    w, x = torch.where(at_pi, y, w), torch.where(at_pi, z, x)
    a = torch.atan2(w * z + x * y, w * y - x * z)
    c = torch.atan2(x * y - w * z, w * y + x * z)
    return a, 2.0 * torch.atan2(sine, cosine), c


# ---------------------------------------------------------------------- dual quaternions and screws


def pose_to_dual_quaternion(pose: Tensor) -> Tensor:
    """Unit dual quaternions [real(4), dual(4)], `(..., 8)`, of poses `(..., 7)`, [H18] (23) without its spurious q'."""
    unit = SE3.arithmetic.normalize(split(_pose("pose", pose)))
    return join(dual_quaternion.from_pose(unit), pose)


def pose_from_dual_quaternion(Q: Tensor) -> Tensor:
    """Poses `(..., 7)` of dual quaternions `(..., 8)`, whose real parts may have any length but zero."""
    unit = DualQuaternion.arithmetic.normalize(split(_dual_quaternion(Q)))
    return join((*dual_quaternion.DualQuaternion().translation(unit), *unit[:4]), Q)


class Screw(NamedTuple):
    """A rigid motion as a rotation about a line and a translation along it, [H18] (24).

    `angle` (...) in rad, from 0 to pi; `pitch` (...) in m, the whole translation along the axis; `axis` (..., 3), its
    unit direction; `moment` (..., 3) in m, `p x axis` for every point p of the line.
    """

    angle: Tensor
    pitch: Tensor
    axis: Tensor
    moment: Tensor


def to_screw(Q: Tensor) -> Screw:
    """The screw of dual quaternions `(..., 8)`, the short way round.

    Without rotation the axis runs along the translation through the origin; the identity turns about x. Unlike exp,
    log and power, which need no axis, this is not differentiable where the angle is zero.
    """
    v, w = DualQuaternion.log(_dual_quaternion(Q), validate=False).split(3, dim=-1)
    # The square of a smaller angle is not a normal number; the translation of such a rotation differs by less than
    # rounding from a pure one.
    turns = (w * w).sum(-1, keepdim=True) > torch.finfo(Q.dtype).tiny
    slides = (v * v).sum(-1, keepdim=True) > torch.finfo(Q.dtype).tiny
    x_axis = w.new_tensor([1.0, 0.0, 0.0]).expand_as(w)
    line = torch.where(turns, w, torch.where(slides, v, x_axis))
    size = line.norm(dim=-1, keepdim=True)
    axis = line / size
    pitch = (v * axis).sum(-1, keepdim=True)
    angle = torch.where(turns, size, 0.0)
    moment = torch.where(turns, (v - pitch * axis) / torch.where(turns, size, 1.0), 0.0)
    return Screw(angle.squeeze(-1), pitch.squeeze(-1), axis, moment)


def from_screw(angle: Tensor, pitch: Tensor, axis: Tensor, moment: Tensor) -> Tensor:
    """Unit dual quaternions `(..., 8)` of screws: see `Screw`; any angle, `axis` of length one.

    Raises:
        ValueError: an axis whose length is off by more than 1e-3.
    """
    for name, x in (("angle", angle), ("pitch", pitch), ("axis", axis), ("moment", moment)):
        checks.is_floating_tensor(name, x)
        if name in ("axis", "moment"):
            checks.has_last(name, x, 3, "x, y, z")
        checks.finite(name, x)
    checks.same_kind(angle=angle, pitch=pitch, axis=axis, moment=moment)
    checks.broadcast(angle=angle.shape, pitch=pitch.shape, axis=axis.shape[:-1], moment=moment.shape[:-1])
    checks.unit_length("axis", axis, 1e-3)
    angle, pitch = angle.unsqueeze(-1), pitch.unsqueeze(-1)
    v, w = torch.broadcast_tensors(angle * moment + pitch * axis, angle * axis)
    return DualQuaternion.exp(torch.cat([v, w], dim=-1), validate=False)


# ---------------------------------------------------------------------- SciPy


def to_scipy(q: Tensor) -> "Rotation":
    """The `scipy.spatial.transform.Rotation` of quaternions `(..., 4)`: values only, in float64.

    Raises:
        ValueError: more than one batch dimension with a SciPy older than 1.17, which knows no such rotations.
    """
    from scipy.spatial.transform import Rotation

    numbers = SO3.normalize(_rotation("q", q).detach().to("cpu", torch.float64), validate=False)
    try:
        return Rotation.from_quat(numbers.roll(-1, dims=-1).numpy())
    except ValueError:
        if q.ndim <= 2:
            raise
        raise ValueError(
            f"q: expected shape (4,) or (N, 4), all that this SciPy knows, got {tuple(q.shape)}; reshape to "
            "(-1, 4) or install SciPy 1.17"
        ) from None


def from_scipy(
    rotation: "Rotation", dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Unit quaternions `(..., 4)` of a `scipy.spatial.transform.Rotation`."""
    from scipy.spatial.transform import Rotation

    _instance("rotation", rotation, Rotation, "scipy.spatial.transform.Rotation")
    if dtype not in (torch.float32, torch.float64):
        raise TypeError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")
    return torch.as_tensor(rotation.as_quat(), dtype=dtype, device=device).roll(1, dims=-1)


# ---------------------------------------------------------------------- pytorch-kinematics


def to_transform3d(pose: Tensor) -> Any:
    """The `pytorch_kinematics.Transform3d` of poses `(7,)` or `(N, 7)`, body to world; gradients pass.

    Raises:
        ValueError: more than one batch dimension, which a Transform3d does not have.
    """
    from pytorch_kinematics import Transform3d

    _pose("pose", pose)
    if pose.ndim > 2:
        raise ValueError(
            f"pose: expected shape (7,) or (N, 7), since a Transform3d has one batch dimension, got "
            f"{tuple(pose.shape)}; reshape to (-1, 7)"
        )
    return Transform3d(matrix=SE3.to_matrix(pose, validate=False))


def from_transform3d(transform: Any) -> Tensor:
    """Poses `(N, 7)` of a `pytorch_kinematics.Transform3d`; gradients pass through its matrix.

    Raises:
        ValueError: the transform is not rigid: it scales or mirrors.
    """
    from pytorch_kinematics import Transform3d

    _instance("transform", transform, Transform3d, "pytorch_kinematics.Transform3d")
    try:
        return SE3.from_matrix(transform.get_matrix())
    except ValueError as error:
        raise ValueError(f"transform: {error}") from None


# ---------------------------------------------------------------------- PyPose


def to_pypose(x: Tensor, kind: str) -> Any:
    """The PyPose `LieTensor` of rotations `(..., 4)` (kind "SO3") or poses `(..., 7)` (kind "SE3"): values only.

    The result is detached. PyPose stores the gradient of a LieTensor as a tangent, padded with zeros, where the
    gradient of its numbers belongs; such a gradient is not Euclidean, and passed on to `x` it would be wrong
    without a word. To optimise with PyPose, wrap the result in `pypose.Parameter`.

    Raises:
        ImportError: PyPose is not installed.
    """
    checks.choice("kind", kind, ("SO3", "SE3"))
    pypose = _pypose()
    if kind == "SO3":
        return pypose.SO3(to_xyzw(SO3.normalize(_rotation("x", x).detach(), validate=False)))
    return pypose.SE3(pose_to_xyzw(SE3.normalize(_pose("x", x).detach(), validate=False)))


def from_pypose(lietensor: Any) -> Tensor:
    """Rotations `(..., 4)` or poses `(..., 7)` of a PyPose `LieTensor` of type SO3 or SE3: values only.

    The result is detached: operations of PyPose expect tangents as gradients (see `to_pypose`), not the Euclidean
    ones that would come from here.

    Raises:
        ImportError: PyPose is not installed.
        ValueError: another type of LieTensor; tangents (so3, se3) become points by their method `Exp`.
    """
    pypose = _pypose()
    _instance("lietensor", lietensor, pypose.LieTensor, "pypose.LieTensor")
    convert = {pypose.SO3_type: from_xyzw, pypose.SE3_type: pose_from_xyzw}.get(lietensor.ltype)
    if convert is not None:
        try:
            return convert(lietensor.tensor().detach())
        except ValueError as error:
            raise ValueError(f"lietensor: {error}") from None
    raise ValueError(
        f"lietensor: expected type SO3Type or SE3Type, got {type(lietensor.ltype).__name__}; "
        "turn a tangent into a point with .Exp()"
    )


def _pypose() -> Any:
    try:
        import pypose
    except ModuleNotFoundError as error:
        if error.name != "pypose":
            raise
        raise ImportError("converting to and from PyPose needs it: pip install pypose") from None
    return pypose


# ---------------------------------------------------------------------- helpers


def _rotation(name: str, q: Tensor) -> Tensor:
    checks.is_floating_tensor(name, q)
    checks.has_last(name, q, 4, "a quaternion")
    checks.finite(name, q)
    checks.quaternions(name, q, ((0, 4),))
    return q


def _pose(name: str, pose: Tensor) -> Tensor:
    checks.is_floating_tensor(name, pose)
    checks.has_last(name, pose, 7, "a pose [x, y, z, qw, qx, qy, qz]")
    checks.finite(name, pose)
    checks.quaternions(name, pose, ((3, 7),))
    return pose


def _dual_quaternion(Q: Tensor) -> Tensor:
    checks.point("Q", Q, DualQuaternion, "a dual quaternion [real(4), dual(4)]")
    return Q


def _reorder(x: Tensor, order: tuple[int, ...]) -> Tensor:
    components = x.unbind(-1)
    return torch.stack([components[n] for n in order], dim=-1)


def _instance(name: str, x: object, kind: type, kind_name: str) -> None:
    if not isinstance(x, kind):
        raise TypeError(f"{name}: expected a {kind_name}, got {type(x).__name__}")
