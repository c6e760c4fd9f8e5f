"""Residuals of the motion of a rigid body: its pose, velocities and accelerations, whichever group carries it."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion
from torchspline.arithmetic.vector import Vector
from torchspline.fit.residual import Cotangents, Given, Moment, Residual, needs
from torchspline.groups.group import Group


class MotionResidual(Residual):
    """A measurement of a body's `Motion` at one time.

    A kind of it writes `error` and `error_reverse`; what the state of a group has to do with the motion of a body is
    the business of `arithmetic/motion.py`.
    """

    #: What the trajectory has to be: one that rotates, one that moves, or both.
    rotates: ClassVar[bool] = True
    moves: ClassVar[bool] = True

    @classmethod
    def check_group(cls, group: Group) -> None:
        needs(cls.__name__, group, cls.rotates, cls.moves)

    @abstractmethod
    def error(self, motion: Motion, given: Given, measured: Vector) -> Vector:
        """The residual, as `Residual.evaluate`."""

    @abstractmethod
    def error_reverse(
        self, motion: Motion, given: Given, measured: Vector, g: Vector
    ) -> tuple[Motion, Cotangents]:
        """Cotangents of the motion and of `given`, from that of the residual."""

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector
    ) -> Vector:
        return self.error(MOTIONS[group.name].motion(at[0].value, at[0].rates), given, measured)

    def reverse(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector, g: Vector
    ) -> tuple[list[Moment], Cotangents]:
        mechanics, (value, rates) = MOTIONS[group.name], at[0]
        motion = mechanics.motion(value, rates)
        motion_g, given_g = self.error_reverse(motion, given, measured, g)
        value_g, rates_g = mechanics.reverse(value, rates, motion, motion_g)
        return [Moment(value_g, tuple(rates_g))], given_g
