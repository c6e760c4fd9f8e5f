"""All residuals. A new one is a file in this folder, imported and named here; `torchspline.fit` has them all."""

from torchspline.fit.residual import Residual
from torchspline.fit.residuals.accelerometer import Accelerometer
from torchspline.fit.residuals.angular_rate import AngularAcceleration, Gyroscope
from torchspline.fit.residuals.direction import Direction
from torchspline.fit.residuals.orientation import Orientation
from torchspline.fit.residuals.point import Point
from torchspline.fit.residuals.pose import Pose
from torchspline.fit.residuals.position import Position
from torchspline.fit.residuals.relative_pose import RelativePose
from torchspline.fit.residuals.reprojection import ReprojectionEquidistant, ReprojectionRadtan
from torchspline.fit.residuals.state import StateAcceleration, StateJerk, StateValue, StateVelocity
from torchspline.fit.residuals.velocity import BodyVelocity, WorldVelocity

__all__ = [
    "Accelerometer",
    "AngularAcceleration",
    "BodyVelocity",
    "Direction",
    "Gyroscope",
    "Orientation",
    "Point",
    "Pose",
    "Position",
    "RelativePose",
    "ReprojectionEquidistant",
    "ReprojectionRadtan",
    "StateAcceleration",
    "StateJerk",
    "StateValue",
    "StateVelocity",
    "WorldVelocity",
]

RESIDUALS: dict[str, type[Residual]] = {name: globals()[name] for name in __all__}
