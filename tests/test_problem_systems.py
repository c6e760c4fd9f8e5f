"""Band, sparse and dense matrices of the same problem, and the compiled loops that fill them."""

from functools import partial

import numpy as np
import pytest
import torch
from batteries import generator, normal
from fit_cases import spread, trajectory
from fit_oracle import Oracle, check_assembly

from torchspline import SE3
from torchspline.fit import Gyroscope, Point, Pose, Problem, RelativePose, Variable, smoothness
from torchspline.fit.solving.system import BandSystem, SparseSystem
from torchspline.kernels import assemble

# ---------------------------------------------------------------------- band, sparse, dense


def far_apart(count=60):
    spline = trajectory(SE3, count=count)
    low, high = spline.domain
    pair = torch.tensor([[low + 0.1, low + 0.5], [high - 0.2, high - 0.1]], dtype=torch.float64)
    problem = Problem(spline)
    problem.add(RelativePose(pair, SE3.random(2, generator=generator(1)), sigma=0.3))
    problem.add(Pose(spread(spline, 60), SE3.random(60, generator=generator(2))))
    problem.add(smoothness(spline, sigma=1.0))
    return problem


def many_landmarks():
    spline = trajectory(SE3)
    problem, index = Problem(spline), torch.arange(120) % 110
    landmarks = Variable("landmarks", normal(110, 3, seed=1))
    problem.add(Point(spread(spline, 120), normal(120, 3, seed=2), landmark=landmarks), landmark=index)
    problem.add(Pose(spread(spline, 20), SE3.random(20, generator=generator(2))))
    return problem, {"Point": {"landmark": index}}


def test_distant_relative_poses_go_to_a_sparse_matrix():
    problem = far_apart()
    linearizer = problem.prepare()
    assert isinstance(linearizer(linearizer.model.state()), SparseSystem)
    check_assembly(problem)
    near_ones = far_apart(count=8).prepare()
    assert isinstance(near_ones(near_ones.model.state()), BandSystem)


def test_many_landmarks_go_to_a_sparse_matrix():
    problem, indices = many_landmarks()
    linearizer = problem.prepare()
    assert isinstance(linearizer(linearizer.model.state()), SparseSystem)
    check_assembly(problem, indices)


def systems(problem):
    """The same equations as a band, and as a sparse matrix."""
    linearizer = problem.prepare()
    model, state = linearizer.model, linearizer.model.state()
    made = [BandSystem(model, linearizer.fused, model.band), SparseSystem(model, linearizer.fused)]
    for system in made:
        for term in linearizer.terms:
            term.add_to(system, state)
    return made


def with_border():
    spline = trajectory(SE3)
    problem, t = Problem(spline), spread(spline, 60)
    problem.add(Gyroscope(t, normal(60, 3, seed=1), bias=Variable("bias", normal(3, seed=1))))
    problem.add(
        Pose(
            t, SE3.random(60, generator=generator(2)), T_body_sensor=Variable("T", SE3.identity(), group=SE3)
        )
    )
    problem.add(smoothness(spline, sigma=1.0))
    return problem


@pytest.mark.parametrize("make", [far_apart, with_border])
def test_band_sparse_and_dense_solutions_agree(make):
    problem = make()
    damping = 0.01 + normal(problem.prepare().model.total, seed=8).abs().numpy()
    right = normal(len(damping), 4, seed=9).numpy()
    dense = Oracle(problem).dense().matrix.numpy() + np.diag(damping)
    expected = np.linalg.solve(dense, right)
    for system in systems(problem):
        factor = system.factor(damping)
        np.testing.assert_allclose(
            factor.solve(right), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max()
        )
        np.testing.assert_allclose(
            factor.solve(right[:, 0]), expected[:, 0], rtol=1e-8, atol=1e-8 * np.abs(expected).max()
        )


def test_a_term_that_is_known_as_a_matrix():
    problem = with_border()
    total = problem.prepare().model.total
    columns = np.array([3, total - 1, 20, -1, total - 4, 8])
    x = normal(6, 6, seed=3).numpy()
    matrix, right = x @ x.T, normal(6, seed=4).numpy()
    keep = columns >= 0
    expected = np.zeros((total, total))
    expected[np.ix_(columns[keep], columns[keep])] = matrix[np.ix_(keep, keep)]
    for system in systems(problem):
        before, g = np.stack([system.multiply(e) for e in np.eye(total)], axis=-1), system.right.copy()
        system._matrix = None
        system.add_dense(columns, matrix, right)
        after = np.stack([system.multiply(e) for e in np.eye(total)], axis=-1)
        np.testing.assert_allclose(after - before, expected, atol=1e-11 * np.abs(before).max())
        np.testing.assert_allclose((system.right - g)[columns[keep]], right[keep], atol=1e-10)


# ---------------------------------------------------------------------- compiled loops


def loop_arguments(seed=0, splines=2, order=4, size=6, others=5):
    """Random rows in runs, and where they go: columns of two windows of splines and of a border, some frozen."""
    random = np.random.default_rng(seed)
    runs, points, n = 7, 20, 20 * size
    starts = np.concatenate([[0], np.cumsum(random.integers(0, 70, runs))])
    width = splines * order * size + others + 1
    rows = random.normal(size=(starts[-1], 3, width))
    bases = np.sort(random.integers(0, points - order, (runs, splines)), axis=0)
    chain = random.normal(size=(points, 2, size, size))
    chain[:, 0, 0] = 0.0
    windows = (bases[:, :, None] + np.arange(order)).reshape(runs, -1)
    columns = (windows[:, :, None] * size + np.arange(size)).reshape(runs, -1)
    columns = np.concatenate([columns, np.tile(n + random.permutation(others), (runs, 1))], axis=1)
    columns[columns % 11 == 3] = -1
    return rows, starts, bases, chain, order, size, columns, n, n + others


@pytest.mark.slow
@pytest.mark.parametrize("splines", [0, 1, 2])
def test_the_loops_of_assembly_agree_whatever_they_run_on(splines):
    rows, starts, bases, chain, order, size, columns, n, total = loop_arguments(seed=splines, splines=splines)
    common = (rows, starts, bases, chain, order, size, columns.astype(np.int64))
    # Rows in control points, one by one.
    expected, right = np.zeros((total, total)), np.zeros(total)
    for run in range(len(starts) - 1):
        T = np.eye(rows.shape[2] - 1)
        for s in range(splines):
            for j in range(order - 1, 0, -1):
                at = (s * order + j) * size
                pair = chain[bases[run, s] + j - 1]
                T[at : at + size, at - size : at], T[at : at + size, at : at + size] = pair[0], pair[1]
        lines = rows[starts[run] : starts[run + 1]].reshape(-1, rows.shape[2])
        J = np.zeros((len(lines), total))
        for c, column in enumerate(columns[run]):
            if column >= 0:
                J[:, column] += (lines[:, :-1] @ T)[:, c]
        expected += J.T @ J
        right += J.T @ lines[:, -1]
    scale = np.abs(expected).max()
    reference, compiled = (partial(assemble.add_to_band, x) for x in (False, True))
    blocks_of = (
        partial(assemble.add_to_blocks, False),
        assemble.to_blocks,
        partial(assemble.add_to_blocks, True),
    )
    for to_band, to_blocks in zip((reference, assemble.to_band, compiled), blocks_of, strict=True):
        band, border = np.zeros((n, n)), np.zeros((n, total - n))
        corner, got = np.zeros((total - n, total - n)), np.zeros(total)
        assert to_band(*common, band, border, corner, got) == 0
        dense = np.zeros((total, total))
        for d in range(n):
            dense[np.arange(d, n), np.arange(n - d)] = band[: n - d, d]
        dense[n:, :n], dense[n:, n:] = border.T, corner
        dense = np.tril(dense) + np.tril(dense, -1).T
        np.testing.assert_allclose(dense, expected, atol=1e-12 * scale)
        np.testing.assert_allclose(got, right, atol=1e-12 * np.abs(right).max())
        assert to_band(*common, band[:, :size].copy(), border, corner, got) > 0 or splines == 0
        blocks, got = np.empty((len(starts) - 1, columns.shape[1], columns.shape[1])), np.zeros(total)
        to_blocks(*common, blocks, got)
        dense = np.zeros((total + 1, total + 1))
        for block, line in zip(blocks, columns, strict=True):
            np.add.at(dense, np.ix_(line, line), block)
        np.testing.assert_allclose(dense[:-1, :-1], expected, atol=1e-12 * scale)
        np.testing.assert_allclose(got, right, atol=1e-12 * np.abs(right).max())
