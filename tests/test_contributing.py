"""The worked example in CONTRIBUTING.md: its code is run, and its group is one."""

import re
import types
from pathlib import Path

import pytest
import torch
from batteries import generator

import torchspline as ts
import torchspline.io
from torchspline.arithmetic import registry

PAGE = Path(__file__).resolve().parent.parent / ".github" / "CONTRIBUTING.md"
F64 = torch.float64


@pytest.fixture
def group(monkeypatch):
    if not PAGE.is_file():
        pytest.skip("no .github here: an sdist")
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)[0]
    module = types.ModuleType("heisenberg")
    exec(compile(code, str(PAGE), "exec"), module.__dict__)
    monkeypatch.setitem(registry.GROUPS, "Heisenberg", module.Heisenberg())
    return ts.Group("Heisenberg")


def random(*shape, seed):
    return torch.randn(*shape, generator=generator(seed), dtype=F64)


def hat(x):
    matrix = torch.zeros(*x.shape[:-1], 3, 3, dtype=F64)
    matrix[..., 0, 1], matrix[..., 1, 2], matrix[..., 0, 2] = x.unbind(-1)
    return matrix


def test_it_is_the_group_of_its_matrices(group):
    x, y = random(20, 3, seed=0), random(20, 3, seed=1)
    X, Y = group.exp(x), group.exp(y)
    torch.testing.assert_close(group.to_matrix(X), torch.linalg.matrix_exp(hat(x)))
    torch.testing.assert_close(group.to_matrix(group.compose(X, Y)), group.to_matrix(X) @ group.to_matrix(Y))
    torch.testing.assert_close(group.to_matrix(group.inverse(X)), torch.linalg.inv(group.to_matrix(X)))
    torch.testing.assert_close(group.log(X), x)
    torch.testing.assert_close(group.from_matrix(group.to_matrix(X)), X)
    torch.testing.assert_close(hat(group.bracket(x, y)), hat(x) @ hat(y) - hat(y) @ hat(x))
    moved = group.to_matrix(X) @ hat(y) @ torch.linalg.inv(group.to_matrix(X))
    torch.testing.assert_close(hat(group.adjoint_act(X, y)), moved)
    point = random(20, 2, seed=2)
    homogeneous = torch.cat([point, torch.ones(20, 1, dtype=F64)], -1)[..., None]
    torch.testing.assert_close(group.act(X, point), (group.to_matrix(X) @ homogeneous)[:, :2, 0])


def test_gradients_and_jacobians_are_those_of_its_numbers(group):
    x, y = random(3, seed=3), random(3, seed=4)
    functions = (
        lambda X, Y: group.compose(X, Y),
        lambda X, Y: group.log(group.between(X, Y)),
        lambda X, Y: group.act(X, Y[:2]),
        lambda X, Y: group.adjoint_act(X, Y),
        lambda X, Y: group.left_jacobian_inverse(X) @ Y,
    )
    for function in functions:
        arguments = [a.clone().requires_grad_() for a in (x, y)]
        assert torch.autograd.gradcheck(function, arguments)
    by_numbers = torch.func.jacfwd(
        lambda d: group.log(group.compose(group.exp(x + d), group.inverse(group.exp(x))))
    )
    torch.testing.assert_close(group.left_jacobian(x), by_numbers(torch.zeros(3, dtype=F64)))


def test_splines_take_it(group, tmp_path):
    points = random(6, 3, seed=5).requires_grad_()
    t = torch.tensor([0.05, 0.21, 0.29], dtype=F64, requires_grad=True)

    def state(points, t):
        return ts.functional.bspline(points, t, group=group, order=4, dt=0.1)

    assert torch.autograd.gradcheck(lambda *a: tuple(x for x in state(*a) if x is not None), (points, t))
    velocity = torch.func.jacfwd(lambda t: group.to_matrix(state(points.detach(), t).value))(t.detach()[1])
    body = torch.linalg.inv(group.to_matrix(state(points.detach(), t.detach()[1]).value)) @ velocity
    torch.testing.assert_close(hat(state(points, t).velocity[1]), body)
    ts.io.save_trajectory(tmp_path / "x", ts.BSpline(points, group=group, dt=0.1))
    assert ts.io.load_trajectory(tmp_path / "x").group == group
