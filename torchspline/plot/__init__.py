"""Figures. Matplotlib is imported when one is drawn, and draws without a screen.

Every function returns a `matplotlib.figure.Figure`; `figure.savefig(path)` writes it. `allan_panel` draws on axes.
"""

from torchspline.plot.basis import basis, basis_functions
from torchspline.plot.inertial import allan, allan_panel, imu_comparison
from torchspline.plot.motion import covariance_tube, rates, trajectory
from torchspline.plot.residuals import residuals

__all__ = [
    "allan",
    "allan_panel",
    "basis",
    "basis_functions",
    "covariance_tube",
    "imu_comparison",
    "rates",
    "residuals",
    "trajectory",
]
