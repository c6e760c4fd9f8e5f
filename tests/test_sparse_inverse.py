"""Elements of the inverse of a sparse system, some columns at a time."""

import numpy as np
import pytest
from scipy.sparse import csc_matrix

from torchspline.fit.solving import system


@pytest.mark.parametrize("together", [1, 7, 40, 256])
def test_elements_of_the_inverse_whatever_the_pieces(monkeypatch, together):
    monkeypatch.setattr(system, "_COLUMNS", together)
    rng = np.random.default_rng(together)
    jacobian = rng.normal(size=(80, 40)) * (rng.random((80, 40)) < 0.2)
    matrix = jacobian.T @ jacobian + np.eye(40)
    damping = rng.random(40)
    expected = np.linalg.inv(matrix + np.diag(damping))
    factor = system.SparseFactor(csc_matrix(matrix), damping)
    for shape in ((0,), (30,), (4, 6, 6)):
        i, j = rng.integers(0, 40, shape), rng.integers(0, 40, shape)
        found = factor.inverse(i, j)
        assert found.shape == shape
        np.testing.assert_allclose(found, expected[i, j], rtol=0, atol=1e-12)
    np.testing.assert_allclose(factor.diagonal(), np.diag(expected), rtol=0, atol=1e-12)
