"""torchspline: continuous-time motion as a PyTorch layer."""

from torchspline import fit, functional, imu
from torchspline.fit import Alignment, PoseFit, align_imu, fit_poses
from torchspline.groups import R3, SE2, SE3, SO2, SO3, DualQuaternion, Group, Rn, convert, product
from torchspline.kernels.mode import use_kernels
from torchspline.splines import (
    BSpline,
    Differentials,
    HermiteSpline,
    KeyframeSpline,
    Kinematics,
    NonuniformBSpline,
    SplitBSpline,
    State,
    Trajectory,
    consistent_signs,
    initial_control_points,
    phantom_points,
)

__version__ = "0.1.0"

__all__ = [
    "R3",
    "SE2",
    "SE3",
    "SO2",
    "SO3",
    "Alignment",
    "BSpline",
    "Differentials",
    "DualQuaternion",
    "Group",
    "HermiteSpline",
    "KeyframeSpline",
    "Kinematics",
    "NonuniformBSpline",
    "PoseFit",
    "Rn",
    "SplitBSpline",
    "State",
    "Trajectory",
    "align_imu",
    "consistent_signs",
    "convert",
    "fit",
    "fit_poses",
    "functional",
    "imu",
    "initial_control_points",
    "phantom_points",
    "product",
    "use_kernels",
]
