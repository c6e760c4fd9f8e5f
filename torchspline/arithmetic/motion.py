"""How the state of a group reads as the motion of a rigid body, and the way back for cotangents.

Sensors on a body do not care which group carries its motion: they see the pose and, in the body frame, velocities and
accelerations. A group that moves a body adds a class and a line in `MOTIONS`.

=========================  ==========================================================================
q, p                       rotation body to world, position in the world
v, a                       velocity and acceleration of the body origin against the world, in the body frame
w, alpha                   angular velocity and acceleration, body frame
value, rates               the state: point X, body tangent X^-1 dX/dt and its derivatives, per second
g_...                      cotangents; those of q are of a body tangent
=========================  ==========================================================================
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

from torchspline.arithmetic.so3 import rotate, unrotate
from torchspline.arithmetic.vector import Vector, add, cross, negate, zero

_NONE = zero(3)


class Motion(NamedTuple):
    """Of a body, or the cotangents of one (then q has three components); what is not known or asked for is zero."""

    q: Vector = _NONE
    p: Vector = _NONE
    v: Vector = _NONE
    a: Vector = _NONE
    w: Vector = _NONE
    alpha: Vector = _NONE


class Mechanics(ABC):
    """Between the state of a group and the motion of a body."""

    #: Whether the group carries a rotation and a position.
    rotates, moves = True, True

    @abstractmethod
    def motion(self, value: Vector, rates: Sequence[Vector]) -> Motion:
        """Of up to two rates."""

    @abstractmethod
    def reverse(
        self, value: Vector, rates: Sequence[Vector], motion: Motion, g: Motion
    ) -> tuple[Vector, list[Vector]]:
        """Cotangents of the value (body tangent) and of as many rates as were given."""


class OfSO3(Mechanics):
    moves = False

    def motion(self, value: Vector, rates: Sequence[Vector]) -> Motion:
        w, alpha = _two(rates, 3)
        return Motion(q=value, w=w, alpha=alpha)

    def reverse(
        self, value: Vector, rates: Sequence[Vector], motion: Motion, g: Motion
    ) -> tuple[Vector, list[Vector]]:
        return g.q, [g.w, g.alpha][: len(rates)]


class OfR3(Mechanics):
    """A point; its body frame is the world."""

    rotates = False

    def motion(self, value: Vector, rates: Sequence[Vector]) -> Motion:
        v, a = _two(rates, 3)
        return Motion(q=(1.0, 0.0, 0.0, 0.0), p=value, v=v, a=a)

    def reverse(
        self, value: Vector, rates: Sequence[Vector], motion: Motion, g: Motion
    ) -> tuple[Vector, list[Vector]]:
        return g.p, [g.v, g.a][: len(rates)]


class OfSplit(Mechanics):
    """R3xSO3: the rates of the position are those of the world."""

    def motion(self, value: Vector, rates: Sequence[Vector]) -> Motion:
        q, (first, second) = value[3:], _two(rates, 6)
        return Motion(q, value[:3], unrotate(q, first[:3]), unrotate(q, second[:3]), first[3:], second[3:])

    def reverse(
        self, value: Vector, rates: Sequence[Vector], motion: Motion, g: Motion
    ) -> tuple[Vector, list[Vector]]:
        # A body tangent x of q changes R^T y by (R^T y) x x, so that g . that is x . (g x (R^T y)).
        turned = add(g.q, cross(g.v, motion.v), cross(g.a, motion.a))
        rates_g = [(*rotate(motion.q, g.v), *g.w), (*rotate(motion.q, g.a), *g.alpha)]
        return (*g.p, *turned), rates_g[: len(rates)]


class OfSE3(Mechanics):
    """[S20] (33) and (40): the acceleration is the translation column of w^ w^ + a^."""

    def motion(self, value: Vector, rates: Sequence[Vector]) -> Motion:
        first, second = _two(rates, 6)
        v, w = first[:3], first[3:]
        return Motion(value[3:], value[:3], v, add(second[:3], cross(w, v)), w, second[3:])

    def reverse(
        self, value: Vector, rates: Sequence[Vector], motion: Motion, g: Motion
    ) -> tuple[Vector, list[Vector]]:
        v_g = add(g.v, cross(g.a, motion.w))
        w_g = add(g.w, cross(motion.v, g.a))
        moved = unrotate(motion.q, g.p)
        return (*moved, *g.q), [(*v_g, *w_g), (*g.a, *g.alpha)][: len(rates)]


MOTIONS: dict[str, Mechanics] = {"SO3": OfSO3(), "R3": OfR3(), "R3xSO3": OfSplit(), "SE3": OfSE3()}


def attached(motion: Motion, arm: Vector) -> Motion:
    """The motion of the point `arm` of the body: positions and rates carried over the lever arm."""
    w_arm = cross(motion.w, arm)
    return motion._replace(
        p=add(motion.p, rotate(motion.q, arm)),
        v=add(motion.v, w_arm),
        a=add(motion.a, cross(motion.alpha, arm), cross(motion.w, w_arm)),
    )


def attached_reverse(motion: Motion, arm: Vector, g: Motion) -> tuple[Motion, Vector]:
    """Cotangents of the motion and of the arm, from those of `attached`."""
    w_arm, p_g = cross(motion.w, arm), unrotate(motion.q, g.p)
    # (alpha x arm) . g = alpha . (arm x g) = arm . (g x alpha)
    w_arm_g = add(g.v, cross(g.a, motion.w))
    arm_g = add(p_g, cross(g.a, motion.alpha), cross(w_arm_g, motion.w))
    back = g._replace(
        q=add(g.q, cross(arm, p_g)),
        w=add(g.w, cross(w_arm, g.a), cross(arm, w_arm_g)),
        alpha=add(g.alpha, cross(arm, g.a)),
    )
    return back, arm_g


def turned(q: Vector, v: Vector) -> Vector:
    """A body vector as seen from a frame with rotation q in the body."""
    return unrotate(q, v)


def turned_reverse(q: Vector, seen: Vector, g: Vector) -> tuple[Vector, Vector]:
    """Cotangents of the rotation (its own body tangent) and of the vector, from that of what is `seen`."""
    return cross(g, seen), rotate(q, g)


def sighted(motion: Motion, T: Vector, point: Vector) -> Vector:
    """A point of the world as seen from a frame with pose T in the body."""
    inside = unrotate(motion.q, add(point, negate(motion.p)))
    return turned(T[3:], add(inside, negate(T[:3])))


def sighted_reverse(motion: Motion, T: Vector, point: Vector, g: Vector) -> tuple[Motion, Vector, Vector]:
    """Cotangents of the motion, of T (body tangent) and of the point, from that of what is seen."""
    inside = unrotate(motion.q, add(point, negate(motion.p)))
    seen = turned(T[3:], add(inside, negate(T[:3])))
    turn_g, inside_g = turned_reverse(T[3:], seen, g)
    point_g = rotate(motion.q, inside_g)
    return Motion(q=cross(inside_g, inside), p=negate(point_g)), (*negate(g), *turn_g), point_g


def _two(rates: Sequence[Vector], size: int) -> tuple[Vector, Vector]:
    first, second, *_ = (*rates, zero(size), zero(size))
    return first, second
