"""Any sensor of a rigid body on a link of a robot: the sensor's own residual after the chain of joints."""

from collections.abc import Sequence
from functools import cache
from typing import Any

from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.recurrence import Step, forward, reverse
from torchspline.arithmetic.registry import arithmetic
from torchspline.arithmetic.scalar import Scalar
from torchspline.arithmetic.vector import Vector, plus, times
from torchspline.fit.residual import Cotangents, Given, Moment, Residual
from torchspline.groups.group import Group


@cache
def on_link(
    kind: type[Residual],
    link: str,
    dof: int,
    pose: tuple[float, ...],
    screws: tuple[float, ...],
    index: tuple[int, ...],
    factor: tuple[float, ...],
    offset: tuple[float, ...],
) -> type[Residual]:
    """The class of residuals of trajectories in R^dof: numbers of the chain are constants of it, as most are zero.

    Args:
        kind: of a body on SE3. pose, screws, index, factor, offset: as `model.Path`; `index` its drivers.
    """
    se3 = arithmetic("SE3")
    steps = [tuple(screws[6 * j : 6 * j + 6]) for j in range(len(index))]
    kind_rows, kind_measured = kind.sizes(se3)
    sensor: Any = kind.__new__(kind)

    def chain(at: Moment) -> tuple[list[list[Scalar]], Moment, list[Step]]:
        """Weights of the screws, state of the link, and what each joint leaves for the way back."""
        weights = [
            [times(f, row[i]) for f, i in zip(factor, index, strict=True)] for row in (at.value, *at.rates)
        ]
        weights[0] = [plus(l, o) for l, o in zip(weights[0], offset, strict=True)]
        value, trace = forward(se3, pose, steps, weights, kind.derivatives)
        return weights, Moment(value, trace[-1].rates), trace

    class OnLink(Residual):
        rows, measured_size = kind_rows, kind_measured
        derivatives, moments, slots = kind.derivatives, kind.moments, kind.slots
        measured_signs = se3.sign_blocks if kind.rows is None and kind_measured == 7 else kind.measured_signs
        compiled = False

        def __reduce__(self) -> tuple[Any, ...]:
            # The class has no place in a module from which pickle could take it.
            made_of = (kind, link, dof, pose, screws, index, factor, offset)
            return _blank, made_of, self.__dict__

        @classmethod
        def check_group(cls, group: Group) -> None:
            if group.name != f"R{dof}":
                raise ValueError(
                    f"{cls.__name__}: expected a trajectory of the joints, in R{dof}, got {group}"
                )

        def evaluate(
            self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector
        ) -> Vector:
            return sensor.evaluate(se3, [chain(moment)[1] for moment in at], given, measured)

        def reverse(
            self, group: GroupArithmetic, at: Sequence[Moment], given: Given, measured: Vector, g: Vector
        ) -> tuple[list[Moment], Cotangents]:
            chains = [chain(moment) for moment in at]
            links_g, given_g = sensor.reverse(se3, [state for _, state, _ in chains], given, measured, g)
            joints_g = []
            for (weights, _, trace), link_g in zip(chains, links_g, strict=True):
                _, _, weights_g = reverse(
                    se3, steps, weights, trace, link_g.value, list(link_g.rates), steps_move=False
                )
                sums: list[list[Scalar]] = [[0.0] * dof for _ in weights_g]
                for row, row_g in zip(sums, weights_g, strict=True):
                    for i, f, weight_g in zip(index, factor, row_g, strict=True):
                        row[i] = plus(row[i], times(f, weight_g))
                value_g, *rates_g = map(tuple, sums)
                joints_g.append(Moment(value_g, tuple(rates_g)))
            return joints_g, given_g

    OnLink.__name__ = OnLink.__qualname__ = (
        f"{kind.__name__}On_{''.join(c if c.isalnum() else '_' for c in link)}"
    )
    return OnLink


def _blank(*made_of: Any) -> Residual:
    """One without contents, for pickle."""
    kind = on_link(*made_of)
    return kind.__new__(kind)
