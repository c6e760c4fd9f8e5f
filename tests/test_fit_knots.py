"""Which spacing changes between neighbouring fits speak for."""

import pytest
import torch

from torchspline import SO3, fit_poses
from torchspline.fit.knots import _least

RATIO = 2**0.5


@pytest.mark.parametrize(
    ("changes", "best"),
    [
        # Noise falls, missed motion rises: the parabola through three lies between their spacings.
        ([8.0, 4.0, 2.0, 1.0, 2.0, 4.0, 8.0], 3),
        # Wide fits agree on missing the motion.
        ([8.0, 4.0, 2.0, 1.0, 2.0, 4.0, 2.0, 0.5, 0.1], 3),
        # Motion of all frequencies: changes level out, and fall again where nothing is left to miss.
        ([8.0, 4.0, 2.0, 1.8, 1.6, 1.4, 1.0, 0.7, 0.5, 0.3, 0.1], 2),
        # Smooth noise does not show between narrow spacings.
        ([1.0, 1.1, 1.4, 1.5, 3.0, 6.0], 3),
    ],
)
def test_the_first_minimum_counts(changes, best):
    tried = [RATIO**i for i in range(len(changes) + 1)]
    spacing, change = _least(tried, changes)
    assert change == changes[best]
    # The parabola moves it by half a step at most.
    assert RATIO**best * 0.999 < spacing < RATIO ** (best + 1) * 1.001


def test_bursts_do_not_ask_for_knots_between_them():
    """Triples of poses a fraction of a microsecond apart, ten a second."""
    t = (torch.arange(200, dtype=torch.float64)[:, None] / 10 + 1e-7 * torch.arange(3)).reshape(-1)
    angle = torch.sin(0.7 * t)[:, None] * torch.tensor([[0.3, 0.1, -0.2]], dtype=torch.float64)
    poses = torch.cat([torch.cos(0.5 * t)[:, None].expand(-1, 3), SO3.exp(angle)], dim=-1)
    fit = fit_poses(t, poses, dt="auto", progress=False)
    assert fit.trajectory.dt > 0.04
    assert max(fit.rms()) < 1e-3


@pytest.mark.parametrize("accuracy", [(2e-5, 1e-5), (4.4e-3, 1e-5), (5.9e-3, 1e-3), (1e-4, 1e-2)])
def test_an_accuracy_asked_for_is_kept(accuracy):
    """Also where positions may have wider knots than rotations, by a ratio that is no whole number."""
    t = torch.arange(1200, dtype=torch.float64) / 100
    angle = torch.sin(3.0 * t)[:, None] * torch.tensor([[0.6, 0.2, -0.4]], dtype=torch.float64)
    position = torch.stack([torch.cos(2.0 * t), torch.sin(2.0 * t), torch.sin(1.3 * t)], dim=-1)
    fit = fit_poses(
        t, torch.cat([position, SO3.exp(angle)], -1), dt="auto", accuracy=accuracy, progress=False
    )
    for reached, limit in zip(fit.rms(), accuracy, strict=True):
        assert reached <= limit * 1.02
    assert fit.trajectory.dt > 0.03
