"""Kinds of random motion. To add one, write a module with a subclass of `Motion` and name it here."""

from torchspline.generate.motions.band_limited import BandLimited
from torchspline.generate.motions.drone import Drone
from torchspline.generate.motions.figure_eight import FigureEight
from torchspline.generate.motions.motion import Motion
from torchspline.generate.motions.smooth import Smooth
from torchspline.generate.motions.walking import Walking

MOTIONS: dict[str, type[Motion]] = {
    kind.name: kind for kind in (Smooth, BandLimited, FigureEight, Walking, Drone)
}
