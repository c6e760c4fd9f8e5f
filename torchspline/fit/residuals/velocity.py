"""A measured velocity of a point of the body, against the world: in the world's axes, or in those of the sensor."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.motion import (
    MOTIONS,
    Motion,
    attached,
    attached_reverse,
    turned,
    turned_reverse,
)
from torchspline.arithmetic.so3 import rotate, unrotate
from torchspline.arithmetic.vector import Vector, add, cross, negate
from torchspline.fit.residual import LEVER_ARM, ROTATION_IN_BODY, Moment, Residual, needs
from torchspline.groups.group import Group


class WorldVelocity(Residual):
    """`R_body (v + w x l) - measured`, m/s, in the world: the Doppler velocity of an antenna.

    Arguments:
        lever_arm: l, position of the antenna in the body, m.
    """

    rows, measured_size, derivatives = 3, 3, 1
    slots: ClassVar = {"lever_arm": LEVER_ARM}

    @classmethod
    def check_group(cls, group: Group) -> None:
        needs(cls.__name__, group, moves=True)

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Mapping[str, Vector], measured: Vector
    ) -> Vector:
        motion = MOTIONS[group.name].motion(at[0].value, at[0].rates)
        return add(rotate(motion.q, attached(motion, given["lever_arm"]).v), negate(measured))

    def reverse(
        self,
        group: GroupArithmetic,
        at: Sequence[Moment],
        given: Mapping[str, Vector],
        measured: Vector,
        g: Vector,
    ) -> tuple[list[Moment], dict[str, Vector]]:
        mechanics = MOTIONS[group.name]
        motion = mechanics.motion(at[0].value, at[0].rates)
        v, v_g = attached(motion, given["lever_arm"]).v, unrotate(motion.q, g)
        motion_g, arm_g = attached_reverse(motion, given["lever_arm"], Motion(v=v_g))
        # R Exp(x) v = R (v + x x v), and g . R (x x v) = x . (v x R^T g)
        motion_g = motion_g._replace(q=add(motion_g.q, cross(v, v_g)))
        value_g, rates_g = mechanics.reverse(at[0].value, at[0].rates, motion, motion_g)
        return [Moment(value_g, tuple(rates_g))], {"lever_arm": arm_g}


class BodyVelocity(Residual):
    """`R^T (v + w x l) - measured`, m/s, in the sensor's frame: wheel odometry, a Doppler log, radar.

    Arguments:
        rotation: R, SO3, sensor to body. lever_arm: l, position of the sensor in the body, m.
    """

    rows, measured_size, derivatives = 3, 3, 1
    slots: ClassVar = {"rotation": ROTATION_IN_BODY, "lever_arm": LEVER_ARM}

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Mapping[str, Vector], measured: Vector
    ) -> Vector:
        motion = MOTIONS[group.name].motion(at[0].value, at[0].rates)
        return add(turned(given["rotation"], attached(motion, given["lever_arm"]).v), negate(measured))

    def reverse(
        self,
        group: GroupArithmetic,
        at: Sequence[Moment],
        given: Mapping[str, Vector],
        measured: Vector,
        g: Vector,
    ) -> tuple[list[Moment], dict[str, Vector]]:
        mechanics = MOTIONS[group.name]
        motion = mechanics.motion(at[0].value, at[0].rates)
        seen = turned(given["rotation"], attached(motion, given["lever_arm"]).v)
        rotation_g, v_g = turned_reverse(given["rotation"], seen, g)
        motion_g, arm_g = attached_reverse(motion, given["lever_arm"], Motion(v=v_g))
        value_g, rates_g = mechanics.reverse(at[0].value, at[0].rates, motion, motion_g)
        return [Moment(value_g, tuple(rates_g))], {"rotation": rotation_g, "lever_arm": arm_g}
