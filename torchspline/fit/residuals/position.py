"""A measured position of a point of the body: motion capture markers, satellite navigation."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import MOTIONS, Motion, attached, attached_reverse
from torchspline.arithmetic.vector import Vector, add, negate
from torchspline.fit.residual import LEVER_ARM, Moment, Residual, needs
from torchspline.groups.group import Group


class Position(Residual):
    """`p + R_body l - measured`, m, in the world.

    Arguments:
        lever_arm: l, position of the antenna or marker in the body, m; in R3, where nothing turns, along the axes of
            the world.
    """

    rows, measured_size, derivatives = 3, 3, 0
    slots: ClassVar = {"lever_arm": LEVER_ARM}

    @classmethod
    def check_group(cls, group: Group) -> None:
        needs(cls.__name__, group, moves=True)

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Mapping[str, Vector], measured: Vector
    ) -> Vector:
        motion = MOTIONS[group.name].motion(at[0].value, ())
        return add(attached(motion, given["lever_arm"]).p, negate(measured))

    def reverse(
        self,
        group: GroupArithmetic,
        at: Sequence[Moment],
        given: Mapping[str, Vector],
        measured: Vector,
        g: Vector,
    ) -> tuple[list[Moment], dict[str, Vector]]:
        mechanics = MOTIONS[group.name]
        motion = mechanics.motion(at[0].value, ())
        motion_g, arm_g = attached_reverse(motion, given["lever_arm"], Motion(p=g))
        value_g, _ = mechanics.reverse(at[0].value, (), motion, motion_g)
        return [Moment(value_g, ())], {"lever_arm": arm_g}
