"""All schemes by plain name, and the survey's names for them. A new scheme is a module beside this one and a
line here."""

from typing import NamedTuple

from torchspline.splines.interpolation.bezier import Bernstein, Casteljau
from torchspline.splines.interpolation.bsplines import BlendedBSpline, CumulativeBSpline
from torchspline.splines.interpolation.composite_bezier import CompositeBezier
from torchspline.splines.interpolation.geodesic import Geodesic
from torchspline.splines.interpolation.linear import Linear
from torchspline.splines.interpolation.scheme import Scheme
from torchspline.splines.interpolation.squad import Squad

SCHEMES: dict[str, Scheme] = {
    "geodesic": Geodesic(),
    "linear": Linear(),
    "squad": Squad(),
    "bezier": Casteljau(),
    "bernstein": Bernstein(),
    "composite_bezier": CompositeBezier(),
    "bspline": BlendedBSpline(),
    "cumulative_bspline": CumulativeBSpline(),
}


class Named(NamedTuple):
    """What a name of [H18] stands for: a scheme, and the group it is on; "Rn" as the keys have numbers."""

    scheme: str
    group: str


#: [H18]; those of rigid motions take the poses of their group: [x, y, z, qw, qx, qy, qz] or dual quaternions.
SURVEY: dict[str, Named] = {
    "LERP": Named("geodesic", "Rn"),
    "Bezier": Named("bezier", "Rn"),
    "CompositeBezier": Named("composite_bezier", "Rn"),
    "BSpline": Named("bspline", "Rn"),
    "QLB": Named("linear", "SO3"),
    "SLERP": Named("geodesic", "SO3"),
    "SQUAD": Named("squad", "SO3"),
    "RQBez": Named("composite_bezier", "SO3"),
    "CuBsp": Named("cumulative_bspline", "SO3"),
    "QLB+LERP": Named("linear", "R3xSO3"),
    "SPLIT": Named("geodesic", "R3xSO3"),
    "SPLIT SQUAD": Named("squad", "R3xSO3"),
    "SPLIT CuBsp": Named("cumulative_bspline", "R3xSO3"),
    "SE3Up": Named("geodesic", "SE3"),
    "SpFus": Named("cumulative_bspline", "SE3"),
    "ScLERP": Named("geodesic", "DualQuaternion"),
    "DLB": Named("linear", "DualQuaternion"),
    "ScFus": Named("cumulative_bspline", "DualQuaternion"),
    "DLFus": Named("bspline", "DualQuaternion"),
}
