"""The B-spline as a module: what is learnt, moved, saved, copied and trained."""

import copy
import io
import pickle

import pytest
import torch
from batteries import normal
from spline_cases import close, control_points, number

from torchspline import BSpline, SplitBSpline
from torchspline.groups import SE3, SO3

float64 = torch.float64


def at(*values, dtype=float64):
    return torch.tensor(values, dtype=dtype)


# ---------------------------------------------------------------------- what is learnt


def test_learnable_buffer_or_given():
    points, t = control_points(SE3, 6), at(0.1, 1.9)
    learnt = BSpline(points, group=SE3, dt=1.0)
    assert [name for name, _ in learnt.named_parameters()] == ["control_points"]
    assert {name for name, _ in learnt.named_buffers()} == {"t0", "dt"}
    fixed = BSpline(points, group=SE3, dt=1.0, learnable=False)
    assert list(fixed.parameters()) == []
    assert not fixed(t).requires_grad
    for own in (learnt, fixed):  # neither a step nor a caller's edit reaches the other
        assert own.control_points.data_ptr() != points.data_ptr()

    leaf = points.clone().requires_grad_()
    given = BSpline(leaf, group=SE3, dt=1.0)
    assert given.control_points is leaf
    assert list(given.parameters()) == []
    given(t).sum().backward()
    assert leaf.grad.abs().sum() > 0

    net = torch.nn.Linear(3, 6 * 7, dtype=float64)
    output = (net(torch.ones(3, dtype=float64)).reshape(6, 7) + points).requires_grad_()
    in_graph = BSpline(output, group=SE3, dt=1.0)
    in_graph.evaluate(t).acceleration.sum().backward()
    assert net.weight.grad.abs().sum() > 0

    for requires_grad in (True, False):
        parameter = torch.nn.Parameter(points.clone(), requires_grad=requires_grad)
        shared = BSpline(parameter, group=SE3, dt=1.0)
        assert list(shared.parameters()) == [parameter]
        assert shared.control_points is parameter
        assert parameter.requires_grad == requires_grad


def test_expanded_control_points_can_be_trained():
    spline = BSpline(SE3.identity().expand(6, 7), group=SE3, dt=1.0)
    optimizer = torch.optim.SGD(spline.parameters(), lr=0.1)
    spline(at(0.5))[..., :3].square().sub(1.0).square().sum().backward()
    spline.control_points.grad += 1.0
    optimizer.step()
    assert torch.all(spline.control_points.detach()[:, 0] == -0.1)


@pytest.mark.parametrize("given", ["number", "tensor", "leaf", "parameter"])
def test_learnable_times(given):
    make = {
        "number": float,
        "tensor": number,
        "leaf": lambda x: number(x).requires_grad_(),
        "parameter": lambda x: torch.nn.Parameter(number(x)),
    }[given]
    dt, t0 = make(0.7), make(0.2)
    spline = BSpline(control_points(SE3, 7), group=SE3, dt=dt, t0=t0)
    wanted = given in ("leaf", "parameter")
    assert (spline.dt is dt) == wanted
    names = {name for name, _ in spline.named_parameters()}
    assert names == ({"control_points", "dt", "t0"} if given == "parameter" else {"control_points"})
    if wanted:
        spline.evaluate(at(0.5, 1.9)).velocity.square().sum().backward()
        assert dt.grad.abs() > 0
        assert t0.grad.abs() > 0


# ---------------------------------------------------------------------- moved, saved, copied


@pytest.mark.parametrize("given", ["number", "parameter", "leaf"])
@pytest.mark.parametrize("convert", ["float", "half", "double", "bfloat16"])
def test_times_stay_in_double_precision(given, convert):
    """Whatever happens to the control points; gradients of learnt times keep up."""
    start, spacing = 1.7e9 + 1 / 3, 1 / 300
    dt, t0 = spacing, start
    if given != "number":
        dt, t0 = number(dt).requires_grad_(), number(t0).requires_grad_()
    if given == "parameter":
        dt, t0 = torch.nn.Parameter(dt.detach()), torch.nn.Parameter(t0.detach())
    spline = BSpline(control_points(SE3, 8), group=SE3, dt=dt, t0=t0)
    t = start + torch.linspace(0, 4, 9, dtype=float64) * spacing
    before = spline.evaluate(t)
    before.velocity.sum().backward()
    domain = spline.domain
    assert getattr(spline, convert)() is spline
    assert spline.dt.dtype == spline.t0.dtype == float64
    assert (spline.dt.item(), spline.t0.item()) == (spacing, start)
    assert spline.domain == domain
    assert spline.control_points.dtype == getattr(torch, convert)
    if given == "parameter":
        assert spline.dt is dt
        assert dt.grad.dtype == float64
        assert dt.grad.abs() > 0
    if convert in ("half", "bfloat16"):
        with pytest.raises(
            TypeError, match=r"control_points: expected dtype torch.float32 or torch.float64, got"
        ):
            spline(t)
        return
    after = spline.evaluate(t)
    assert after.value.dtype == spline.control_points.dtype
    assert close(after.value.double(), before.value, 3e-6)
    if given != "number":
        old = dt.grad.clone()
        after.velocity.sum().backward()
        assert (dt.grad - 2 * old).abs() < 1e-4 * old.abs()


def test_moving_between_devices_keeps_times():
    spline = BSpline(control_points(SE3, 8), group=SE3, dt=1 / 3)
    moved = copy.deepcopy(spline).to("meta", torch.float32)
    assert moved.dt.device.type == moved.control_points.device.type == "meta"
    assert moved.dt.dtype == float64
    mounted = SplitBSpline(control_points(SE3, 8), dt=1 / 3).mounted(SE3.identity()).float()
    assert mounted.trajectory.dt.dtype == float64
    assert mounted(at(0.2)).dtype == torch.float32


def round_trips():
    def through_file(module):
        file = io.BytesIO()
        torch.save(module, file)
        file.seek(0)
        return torch.load(file, weights_only=False)

    return {
        "deepcopy": copy.deepcopy,
        "pickle": lambda m: pickle.loads(pickle.dumps(m)),
        "torch.save": through_file,
    }


MODULES = {
    "seconds": lambda: BSpline(
        control_points(SE3, 8), group=SE3, order=5, dt=0.3, t0=-1.0, extrapolate="clamp"
    ),
    "nanoseconds": lambda: BSpline(control_points(SO3, 8), group=SO3, dt_ns=7, t0_ns=-12, learnable=False),
    "learnt times": lambda: SplitBSpline(
        control_points(SE3, 8).requires_grad_(),
        dt=torch.nn.Parameter(number(0.3)),
        t0=number(0.1).requires_grad_(),
    ),
    "mounted": lambda: SplitBSpline(control_points(SE3, 8), dt=0.3).mounted(
        torch.nn.Parameter(control_points(SE3, 2)[1])
    ),
}


@pytest.mark.parametrize("copied", round_trips().values(), ids=round_trips())
@pytest.mark.parametrize("make", MODULES.values(), ids=MODULES)
def test_copies(make, copied):
    module = make()
    other = copied(module)
    assert other.domain == module.domain
    start, end = module.domain
    t = torch.linspace(start, end, 5, dtype=float64)
    t = t.long() if isinstance(start, int) else t
    for ours, theirs in zip(other.evaluate(t, 3), module.evaluate(t, 3), strict=True):
        assert torch.equal(ours, theirs)
    assert repr(other) == repr(module)
    for (name, x), (same, y) in zip(module.state_dict().items(), other.state_dict().items(), strict=True):
        assert name == same
        assert torch.equal(x, y)
        assert x.data_ptr() != y.data_ptr()


@pytest.mark.parametrize("make", MODULES.values(), ids=MODULES)
def test_state_dict(make):
    module, other = make(), make()
    with torch.no_grad():
        for x in other.state_dict().values():
            if x.is_floating_point():
                x.mul_(1.25)
    if getattr(other, "dt_ns", None) is not None:
        other.dt_ns, other.t0_ns = 2 * other.dt_ns, other.t0_ns + 5
    changed = {name: x.clone() for name, x in other.state_dict().items()}
    assert module.load_state_dict(other.state_dict()) == ([], [])
    assert all(torch.equal(x, changed[name]) for name, x in module.state_dict().items())
    assert module.domain == other.domain
    middle = sum(module.domain) / 2
    t = torch.tensor([int(middle)]) if isinstance(module.domain[0], int) else at(middle)
    assert torch.equal(module(t), other(t))


def test_repr_tells_what_it_is():
    spline = BSpline(control_points(SE3, 8).expand(2, 8, 7), group=SE3, order=5, dt=0.5, t0=-1.0)
    assert repr(spline) == "BSpline(SE3, order=5, batch=(2,), points=8, domain=[-1.0, 1.0] s)"
    spline = BSpline(control_points(SO3, 8), group=SO3, dt_ns=7)
    assert repr(spline) == "BSpline(SO3, order=4, batch=(), points=8, domain=[0, 35] ns)"


# ---------------------------------------------------------------------- trained


def test_distributed_training(tmp_path):
    """Wrapped in DistributedDataParallel the gradients are those of the bare module."""
    if not torch.distributed.is_available():
        pytest.skip("this torch has no torch.distributed")
    torch.distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        spline = BSpline(control_points(SE3, 8), group=SE3, dt=torch.nn.Parameter(number(0.4)), t0=0.1)
        alone = copy.deepcopy(spline)
        wrapped = torch.nn.parallel.DistributedDataParallel(spline)
        t = at(0.2, 0.9, 1.7)
        for module in (wrapped, alone):
            for _ in range(2):
                module(t).square().sum().backward()
        for ours, theirs in zip(spline.parameters(), alone.parameters(), strict=True):
            assert torch.equal(ours.grad, theirs.grad)
            assert ours.grad.abs().max() > 0
    finally:
        torch.distributed.destroy_process_group()


OPTIMIZERS = {
    "Adam": lambda p: torch.optim.Adam(p, lr=0.03),
    "AdamW": lambda p: torch.optim.AdamW(p, lr=0.03, weight_decay=1e-3),
    "SGD": lambda p: torch.optim.SGD(p, lr=0.005, momentum=0.9),
}


@pytest.mark.parametrize("optimizer", OPTIMIZERS.values(), ids=OPTIMIZERS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_ordinary_optimizers_fit_raw_quaternions(optimizer, dtype):
    """From standing still to a moving target; nothing renormalises, and lengths stay of order one."""
    t = torch.linspace(0, 5, 40, dtype=float64)
    target = SplitBSpline(control_points(SE3, 8, gap=0.5).to(dtype), dt=1.0)(t).detach()
    spline = SplitBSpline(target[:1].expand(8, 7), dt=1.0)
    steps = optimizer(spline.parameters())
    losses = []
    for _ in range(200):
        steps.zero_grad()
        value = spline(t)
        turned = 1 - (value * target)[:, 3:].sum(-1).square()
        distance = (value - target)[:, :3].square().sum() + 4 * turned.sum()
        distance.backward()
        steps.step()
        losses.append(distance.item())
    assert losses[0] > 10.0
    assert losses[-1] < 1e-2 * losses[0]
    lengths = spline.control_points.detach()[:, 3:].norm(dim=-1)
    assert lengths.min() > 0.5
    assert lengths.max() < 4.0


def test_plain_steps_never_shrink_quaternions():
    """The gradient is orthogonal to the quaternion, so gradient descent can only lengthen it."""
    spline = BSpline(control_points(SO3, 8), group=SO3, dt=1.0)
    steps = torch.optim.SGD(spline.parameters(), lr=0.1)
    before = spline.control_points.detach().norm(dim=-1)
    for i in range(20):
        steps.zero_grad()
        state = spline.evaluate(torch.linspace(0, 5, 20, dtype=float64), 3)
        sum((x * normal(*x.shape, seed=i)).sum() for x in state).mul(0.01).backward()
        steps.step()
        after = spline.control_points.detach().norm(dim=-1)
        assert torch.all(after >= before * (1 - 1e-12))
        before = after
    assert before.max() > 1.0 + 1e-6


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_autocast_changes_nothing(dtype):
    """Motion in bfloat16 would be worthless: values, rates and gradients are bit for bit those without it."""
    t = torch.linspace(0, 4, 7, dtype=float64)
    for make in (BSpline, SplitBSpline):
        results = []
        for enabled in (False, True):
            options = {"group": SE3} if make is BSpline else {}
            spline = make(control_points(SE3, 8).to(dtype), dt=1.0, **options)
            mounted = spline.mounted(control_points(SE3, 2)[1].to(dtype))
            with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
                out = [*mounted.evaluate(t, 3), *spline.kinematics(t)]
                loss = sum(x.square().sum() for x in out)
            with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
                grads = torch.autograd.grad(loss, list(spline.parameters()))
            results.append([*out, *grads])
        for ours, theirs in zip(*results, strict=True):
            assert ours.dtype == theirs.dtype == dtype
            assert torch.equal(ours, theirs)
