"""The state itself, as `Trajectory.evaluate` gives it: a point of the group, or a derivative in its body frame."""

from collections.abc import Sequence
from typing import ClassVar

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.vector import Vector, add, negate, zero
from torchspline.fit.residual import Cotangents, Given, Moment, Residual
from torchspline.groups.group import Group


class _OfState(Residual):
    """Sizes are those of the group."""

    rows, measured_size = None, None

    @classmethod
    def check_group(cls, group: Group) -> None:
        """Any will do."""


class StateValue(_OfState):
    """`Log(X(t) X_measured^-1)`, [S20] 6.1: a measured point of any group, the error a tangent of the world's side."""

    derivatives = 0

    @classmethod
    def sizes(cls, group: GroupArithmetic) -> tuple[int, int]:
        return group.tangent_size, group.point_size

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector
    ) -> Vector:
        return group.log(group.compose(at[0].value, group.inverse(group.normalize(measured))))

    def reverse(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector, g: Vector
    ) -> tuple[list[Moment], Cotangents]:
        # X Exp(x) Y^-1 = Exp(Ad_X x) X Y^-1
        inverse = group.inverse(at[0].value)
        left = group.left_jacobian_inverse_transpose(self.evaluate(group, at, given, measured), g, short=True)
        return [Moment(group.coadjoint_inverse(inverse, left), ())], {}


class _StateRate(_OfState):
    """A measured derivative of the state, minus it: body frame, per second."""

    @classmethod
    def sizes(cls, group: GroupArithmetic) -> tuple[int, int]:
        return group.tangent_size, group.tangent_size

    def evaluate(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector
    ) -> Vector:
        return add(at[0].rates[-1], negate(measured))

    def reverse(
        self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector, g: Vector
    ) -> tuple[list[Moment], Cotangents]:
        nothing = zero(group.tangent_size)
        return [Moment(nothing, (*(nothing,) * (self.derivatives - 1), g))], {}


class StateVelocity(_StateRate):
    """A measured `State.velocity`, [S20] 6.1."""

    derivatives: ClassVar[int] = 1


class StateAcceleration(_StateRate):
    """A measured `State.acceleration`, [S20] 6.1."""

    derivatives: ClassVar[int] = 2


class StateJerk(_StateRate):
    """A measured `State.jerk`."""

    derivatives: ClassVar[int] = 3
