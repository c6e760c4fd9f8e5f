"""Conversions: against SciPy, pytorch-kinematics and PyPose; gradients at identity, half-turns, gimbal lock."""

import math
import sys
import warnings

import numpy as np
import pytest
import scipy
import torch
from scipy.spatial.transform import Rotation

from torchspline.groups import SE3, SO3, convert

F32, F64 = torch.float32, torch.float64
PRECISIONS = pytest.mark.parametrize("dtype", [F32, F64], ids=["float32", "float64"])
SEQUENCES = pytest.mark.parametrize("sequence", convert.EULER_SEQUENCES)

HALF = math.sqrt(0.5)
SPECIAL = torch.tensor(
    [
        [1.0, 0, 0, 0],
        [-1.0, 0, 0, 0],
        [0, 1.0, 0, 0],
        [0, 0, -1.0, 0],
        [0, 0, 0, 1.0],
        [0, 0.6, 0, -0.8],
        [0, 1.0, 1.0, 1.0],
        [HALF, HALF, 0, 0],
        [HALF, 0, -HALF, 0],
        [HALF, 0, 0, HALF],
        [0.5, 0.5, 0.5, 0.5],
        [-0.5, 0.5, -0.5, 0.5],
        [1.0, 1e-15, 0, 0],
        [1e-15, 0, 1.0, 0],
    ],
    dtype=F64,
)


def rotations(*batch, seed=0, dtype=F64):
    """Quaternions of any length."""
    return torch.randn(*batch, 4, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def poses(*batch, seed=0, dtype=F64):
    return torch.randn(*batch, 7, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def distance(p, q):
    """The largest angle between rotations, in rounding errors of the coarser of the two."""
    eps = max(torch.finfo(p.dtype).eps, torch.finfo(q.dtype).eps)
    return float(SO3.log(SO3.between(p.double(), q.double())).norm(dim=-1).max()) / eps


def wrapped(difference):
    return torch.remainder(difference + math.pi, 2 * math.pi) - math.pi


def scipy_euler(q, sequence, degrees=False):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gimbal lock
        return torch.from_numpy(convert.to_scipy(q).as_euler(sequence, degrees))


def around_lock(sequence, step):
    """Angles whose middle one is `step` inside both of its ends."""
    ends = (step, math.pi - step) if sequence[0] == sequence[2] else (step - math.pi / 2, math.pi / 2 - step)
    return torch.tensor([[a, end, c] for end in ends for a, c in ((0.3, -1.1), (-2.9, 2.5), (0, 0.7))])


@pytest.fixture(autouse=True)
def _doubles():
    """Literals are float64, and what a test does to the global default ends with it."""
    torch.set_default_dtype(F64)
    yield
    torch.set_default_dtype(F32)


# ---------------------------------------------------------------------- scalar last


def test_reordering():
    x = torch.tensor([1.0, 2, 3, 4, 5, 6, 7])
    assert convert.to_xyzw(x[:4]).tolist() == [2, 3, 4, 1]
    assert convert.from_xyzw(x[:4]).tolist() == [4, 1, 2, 3]
    assert convert.pose_to_xyzw(x).tolist() == [1, 2, 3, 5, 6, 7, 4]
    assert convert.pose_from_xyzw(x).tolist() == [1, 2, 3, 7, 4, 5, 6]
    q, p = rotations(2, 3), poses(2, 3)
    assert torch.equal(convert.from_xyzw(convert.to_xyzw(q)), q)
    assert torch.equal(convert.pose_from_xyzw(convert.pose_to_xyzw(p)), p)


# ---------------------------------------------------------------------- matrices and rotation vectors


@PRECISIONS
def test_matrices_and_vectors_agree_with_scipy(dtype):
    q = torch.cat([SPECIAL, rotations(50)]).to(dtype)
    reference = convert.to_scipy(q)
    matrix, vector = convert.to_rotation_matrix(q), convert.to_rotation_vector(q)
    eps = torch.finfo(dtype).eps
    assert np.abs(matrix.numpy() - reference.as_matrix()).max() < 4 * eps
    assert (Rotation.from_rotvec(vector.double().numpy()).inv() * reference).magnitude().max() < 8 * eps
    assert vector.norm(dim=-1).max() <= math.pi * (1 + eps)
    assert distance(convert.from_rotation_matrix(matrix), q) < 8
    assert distance(convert.from_rotation_vector(vector), q) < 8


def test_transform_matrices_move_points():
    pose, point = poses(5), rotations(5)[:, :3]
    matrix = convert.to_transform_matrix(pose)
    moved = (matrix[:, :3, :3] @ point[:, :, None])[..., 0] + matrix[:, :3, 3]
    torch.testing.assert_close(moved, SE3.act(pose, point))
    back = convert.from_transform_matrix(matrix)
    torch.testing.assert_close(back[:, :3], pose[:, :3])
    assert distance(back[:, 3:], pose[:, 3:]) < 8


# ---------------------------------------------------------------------- Euler angles


def test_all_sequences_are_there():
    names = convert.EULER_SEQUENCES
    assert len(set(names)) == 24
    assert sum(name.isupper() for name in names) == sum(name.islower() for name in names) == 12
    assert sum(name[0] == name[2] for name in names) == 12


@SEQUENCES
@PRECISIONS
def test_euler_angles_agree_with_scipy(sequence, dtype):
    q = rotations(200, dtype=dtype)
    eps = torch.finfo(dtype).eps
    for degrees, unit in ((False, 1.0), (True, math.pi / 180)):
        angles = convert.to_euler(q, sequence, degrees)
        assert angles.dtype == dtype
        # Near gimbal lock angles lose digits, the rotation does not.
        assert wrapped((angles - scipy_euler(q, sequence, degrees)) * unit).abs().max() < 1e3 * eps
        assert distance(convert.from_euler(angles, sequence, degrees), q) < 16
        reference = Rotation.from_euler(sequence, angles.double().numpy(), degrees)
        assert distance(convert.from_euler(angles, sequence, degrees), convert.from_scipy(reference)) < 16


@SEQUENCES
@PRECISIONS
def test_rotation_survives_gimbal_lock(sequence, dtype):
    steps = (0.0, 1e-17, 1e-15, 1e-12, 1e-9, 3e-7, 1e-4)
    given = torch.cat([around_lock(sequence, step) for step in steps])
    q = convert.from_euler(given.to(dtype), sequence)
    angles, reference = convert.to_euler(q, sequence), scipy_euler(q, sequence)
    assert distance(convert.from_euler(angles, sequence), q) < 24
    # SciPy sees gimbal lock everywhere within 1e-7 of it.
    assert distance(convert.from_euler(reference, sequence), q) * torch.finfo(dtype).eps < 1e-6
    exact = slice(len(given) // len(steps))
    assert angles[exact, 2].abs().max() == 0
    assert reference[exact, 2].abs().max() == 0
    assert wrapped(angles[exact] - reference[exact]).abs().max() < 1e-6


@SEQUENCES
def test_exact_quarter_turns(sequence):
    """All 24 rotations that map axes to axes, most of them at some gimbal lock."""
    q = convert.from_scipy(Rotation.create_group("O"))
    angles = convert.to_euler(q, sequence)
    assert distance(convert.from_euler(angles, sequence), q) < 8
    assert (angles / (math.pi / 2)).sub((angles / (math.pi / 2)).round()).abs().max() < 1e-12


@SEQUENCES
@pytest.mark.parametrize("step", [1e-6, 1e-3, 0.4])
def test_euler_jacobian_is_exact_up_to_gimbal_lock(sequence, step):
    def there_and_back(angles):
        return convert.to_euler(convert.from_euler(angles, sequence), sequence)

    angles = around_lock(sequence, step)
    expected = torch.eye(3).expand(len(angles), 3, 3)
    reverse = torch.vmap(torch.func.jacrev(there_and_back))(angles)
    forward = torch.vmap(torch.func.jacfwd(there_and_back))(angles)
    # Where all axes differ gimbal lock is a difference of components, so that their rounding turns a gradient of
    # size 1/step by the angle eps/step; where not, components vanish and keep their digits.
    tolerance = 1e-14 / step if sequence[0] == sequence[2] else 1e-15 / step**2 + 1e-14
    torch.testing.assert_close(reverse, expected, rtol=0, atol=tolerance)
    torch.testing.assert_close(forward, expected, rtol=0, atol=tolerance)
    if step >= 1e-3:
        second = torch.vmap(torch.func.jacfwd(torch.func.jacrev(there_and_back)))(angles)
        torch.testing.assert_close(second, torch.zeros_like(second), rtol=0, atol=1e-15 / step**3 + 1e-13)


@SEQUENCES
def test_euler_gradient_in_gimbal_lock(sequence):
    def there_and_back(angles):
        return convert.to_euler(convert.from_euler(angles, sequence), sequence)

    for angles in around_lock(sequence, 0.0):
        jacobian = torch.func.jacrev(there_and_back)(angles)
        torch.testing.assert_close(jacobian[:, 0], torch.tensor([1.0, 0, 0]))
        assert jacobian[1:].abs().max() == 0
        torch.testing.assert_close(jacobian[0, 2].abs(), torch.tensor(1.0))


# ---------------------------------------------------------------------- gradients and transforms


def dual_quaternions(*batch, **kind):
    return convert.pose_to_dual_quaternion(poses(*batch, **kind))


def numbers_of_screw(Q):
    angle, pitch, axis, moment = convert.to_screw(Q)
    return torch.cat([angle[..., None], pitch[..., None], axis, moment], dim=-1)


def screw(x):
    """Eight numbers as a screw, and from that a dual quaternion."""
    axis = torch.nn.functional.normalize(x[..., 2:5], dim=-1)
    return convert.from_screw(x[..., 0], x[..., 1], axis, x[..., 5:])


DIFFERENTIABLE = {
    "pose_to_dual_quaternion": (convert.pose_to_dual_quaternion, poses),
    "pose_from_dual_quaternion": (convert.pose_from_dual_quaternion, dual_quaternions),
    "to_screw": (numbers_of_screw, dual_quaternions),
    "from_screw": (screw, dual_quaternions),
    "to_xyzw": (convert.to_xyzw, rotations),
    "from_xyzw": (convert.from_xyzw, rotations),
    "pose_to_xyzw": (convert.pose_to_xyzw, poses),
    "pose_from_xyzw": (convert.pose_from_xyzw, poses),
    "to_rotation_matrix": (convert.to_rotation_matrix, rotations),
    "from_rotation_matrix": (
        convert.from_rotation_matrix,
        lambda *batch, **kind: SO3.to_matrix(rotations(*batch, **kind)),
    ),
    "to_rotation_vector": (convert.to_rotation_vector, rotations),
    "from_rotation_vector": (
        convert.from_rotation_vector,
        lambda *batch, **kind: 2 * rotations(*batch, **kind)[..., :3],
    ),
    "to_transform_matrix": (convert.to_transform_matrix, poses),
    "from_transform_matrix": (
        convert.from_transform_matrix,
        lambda *batch, **kind: SE3.to_matrix(poses(*batch, **kind)),
    ),
    "to_euler XYZ": (lambda q: convert.to_euler(q, "XYZ"), rotations),
    "to_euler zxz degrees": (lambda q: convert.to_euler(q, "zxz", degrees=True), rotations),
    "from_euler zyx": (
        lambda angles: convert.from_euler(angles, "zyx"),
        lambda *batch, **kind: 2 * rotations(*batch, **kind)[..., :3],
    ),
    "from_euler YXY degrees": (
        lambda angles: convert.from_euler(angles, "YXY", degrees=True),
        lambda *batch, **kind: 100 * rotations(*batch, **kind)[..., :3],
    ),
}
EACH = pytest.mark.parametrize(("function", "make"), DIFFERENTIABLE.values(), ids=DIFFERENTIABLE)


def check_gradients(function, x):
    x = x.clone().requires_grad_()
    assert torch.autograd.gradcheck(function, x, check_forward_ad=True, atol=1e-5)
    assert torch.autograd.gradgradcheck(function, x, atol=1e-4)


def test_every_function_is_tried():
    names = {name.split()[0] for name in DIFFERENTIABLE}
    others = {f"{way}_{kind}" for way in ("to", "from") for kind in ("scipy", "transform3d", "pypose")}
    public = {name for name in dir(convert) if name.startswith(("to_", "from_", "pose_"))}
    assert public == names | others


@pytest.mark.contract(function="conversions", regimes="general", properties="first second")
@EACH
def test_gradients(function, make):
    check_gradients(function, make(2, seed=3))


@pytest.mark.parametrize("q", SPECIAL[[0, 1, 2, 5, 6, 7, 10]], ids=lambda q: str(q.tolist()))
def test_gradients_at_special_rotations(q):
    check_gradients(convert.to_rotation_matrix, q)
    check_gradients(convert.to_transform_matrix, torch.cat([torch.ones(3), q]))
    vector = convert.to_rotation_vector(q)
    check_gradients(convert.from_rotation_vector, vector)
    check_gradients(lambda angles: convert.from_euler(angles, "zxz"), vector)
    if q[0] != 0:  # at a half-turn the logarithm jumps
        check_gradients(convert.to_rotation_vector, q)

    def rotation(
        step,
    ):  # whatever the sign of the quaternion; only steps along rotations have one true answer
        matrix = SO3.to_matrix(SO3.retract(q, step))
        return SO3.to_matrix(convert.from_rotation_matrix(matrix))

    check_gradients(rotation, torch.zeros(3))


@PRECISIONS
def test_gradients_are_finite_everywhere(dtype):
    functions = [convert.to_rotation_vector, convert.to_rotation_matrix]
    functions += [lambda q, s=s: convert.to_euler(q, s) for s in convert.EULER_SEQUENCES]
    for function in functions:
        q = SPECIAL.to(dtype).requires_grad_()
        (first,) = torch.autograd.grad(function(q).square().sum(), q, create_graph=True)
        (second,) = torch.autograd.grad(first.sum(), q)
        assert first.dtype == dtype
        assert first.isfinite().all()
        assert second.isfinite().all()


@pytest.mark.contract(function="conversions", regimes="general", properties="vmap")
@EACH
@PRECISIONS
def test_dtype_batch_and_vmap(function, make, dtype):
    torch.set_default_dtype(F32 if dtype == F64 else F64)  # nothing may lean on it
    x = make(2, 3, seed=4, dtype=dtype)
    y = function(x)
    assert y.dtype == dtype
    assert y.shape[:2] == (2, 3)
    tolerance = 8 * torch.finfo(dtype).eps * float(y.abs().max())
    torch.testing.assert_close(function(x[1, 2]), y[1, 2], rtol=0, atol=tolerance)
    torch.testing.assert_close(torch.vmap(torch.vmap(function))(x), y, rtol=0, atol=tolerance)
    assert function(x[:0]).shape == y[:0].shape


@pytest.mark.contract(function="conversions", regimes="general", properties="compile")
@EACH
def test_compiled_equals_eager(function, make):
    x = make(3, seed=5)
    torch._dynamo.reset()
    compiled = torch.compile(function, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(x), function(x), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("length", [1e-15, 1e-6, 1e15])
def test_length_does_not_matter(length):
    q = SO3.normalize(rotations(6))
    for function in (
        convert.to_rotation_matrix,
        convert.to_rotation_vector,
        lambda q: convert.to_euler(q, "ZYX"),
        lambda q: convert.from_scipy(convert.to_scipy(q)),
    ):
        torch.testing.assert_close(function(length * q), function(q))
        torch.testing.assert_close(function((length * q).float()).double(), function(q), rtol=0, atol=1e-5)


# ---------------------------------------------------------------------- other libraries


@PRECISIONS
def test_scipy_round_trip(dtype):
    # Only from 1.17 on does SciPy know batches of more than one dimension.
    recent = int(scipy.__version__.split(".")[1]) >= 17
    q = rotations(*((2, 3) if recent else (6,)), dtype=dtype)
    with_scipy = convert.to_scipy(q.requires_grad_()).apply([1.0, 2.0, 3.0])
    ours = SO3.act(q.detach().double(), torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(torch.from_numpy(with_scipy), ours)
    back = convert.from_scipy(convert.to_scipy(q), dtype=dtype)
    assert back.shape == q.shape
    assert back.dtype == dtype
    assert distance(back, q.detach()) < 4
    alone = convert.to_scipy(q.flatten(0, -2)[0])
    assert alone.single
    assert convert.from_scipy(alone).shape == (4,)


def test_older_scipy_explains_itself(monkeypatch):
    class OldRotation:
        @staticmethod
        def from_quat(numbers):
            raise ValueError("Expected `quat` to have shape (4,) or (N, 4)")

    monkeypatch.setattr("scipy.spatial.transform.Rotation", OldRotation)
    with pytest.raises(ValueError, match=r"q: expected shape .* got \(2, 3, 4\); reshape"):
        convert.to_scipy(rotations(2, 3))


@PRECISIONS
def test_transform3d_moves_points_like_a_pose(dtype):
    pose = poses(4, dtype=dtype).requires_grad_()
    points = rotations(4, seed=1, dtype=dtype)[:, :3]
    transform = convert.to_transform3d(pose)
    assert transform.dtype == dtype
    ours = SE3.act(pose, points)
    theirs = transform.transform_points(points[:, None])[:, 0]
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(theirs, ours, rtol=0, atol=32 * eps)
    (our_gradient,) = torch.autograd.grad(ours.square().sum(), pose)
    (their_gradient,) = torch.autograd.grad(theirs.square().sum(), pose)
    torch.testing.assert_close(their_gradient, our_gradient, rtol=1e3 * eps, atol=1e3 * eps)

    one = convert.to_transform3d(pose[0])
    assert len(one) == 1
    product = convert.from_transform3d(one.compose(transform))
    expected = SE3.compose(pose[0], pose)
    torch.testing.assert_close(product[:, :3], expected[:, :3], rtol=0, atol=32 * eps)
    assert distance(product[:, 3:].detach(), expected[:, 3:].detach()) < 32
    check_gradients(lambda p: convert.from_transform3d(convert.to_transform3d(p)), poses(2, seed=7))


def test_transform3d_must_be_rigid():
    from pytorch_kinematics import Transform3d

    with pytest.raises(ValueError, match="orthonormal"):
        convert.from_transform3d(
            Transform3d(matrix=torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0], dtype=F64)))
        )
    with pytest.raises(TypeError, match=r"transform: expected a pytorch_kinematics\.Transform3d, got Tensor"):
        convert.from_transform3d(torch.eye(4))
    with pytest.raises(ValueError, match=r"pose: expected shape \(7,\) or \(N, 7\).*got \(2, 3, 7\)"):
        convert.to_transform3d(poses(2, 3))


@PRECISIONS
def test_pypose_agrees(dtype):
    pypose = pytest.importorskip("pypose")
    tolerance = {"rtol": 0, "atol": 32 * torch.finfo(dtype).eps}
    q, pose = rotations(2, 3, dtype=dtype), poses(2, 3, dtype=dtype)
    points = rotations(2, 3, seed=1, dtype=dtype)[..., :3]
    for kind, group, x in (("SO3", SO3, q), ("SE3", SE3, pose)):
        theirs = convert.to_pypose(x.clone().requires_grad_(), kind)
        assert theirs.ltype == getattr(pypose, f"{kind}_type")
        assert theirs.dtype == dtype
        assert not theirs.requires_grad
        torch.testing.assert_close(torch.Tensor(theirs.Act(points)), group.act(x, points), **tolerance)
        back = convert.from_pypose(theirs)
        assert type(back) is torch.Tensor
        torch.testing.assert_close(back, group.normalize(x), **tolerance)
        assert not convert.from_pypose(pypose.Parameter(theirs)).requires_grad
        with pytest.raises(ValueError, match=r"expected type SO3Type or SE3Type, got s\w3Type.*Exp"):
            convert.from_pypose(theirs.Log())
    with pytest.raises(TypeError, match=r"lietensor: expected a pypose\.LieTensor, got Tensor"):
        convert.from_pypose(q)


def test_missing_pypose_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pypose", None)
    with pytest.raises(ImportError, match="pip install pypose"):
        convert.to_pypose(rotations(2), "SO3")
    with pytest.raises(ImportError, match="pip install pypose"):
        convert.from_pypose(rotations(2))


# ---------------------------------------------------------------------- what is refused

Q, POSE, V = torch.tensor([1.0, 0, 0, 0]), torch.tensor([0.0, 0, 0, 1, 0, 0, 0]), torch.zeros(3)
NAN = float("nan")
BAD = [
    (lambda: convert.to_xyzw([1.0, 0, 0, 0]), TypeError, "q: expected a torch.Tensor, got list"),
    (lambda: convert.from_xyzw(Q.long()), TypeError, "q: expected dtype .* got torch.int64"),
    (lambda: convert.to_rotation_matrix(Q.half()), TypeError, "q: expected dtype .* got torch.float16"),
    (lambda: convert.to_rotation_vector(V), ValueError, r"q: expected shape \(..., 4\).* got \(3,\)"),
    (lambda: convert.to_rotation_vector(0 * Q), ValueError, "q: expected quaternions .* got length 0"),
    (lambda: convert.to_scipy(NAN * Q), ValueError, "q: expected finite numbers, got nan"),
    (lambda: convert.pose_to_xyzw(Q), ValueError, r"pose: expected shape \(..., 7\).* got \(4,\)"),
    (lambda: convert.pose_from_xyzw(POSE * 0), ValueError, r"pose: expected quaternions \(components 3"),
    (lambda: convert.pose_from_xyzw(POSE[1:]), ValueError, r"pose: expected shape \(..., 7\)"),
    (lambda: convert.to_transform_matrix(POSE * 0), ValueError, "pose: expected quaternions"),
    (lambda: convert.to_transform3d(POSE / 0), ValueError, "pose: expected finite numbers"),
    (lambda: convert.from_rotation_vector(Q), ValueError, r"vector: expected shape \(..., 3\)"),
    (lambda: convert.from_rotation_vector(V / 0), ValueError, "vector: expected finite numbers"),
    (lambda: convert.from_rotation_matrix(torch.eye(4)), ValueError, r"matrix: expected shape \(..., 3, 3\)"),
    (lambda: convert.from_rotation_matrix(-torch.eye(3)), ValueError, "matrix: .* off by"),
    (lambda: convert.from_transform_matrix(2 * torch.eye(4)), ValueError, "matrix: .* off by"),
    (lambda: convert.to_euler(Q, "XXZ"), ValueError, "sequence: expected one of 'XYX'.* got 'XXZ'"),
    (lambda: convert.to_euler(Q, "xYz"), ValueError, "sequence: .* got 'xYz'"),
    (lambda: convert.from_euler(V, "xy"), ValueError, "sequence: .* got 'xy'"),
    (lambda: convert.to_euler(Q * 0, "xyz"), ValueError, "q: expected quaternions"),
    (lambda: convert.from_euler(Q, "xyz"), ValueError, r"angles: expected shape \(..., 3\)"),
    (lambda: convert.from_euler(V * NAN, "xyz"), ValueError, "angles: expected finite numbers"),
    (lambda: convert.from_scipy(Q), TypeError, r"rotation: expected a scipy.*Rotation, got Tensor"),
    (
        lambda: convert.from_scipy(Rotation.identity(), dtype=torch.int64),
        TypeError,
        "dtype: expected torch.float32 or torch.float64, got torch.int64",
    ),
    (lambda: convert.to_pypose(Q, "so3"), ValueError, "kind: expected one of 'SO3', 'SE3', got 'so3'"),
]


@pytest.mark.parametrize(("call", "error", "message"), BAD, ids=[message for *_, message in BAD])
def test_bad_input_is_named(call, error, message):
    with pytest.raises(error, match=message):
        call()
