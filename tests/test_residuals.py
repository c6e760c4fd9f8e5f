"""Every residual: its hand-derived reverse, its compiled loop, its sizes, and its value by independent formulas."""

import importlib
import inspect
import pkgutil

import numpy as np
import pytest
import torch
from fit_cases import (
    CANDIDATES,
    accepts,
    before_the_camera,
    each_pair,
    equidistant,
    in_order,
    kernel_for,
    moved,
    near,
    poses,
    sample,
)

from torchspline import R3, SE3, SO3, Group, fit, product
from torchspline.fit import RelativePose, Residual, residuals
from torchspline.fit.residuals import RESIDUALS
from torchspline.fit.solving.kernel import ResidualKernel, kernel_of

each_kind = pytest.mark.parametrize("kind", RESIDUALS.values(), ids=RESIDUALS)


def tangent_sizes(kind, group, given):
    sizes = {}
    for name, x in given.items():
        if name == "measured":
            continue
        if name.startswith("value"):
            sizes[name] = (len(x), group.tangent_size)
        elif name in kind.slots and kind.slots[name].group is not None:
            sizes[name] = (len(x), Group(kind.slots[name].group).tangent_size)
        else:
            sizes[name] = tuple(x.shape)
    return sizes


def differentiated(kernel, group, given):
    """`(N, R, ...)` Jacobian of the residual in everything, by automatic differentiation in tangent coordinates."""
    sizes = tangent_sizes(kernel.kind, group, given)

    def function(*steps):
        there = moved(kernel.kind, group, given, dict(zip(sizes, steps, strict=True)))
        return kernel.on_tensors(*in_order(kernel, there)).sum(0)

    zeros = tuple(torch.zeros(size, dtype=torch.float64) for size in sizes.values())
    jacobians = torch.autograd.functional.jacobian(function, zeros)
    return {name: J.movedim(0, 1) for name, J in zip(sizes, jacobians, strict=True)}


def linearized(kernel, given, fused=False):
    return [
        torch.from_numpy(x) for x in kernel.linearize([x.numpy() for x in in_order(kernel, given)], fused)
    ]


def check_reverse(kind, group, given, slots, tolerance=1e-12):
    kernel = kernel_for(kind, group, slots)
    residual, *cotangents = linearized(kernel, given)
    torch.testing.assert_close(residual, kernel.on_tensors(*in_order(kernel, given)), rtol=1e-13, atol=1e-12)
    expected = differentiated(kernel, group, given)
    for m, (parts, got) in enumerate(zip(kernel.parts, cotangents[: kind.moments], strict=True)):
        rates = expected[f"rates{m}"].unbind(2)
        states = [expected[f"value{m}"], *rates]
        used = [J for J, part in zip(states, parts, strict=False) if part]
        unused = [J for J, part in zip(states, (*parts, *[False] * len(states)), strict=False) if not part]
        assert all(not J.any() for J in unused)
        want = torch.cat(used, dim=-1)
        assert (got - want).abs().max() <= tolerance * want.abs().max().clamp_min(1.0)
    for slot, got in zip(kernel.order, cotangents[kind.moments :], strict=True):
        want = expected[slot]
        turning = group.name != "R3"  # without rotation a lever arm moves nothing
        assert want.any() or not turning, f"the residual does not depend on {slot}"
        assert (got - want).abs().max() <= tolerance * want.abs().max().clamp_min(1.0), slot


# ---------------------------------------------------------------------- the reverse and the kernels


@each_pair
def test_the_reverse_is_the_derivative(kind, group):
    check_reverse(kind, group, sample(kind, group), kind.slots)


@each_pair
def test_arguments_that_are_not_given_take_their_defaults(kind, group):
    given = sample(kind, group, seed=5)
    needed = [slot for slot, (_, _, default) in kind.slots.items() if default is None]
    short, full = kernel_for(kind, group, needed), kernel_for(kind, group, kind.slots)
    for slot, (_, _, default) in kind.slots.items():
        if default is not None:
            given[slot] = torch.tensor(default, dtype=torch.float64).expand(len(given["measured"]), -1)
    results = [kernel.on_tensors(*in_order(kernel, given)) for kernel in (short, full)]
    torch.testing.assert_close(*results, rtol=1e-12, atol=1e-12)
    check_reverse(kind, group, {k: x for k, x in given.items() if k in needed or k not in kind.slots}, needed)


@each_pair
def test_one_argument_for_all_measurements(kind, group):
    given = sample(kind, group, seed=7)
    slots = [slot for slot in kind.slots if slot != "landmark"]  # of one landmark only one camera is in front
    kernel = kernel_for(kind, group, kind.slots)
    shared = ResidualKernel(kind, group.name, tuple((slot, slot not in slots) for slot in kind.slots))
    one = {slot: given[slot][:1].expand_as(given[slot]) for slot in slots}
    if "intrinsics" in slots:
        one["landmark"] = before_the_camera(poses(group, given["value0"]), one["T_body_camera"])
    expected = linearized(kernel, {**given, **one})
    alone = {slot: x[0] for slot, x in one.items() if slot in slots}
    got = linearized(shared, {**given, **one, **alone})
    slot_results = dict(zip(kernel.order, expected[1 + kind.moments :], strict=True))
    expected[1 + kind.moments :] = [slot_results[slot] for slot in shared.order]
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-12)


@each_kind
@pytest.mark.slow
def test_the_compiled_loop_is_the_reference(kind):
    group = next(g for g in CANDIDATES if accepts(kind, g))
    given = sample(kind, group, count=70, seed=3)  # two blocks and a rest
    kernel = kernel_for(kind, group, kind.slots)
    fused = linearized(kernel, given, fused=True)
    for a, b in zip(fused, linearized(kernel, given), strict=True):
        assert torch.isfinite(a).all()
        assert (a - b).abs().max() <= 1e-13 * b.abs().max().clamp_min(1.0)


@each_pair
def test_sizes_are_as_declared(kind, group):
    rows, measured_size = kind.sizes(group.arithmetic)
    given = sample(kind, group)
    kernel = kernel_for(kind, group, kind.slots)
    residual, *cotangents = linearized(kernel, given)
    assert residual.shape == (6, rows)
    assert given["measured"].shape == (6, measured_size)
    wanted = [group.tangent_size * sum(parts) for parts in kernel.parts]
    wanted += [kernel._cotangent_size(slot) for slot in kernel.order]
    assert [x.shape[-1] for x in cotangents] == wanted
    if kind.rows is not None:
        assert (rows, measured_size) == (kind.rows, kind.measured_size)


@each_kind
def test_a_kernel_exists_once(kind):
    group = next(g for g in CANDIDATES if accepts(kind, g)).name
    given = tuple((slot, False) for slot in kind.slots)
    assert kernel_of(kind, group, given) is kernel_of(kind, group, given)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 3.0, np.pi - 1e-4])
@pytest.mark.parametrize("name", ["Orientation", "Pose", "RelativePose", "StateValue"])
def test_reverse_of_rotation_errors_of_every_size(name, angle):
    kind, given = RESIDUALS[name], sample(RESIDUALS[name], SE3, seed=11)
    T = SE3.normalize(given["T_body_sensor"]) if "T_body_sensor" in kind.slots else SE3.identity(6)
    if name == "Orientation":
        seen = SO3.compose(given["value0"][:, 3:], SO3.normalize(given["rotation"]))
        given["measured"] = SO3.compose(seen, SO3.exp(near(SO3, angle, 6, seed=2)))
    else:
        seen = SE3.compose(given["value0"], T)
        if name == "RelativePose":
            seen = SE3.between(seen, SE3.compose(given["value1"], T))
        given["measured"] = SE3.compose(seen, SE3.exp(near(SE3, angle, 6, seed=2)))
    check_reverse(kind, SE3, given, kind.slots, tolerance=1e-10)
    residual = kernel_for(kind, SE3, kind.slots).on_tensors(
        *in_order(kernel_for(kind, SE3, kind.slots), given)
    )
    turned = residual[:, -3:].norm(dim=-1)
    torch.testing.assert_close(turned, torch.full_like(turned, angle), rtol=1e-9, atol=1e-13)


# ---------------------------------------------------------------------- cameras


def camera(name, seen, intrinsics):
    """Residual and cotangents of points given in the frame of the camera."""
    kind = RESIDUALS[name]
    given = {
        "value0": SE3.identity(len(seen)),
        "rates0": torch.zeros(len(seen), 0, 6),
        "measured": torch.zeros(len(seen), 2, dtype=torch.float64),
        "landmark": seen,
        "intrinsics": intrinsics.expand(len(seen), 8),
        "T_body_camera": SE3.identity(len(seen)),
    }
    return given, linearized(kernel_for(kind, SE3, kind.slots), given)


CAMERA = torch.tensor([400.0, 410.0, 320.0, 240.0, -0.05, 0.02, 0.003, -0.002], dtype=torch.float64)
REPROJECTIONS = ["ReprojectionEquidistant", "ReprojectionRadtan"]


@pytest.mark.parametrize("name", REPROJECTIONS)
def test_landmarks_behind_the_camera_take_no_part(name):
    behind = torch.tensor(
        [[0.01, 0.02, -1.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1e-30]], dtype=torch.float64
    )
    if name == "ReprojectionRadtan":
        extra = torch.tensor([[1.0, 0, 0], [1.0, 2, -1e-9], [3.0, 0, 1e-9], [1.0, 1, -1]]).double()
        behind = torch.cat([behind, extra])
    for x in camera(name, behind, CAMERA)[1]:
        assert not x.any()
    given, _ = camera(name, behind, CAMERA)
    assert all(
        not J.any()
        for J in differentiated(kernel_for(RESIDUALS[name], SE3, RESIDUALS[name].slots), SE3, given).values()
    )
    mixed = torch.cat([behind, torch.tensor([[0.1, 0.2, 1.0]]).double()])
    given, (residual, *cotangents) = camera(name, mixed, CAMERA)
    assert residual[-1].abs().min() > 1.0
    assert all(x[-1].any() for x in cotangents)
    check_reverse(RESIDUALS[name], SE3, given, RESIDUALS[name].slots)


@pytest.mark.parametrize("name", REPROJECTIONS)
@pytest.mark.parametrize("aside", [0.0, 1e-300, 1e-160, 1e-20, 1e-8, 1e-4])
def test_landmarks_on_the_optical_axis(name, aside):
    seen = torch.tensor([[aside, -2 * aside, 0.5], [0.0, aside, 4.0]], dtype=torch.float64)
    given, (residual, *_) = camera(name, seen, CAMERA)
    torch.testing.assert_close(residual, CAMERA[2:4].expand(2, 2), rtol=1e-3, atol=0.0)
    check = kernel_for(RESIDUALS[name], SE3, RESIDUALS[name].slots)
    _, moment, *slots = linearized(check, given)
    expected = differentiated(check, SE3, given)
    for got, want in zip(
        (moment, *slots), (expected["value0"], *(expected[s] for s in check.order)), strict=True
    ):
        assert (got - want).abs().max() <= 1e-12 * want.abs().max().clamp_min(1.0)


def test_a_fisheye_sees_beyond_ninety_degrees():
    angles = torch.linspace(0.02, 2.9, 40, dtype=torch.float64)
    seen = 3.0 * torch.stack([0.6 * angles.sin(), -0.8 * angles.sin(), angles.cos()], dim=-1)
    given, (residual, *_) = camera("ReprojectionEquidistant", seen, CAMERA)
    u, v = equidistant(*seen.numpy().T, *CAMERA[4:].numpy())
    expected = np.stack([400.0 * u + 320.0, 410.0 * v + 240.0], axis=-1)
    np.testing.assert_allclose(residual.numpy(), expected, rtol=1e-12)
    check_reverse(
        RESIDUALS["ReprojectionEquidistant"], SE3, given, ["landmark", "intrinsics", "T_body_camera"]
    )


# ---------------------------------------------------------------------- what residuals are of


def test_a_relative_pose_does_not_depend_on_the_world():
    kind = RelativePose
    given = sample(kind, SE3)
    kernel = kernel_for(kind, SE3, kind.slots)
    shift = SE3.random(generator=torch.Generator().manual_seed(4))
    there = {**given, **{name: SE3.compose(shift, given[name]) for name in ("value0", "value1")}}
    results = [kernel.on_tensors(*in_order(kernel, x)) for x in (given, there)]
    torch.testing.assert_close(*results, rtol=1e-12, atol=1e-12)


def test_groups_that_make_no_sense_are_refused():
    for kind in RESIDUALS.values():
        for group in (Group("R2"), Group("R3"), SO3, SE3, product(R3, SO3)):
            if accepts(kind, group):
                continue
            with pytest.raises(
                ValueError, match=rf"{kind.__name__}: expected a trajectory in .*, got {group}"
            ):
                kind.check_group(group)


def test_every_file_of_residuals_is_named():
    """A residual that is in the folder but not in the list would be in no battery."""
    written: dict[str, object] = {}
    for module in pkgutil.iter_modules(residuals.__path__, f"{residuals.__name__}."):
        own = vars(importlib.import_module(module.name)).values()
        kinds = [
            x for x in own if inspect.isclass(x) and issubclass(x, Residual) and not inspect.isabstract(x)
        ]
        written |= {x.__name__: x for x in kinds if x.__module__ == module.name and x.__name__[0] != "_"}
    assert written == RESIDUALS
    assert set(RESIDUALS) <= set(fit.__all__)
