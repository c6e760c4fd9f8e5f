"""torchspline: continuous-time motion as a PyTorch layer."""

from torchspline import functional
from torchspline.groups import R3, SE3, SO3, Group, Rn, product
from torchspline.splines import BSpline, Kinematics, SplitBSpline, State, Trajectory

__all__ = [
    "R3",
    "SE3",
    "SO3",
    "BSpline",
    "Group",
    "Kinematics",
    "Rn",
    "SplitBSpline",
    "State",
    "Trajectory",
    "functional",
    "product",
]
