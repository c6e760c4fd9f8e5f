"""What a camera is: a model of how it maps points to pixels, with its numbers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchspline import checks
from torchspline.io.sections import number

#: What files call the distortion models, and what they are called here.
DISTORTIONS = {
    "radtan": "radtan",
    "radtan4": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "equi": "equidistant",
    "equidistant4": "equidistant",
    "fisheye": "equidistant",
}


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with distortion, as `fit.ReprojectionRadtan` and `fit.ReprojectionEquidistant` define them.

    Attributes:
        name: for messages and titles.
        intrinsics: (fu, fv, pu, pv), focal lengths and principal point, pixels.
        coefficients: of the distortion, four plain numbers: k1 k2 p1 p2 ("radtan") or k1 k2 k3 k4 ("equidistant").
        resolution: (width, height), pixels.
        distortion: "radtan" or "equidistant".
        model: "pinhole".
    Raises:
        TypeError, ValueError: a wrong type, a number that is not finite, focal lengths or a resolution not above zero,
        an unknown model.
    """

    name: str
    intrinsics: tuple[float, float, float, float]
    coefficients: tuple[float, float, float, float]
    resolution: tuple[int, int]
    distortion: str = "radtan"
    model: str = "pinhole"

    def __post_init__(self) -> None:
        checks.instance("name", self.name, str, "a string")
        for name in ("intrinsics", "coefficients"):
            object.__setattr__(self, name, _numbers(name, getattr(self, name), 4))
        for focal in self.intrinsics[:2]:
            if focal <= 0:
                raise ValueError(f"intrinsics: expected focal lengths above zero, got {focal:g}")
        resolution = _numbers("resolution", self.resolution, 2)
        for size in resolution:
            if size != int(size) or size < 1:
                raise ValueError(f"resolution: expected whole pixels, at least 1, got {size:g}")
        object.__setattr__(self, "resolution", tuple(int(x) for x in resolution))
        checks.choice("distortion", self.distortion, ("radtan", "equidistant"))
        checks.choice("model", self.model, ("pinhole",))

    @property
    def parameters(self) -> Tensor:
        """(8,) float64: intrinsics, then coefficients, as the reprojection residuals take them."""
        return torch.tensor([*self.intrinsics, *self.coefficients], dtype=torch.float64)


def camera_from(section: Mapping[str, Any], name: str) -> Camera:
    """The camera that a section of a YAML file describes, in the words of Kalibr or of basalt's data sets.

    Raises:
        ValueError: an entry that is missing or wrong; the message names it.
    """

    def entry(*names: str) -> Any:
        for key in names:
            if key in section:
                return section[key]
        raise ValueError(
            f"{names[0]}: expected it in the section {name}, got only {', '.join(map(str, section))}"
        )

    model = str(entry("camera_model", "proj_model"))
    distortion = str(entry("distortion_model", "dist_model"))
    if model != "pinhole":
        raise ValueError(f"camera_model: expected 'pinhole', got {model!r}")
    if distortion not in DISTORTIONS:
        raise ValueError(f"distortion_model: expected one of {', '.join(DISTORTIONS)}, got {distortion!r}")

    def numbers(name: str, x: Any, count: int) -> Any:
        return _numbers(name, [number(name, y) for y in x] if isinstance(x, list) else x, count)

    return Camera(
        name=name,
        intrinsics=numbers("intrinsics", entry("intrinsics", "proj_params"), 4),
        coefficients=numbers("distortion_coeffs", entry("distortion_coeffs", "dist_params"), 4),
        resolution=numbers("resolution", entry("resolution"), 2),
        distortion=DISTORTIONS[distortion],
    )


def _numbers(name: str, x: Any, count: int) -> Any:
    """A tuple of `count` finite floats."""
    if isinstance(x, Tensor):
        x = x.tolist()
    if not isinstance(x, (list, tuple)):
        raise TypeError(f"{name}: expected {count} numbers, got {type(x).__name__}")
    if len(x) != count:
        raise ValueError(f"{name}: expected {count} numbers, got {len(x)}")
    return tuple(float(checks.finite_number(name, y)) for y in x)
