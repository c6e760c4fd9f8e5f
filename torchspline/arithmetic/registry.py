"""All groups by name. A new group is one module in this folder and one line here."""

import re

from torchspline.arithmetic.dual_quaternion import DualQuaternion
from torchspline.arithmetic.group import GroupArithmetic
from torchspline.arithmetic.product import Product
from torchspline.arithmetic.rn import Rn
from torchspline.arithmetic.se2 import SE2
from torchspline.arithmetic.se3 import SE3
from torchspline.arithmetic.so2 import SO2
from torchspline.arithmetic.so3 import SO3

#: Groups with a fixed name; `R<n>` and products such as `R3xSO3` are read from the name and join them when first used.
GROUPS: dict[str, GroupArithmetic] = {
    group.name: group for group in (SO3(), SE3(), DualQuaternion(), SO2(), SE2())
}

_FIXED = ", ".join(map(repr, GROUPS))


def arithmetic(name: str) -> GroupArithmetic:
    """The group called `name`: "SO3", "SE3", "R7", or factors joined by "x" as in "R3xSO3".

    Raises:
        ValueError: there is no such group; the message lists those that exist.
    """
    if name not in GROUPS:
        GROUPS[name] = _from_name(name)
    return GROUPS[name]


def _from_name(name: str) -> GroupArithmetic:
    if re.fullmatch(r"R[1-9][0-9]*", name):
        return Rn(int(name[1:]))
    factors = name.split("x")
    if len(factors) > 1:
        return Product(*(arithmetic(factor) for factor in factors))
    raise ValueError(
        f"group: no group is called {name!r}; expected one of {_FIXED}, 'R<n>' such as 'R3', "
        "or factors joined by 'x' such as 'R3xSO3'"
    )
