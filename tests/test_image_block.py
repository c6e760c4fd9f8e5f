"""Images as one measurement each, and the linear algebra that calibration adds, against dense oracles."""

import numpy as np
import pytest
import torch

import torchspline as ts
from torchspline.calibrate.images import ImageBlock
from torchspline.fit import (
    BatchProblem,
    Clock,
    Gyroscope,
    Huber,
    Orientation,
    Problem,
    ReprojectionEquidistant,
    ReprojectionRadtan,
    Variable,
)
from torchspline.kernels.band import inverse_band
from torchspline.kernels.gram import triangles

F64 = torch.float64
CAMERA = torch.tensor([458.654, 457.296, 367.215, 248.375, -0.28, 0.074, 2e-4, 2e-5], dtype=F64)
KINDS = {"radtan": ReprojectionRadtan, "equidistant": ReprojectionEquidistant}


def spline(group: str, order: int = 4) -> ts.BSpline:
    generator = torch.Generator().manual_seed(1)
    around = torch.tensor([0.0, 0.0, -1.0, 1.0, 0.0, 0.0, 0.0], dtype=F64).expand(9, 7)
    steps = 0.15 * torch.randn(9, 6, generator=generator, dtype=F64)
    points = ts.Group(group).retract(around, steps, side="right")
    return ts.BSpline(points, group=ts.Group(group), order=order, dt=0.1, learnable=False)


def sights(count: int = 12, corners: int = 240) -> dict[str, torch.Tensor]:
    """Corners in random order of images in random order; the first image shows none."""
    g = torch.Generator().manual_seed(2)
    image = 1 + torch.randint(0, count - 1, (corners,), generator=g)
    flat = 0.3 * torch.randn(corners, 2, generator=g, dtype=F64)
    return {
        "t": torch.linspace(0.02, 0.58, count, dtype=F64)[torch.randperm(count, generator=g)],
        "image": image,
        "xyz": torch.nn.functional.pad(flat, (0, 1)),
        "uv": torch.tensor([360.0, 240.0]) + 100 * torch.randn(corners, 2, generator=g, dtype=F64),
    }


def unknowns() -> dict[str, Variable]:
    pose = ts.SE3.exp(torch.tensor([0.05, -0.02, 0.1, 0.1, -0.2, 0.15], dtype=F64))
    return {
        "intrinsics": Variable("camera", CAMERA),
        "T_body_camera": Variable("extrinsics", pose, group=ts.SE3),
    }


def dense(problem: Problem) -> tuple[float, np.ndarray, np.ndarray]:
    linearizer = problem.prepare()
    system = linearizer(linearizer.model.state())
    matrix = np.stack([system.multiply(e) for e in np.eye(linearizer.model.total)], axis=1)
    return system.cost, system.right, matrix


@pytest.mark.parametrize("mode", ["fused", "reference"])
@pytest.mark.parametrize("distortion", list(KINDS))
@pytest.mark.parametrize("group", ["R3xSO3", "SE3"])
@pytest.mark.parametrize("known", [True, False])
def test_a_block_is_its_corners(group, distortion, mode, known):
    """Same cost, gradient, normal equations and residuals as one residual a corner; an unknown clock, outliers."""
    data, given, loss = sights(), {"sigma": 0.5, "loss": Huber(300.0)}, []
    with ts.use_kernels(mode):
        for block in (True, False):
            problem, variables = Problem(spline(group)), unknowns()
            clock = Clock(offset=Variable("offset", torch.tensor([-0.03], dtype=F64)))  # some images fall out
            if block:
                residual = ImageBlock(**data, distortion=distortion, clock=clock, **given, **variables)
            else:
                residual = KINDS[distortion](
                    data["t"][data["image"]], data["uv"], landmark=data["xyz"], clock=clock, **given, **variables
                )  # fmt: skip
            problem.add(residual)
            if known:
                problem.freeze(variables["intrinsics"])
            term = problem.prepare().terms[0]
            loss.append((*dense(problem), term.residuals(term.model.state()), term.numbers))
            assert int(term.places(term.model.state()).outside.sum()) > 0
    for a, b in zip(*loss, strict=True):
        assert np.allclose(a, b, rtol=1e-11, atol=1e-12 * np.abs(b).max())


def test_blocks_solve_to_what_corners_solve_to():
    data, found = sights(), []
    for block in (True, False):
        problem, variables = Problem(spline("R3xSO3")), unknowns()
        if block:
            problem.add(ImageBlock(**data, **variables))
        else:
            problem.add(
                ReprojectionRadtan(data["t"][data["image"]], data["uv"], landmark=data["xyz"], **variables)
            )
        for variable in variables.values():
            problem.freeze(variable)
        # Random pixels are no motion: only the way down is compared, step by step.
        found.append(problem.solve(max_iterations=4).cost)
    assert found[0] == pytest.approx(found[1], rel=1e-9)


def test_blocks_refuse_what_they_are_not_for():
    data, variables = sights(), unknowns()
    delay = Clock(delay=Variable("delay", torch.zeros(1, dtype=F64)), late=torch.zeros(12, dtype=F64))
    for changes, kind, message in (
        ({"clock": delay}, ValueError, "clock: .*line delay.*ReprojectionRadtan"),
        ({"distortion": "fisheye"}, ValueError, "distortion: .*'radtan', 'equidistant'"),
        ({"image": data["image"].double()}, ValueError, r"image: expected shape \(C,\) int64"),
        ({"image": data["image"] + 1}, ValueError, "image: expected indices from 0 to 11, got 2 to 12"),
        ({"uv": data["uv"][:-1]}, ValueError, r"uv: expected shape \(240, 2\), got \(239, 2\)"),
        ({"xyz": data["xyz"] * torch.nan}, ValueError, "xyz: .*finite"),
        ({"sigma": 0.0}, ValueError, "sigma: "),
        ({"t": [0.0]}, TypeError, "t: .*got list"),
        ({"intrinsics": CAMERA.expand(12, 8)}, ValueError, "intrinsics: expected one for all images"),
        ({"intrinsics": [1.0]}, TypeError, "intrinsics: .*got list"),
        ({"landmark": CAMERA}, TypeError, "landmark: ImageBlock takes no such argument"),
    ):
        with pytest.raises(kind, match=message):
            ImageBlock(**{**data, **variables, **changes})
    many = ts.BSpline(spline("SE3").control_points.detach()[None], group=ts.SE3, dt=0.1)
    batch = BatchProblem(many)
    batch.add(ImageBlock(**data, intrinsics=CAMERA), torch.zeros(12, dtype=torch.int64))
    with pytest.raises(NotImplementedError, match="ReprojectionRadtan"):
        batch.solve()
    problem = Problem(spline("SE3"))
    problem.add(Gyroscope(data["t"].requires_grad_(), torch.zeros(12, 3, dtype=F64)))
    problem.add(ImageBlock(**{**data, "t": data["t"].detach()}, intrinsics=CAMERA))
    with pytest.raises(ValueError, match=r"differentiable: ImageBlock .*ReprojectionRadtan"):
        problem.solve(max_iterations=1, differentiable=True)


# ---------------------------------------------------------------------- linear algebra


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("width", [7, 15])
def test_triangles_have_the_same_normal_equations(fused, width):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(500, 2, width))
    rows[40:60, :, 3] = 0.0  # a column that these rows say nothing about
    rows[60:100, :, 4] = 2.0 * rows[60:100, :, 2]  # and two that go together
    starts, weight = np.array([0, 0, 40, 60, 100, 500]), rng.uniform(0.0, 2.0, 500)
    found = triangles(fused, rows, starts, weight)
    assert found.shape == (5, width - 1, width)
    assert not found[0].any()
    for i in range(1, 5):
        part = slice(starts[i], starts[i + 1])
        J = (rows[part] * np.sqrt(weight[part])[:, None, None]).reshape(-1, width)
        gram = J.T @ J
        own = found[i].T @ found[i]
        assert np.allclose(own[:, :-1], gram[:, :-1], rtol=1e-10, atol=1e-10 * gram.max())
        assert np.allclose(np.tril(found[i], -1), 0.0)


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize(("n", "width"), [(0, 3), (1, 1), (5, 1), (7, 3), (3, 5), (40, 30), (61, 12)])
def test_the_band_of_an_inverse(n, width, fused):
    rng = np.random.default_rng(n)
    L = np.tril(np.triu(rng.normal(scale=0.3, size=(n, n)), -(width - 1)), -1) + 2 * np.eye(n)
    lower = np.full((n, width), np.nan)  # what stands beyond the end is nobody's
    inverse, expected = np.linalg.inv(L @ L.T) if n else L, np.zeros((n, width))
    for j in range(n):
        for d in range(min(width, n - j)):
            lower[j, d], expected[j, d] = L[j + d, j], inverse[j + d, j]
    found = inverse_band(fused, lower)
    there = np.arange(n)[:, None] + np.arange(width) < n
    assert np.allclose(found[there], expected[there], rtol=1e-11, atol=1e-13)


def gyroscopes(group: str = "R3xSO3", count: int = 60) -> Problem:
    """Readings and a few orientations, with a bias; positions stay."""
    g = torch.Generator().manual_seed(4)
    problem = Problem(ts.BSpline(spline(group).control_points.detach()[:, 3:], group=ts.SO3, order=4, dt=0.1))
    t = torch.linspace(0.0, 0.6, count, dtype=F64)
    bias = Variable("bias", torch.zeros(3, dtype=F64))
    problem.add(Gyroscope(t, torch.randn(count, 3, generator=g, dtype=F64), sigma=0.3, bias=bias))
    q = ts.SO3.normalize(torch.randn(20, 4, generator=g, dtype=F64))
    problem.add(Orientation(t[::3], q, sigma=0.2, loss=Huber(1.0)))
    return problem


@pytest.mark.parametrize("sparse", [False, True])
def test_redundancies_are_traces(sparse, monkeypatch):
    """Each that of a dense matrix; together what is left when unknowns are taken off."""
    if sparse:  # whatever is wider than nothing goes there
        monkeypatch.setattr("torchspline.fit.solving.linearizer._WIDEST_BAND", 0)
    problem = gyroscopes()
    result = problem.solve(max_iterations=3)
    linearizer, state = result._linearizer, result._state
    total = linearizer.model.total
    unit = np.eye(total)
    matrices = [linearizer.system_of(term, state) for term in linearizer.terms]
    dense_ones = [np.stack([m.multiply(e) for e in unit], axis=1) for m in matrices]
    inverse = np.linalg.inv(sum(dense_ones))
    for found, matrix, numbers in zip(result.redundancy.values(), dense_ones, (180, 60), strict=True):
        assert found == pytest.approx(numbers - np.trace(inverse @ matrix), rel=1e-9)
    assert sum(result.redundancy.values()) == pytest.approx(240 - total, rel=1e-9)
    assert np.allclose(result._factor.diagonal(), np.diagonal(inverse), rtol=1e-9)
    assert result.banded is not sparse


def test_scatter_of_stretches():
    """The gradient of each stretch from a problem of that stretch alone, and a dense inverse."""
    problem = gyroscopes()
    result = problem.solve()
    bias = problem.variables["bias"]
    _, _, H = dense(problem)
    inverse, variance = np.linalg.inv(H), np.zeros(3)
    for b in range(6):
        part = gyroscopes()
        part.trajectory.control_points.data.copy_(problem.trajectory.control_points.detach())
        part.variables["bias"].value = bias.value
        for residual in part.residuals:
            own = (residual.t / 0.1).floor().clamp(max=5).long() == b
            residual.t, residual.measured = residual.t[own], residual.measured[own]
        step = inverse @ dense_right(part)
        variance += np.square(step[-3:])
    expected = np.sqrt(6 / 5 * variance)
    plain = result.standard_deviation(bias).numpy()
    found = result.standard_deviation(bias, stretch=0.1).numpy()
    assert np.allclose(found, np.maximum(expected, plain), rtol=1e-6)
    assert np.allclose(result.standard_deviation(bias, stretch=7.0), found)  # six stretches at least
    assert (found >= plain).all()
    for bad, message in ((0.0, "stretch: .*got 0"), ("2", "stretch: "), (torch.nan, "stretch: ")):
        with pytest.raises((TypeError, ValueError), match=message):
            result.standard_deviation(bias, stretch=bad)


def dense_right(problem: Problem) -> np.ndarray:
    linearizer = problem.prepare()
    return linearizer(linearizer.model.state()).right


def test_scatter_tells_correlated_errors():
    """Errors alike over stretches: deviations by scatter are honest where those of independent errors are not."""
    errors, plain, wide = [], [], []
    for seed in range(12):
        g = torch.Generator().manual_seed(seed)
        still = ts.BSpline(torch.tensor([[1.0, 0, 0, 0]], dtype=F64).repeat(63, 1), group=ts.SO3, dt=0.1)
        t = torch.linspace(0.0, 5.99, 600, dtype=F64)
        wander = 0.1 * torch.randn(60, 3, generator=g, dtype=F64).repeat_interleave(10, 0)
        bias = Variable("bias", torch.zeros(3, dtype=F64))
        problem = Problem(still)
        problem.add(
            Gyroscope(t, wander + 0.01 * torch.randn(600, 3, generator=g, dtype=F64), sigma=0.1, bias=bias)
        )
        problem.freeze(still)
        result = problem.solve()
        errors.append(bias.value)
        plain.append(result.standard_deviation(bias))
        wide.append(result.standard_deviation(bias, stretch=0.1))
    scatter, small, large = (torch.stack(x).square().mean().sqrt() for x in (errors, plain, wide))
    assert float(scatter / small) > 2.0
    assert 0.7 < float(scatter / large) < 1.4
