"""All residuals. A new one is one file in this folder and one line here."""

from torchspline.fit.residual import Residual
from torchspline.fit.residuals.accelerometer import Accelerometer
from torchspline.fit.residuals.gyroscope import Gyroscope
from torchspline.fit.residuals.pose import Pose
from torchspline.fit.residuals.state import StateAcceleration, StateJerk, StateValue, StateVelocity

RESIDUALS: dict[str, type[Residual]] = {
    kind.__name__: kind
    for kind in (
        Accelerometer,
        Gyroscope,
        Pose,
        StateAcceleration,
        StateJerk,
        StateValue,
        StateVelocity,
    )
}
