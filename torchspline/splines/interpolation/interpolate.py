"""Interpolation of keyframes by any scheme, as a function and as a trajectory."""

from functools import partial
from typing import Literal

from torch import Tensor

from torchspline import checks
from torchspline.groups.components import join, split
from torchspline.groups.group import Group
from torchspline.splines.clock import Extrapolate
from torchspline.splines.interpolation.registry import SCHEMES, SURVEY
from torchspline.splines.interpolation.scheme import Scheme
from torchspline.splines.nonuniform import signs_continued
from torchspline.splines.segments import check_knot_times, check_query, evaluate_segments
from torchspline.splines.trajectory import State, Trajectory

Way = Literal["short", "signs"]


def interpolate(
    method: str,
    keyframes: Tensor,
    times: Tensor,
    t: Tensor,
    derivatives: int = 2,
    *,
    group: Group | None = None,
    way: Way = "short",
    extrapolate: Extrapolate = "error",
    validate: bool = True,
    **options: str,
) -> State:
    """Value and time derivatives of the curve that a scheme makes of keyframes, [H18] sections 3 to 5.

    Args:
        method: a name of [H18], which says the group too, or the plain name of a scheme, for every group:

            * numbers: "LERP", "Bezier", "CompositeBezier", "BSpline";
            * SO3: "QLB", "SLERP", "SQUAD", "RQBez", "CuBsp";
            * R3xSO3: "QLB+LERP", "SPLIT", "SPLIT SQUAD", "SPLIT CuBsp"; SE3: "SE3Up", "SpFus";
            * DualQuaternion: "ScLERP", "DLB", "ScFus", "DLFus";
            * with `group`: "geodesic", "linear", "squad", "bezier", "bernstein", "composite_bezier", "bspline",
              "cumulative_bspline".

            `KeyframeSpline.properties` says what a scheme promises.
        keyframes: `(*batch, M, P)` points of the group, quaternions of any length.
        times: `(M,)` seconds or int64 nanoseconds of the keys, increasing, uniform or not.
        t: `()`, `(N,)` or `(*batch, N)` from the first to the last key, in the unit of `times`.
        derivatives: how many, 0 to 3.
        group: goes with a plain name.
        way: "short": rotations between neighbouring keys go the short way round, at exactly pi so that the first
            non-zero component of the relative rotation is positive. "signs": as the keys' signs say on the double
            cover, the long way where the quaternions of neighbours enclose an obtuse angle. Exactly opposite
            quaternions are one rotation either way.
        extrapolate, validate: as in `bspline`.
        options: of the scheme; "CompositeBezier", "RQBez": `ends`, "natural" (default), "clamped" or "periodic".
    Returns:
        State: as of `bspline`; at a key the derivatives from the right, at the last one from the left.
    Differentiable in keyframes, times and float `t`, to any order, where the curve is smooth.
    Raises:
        TypeError: wrong type or dtype. ValueError: an unknown method or option, a wrong shape, device or value, or a
            time outside the domain.
    Examples:
        >>> import torch
        >>> from torchspline import SO3
        >>> keys = SO3.exp(torch.tensor([[0.0, 0, 0], [0, 0, 1.0], [0, 0, 1.4]], dtype=torch.float64))
        >>> times = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
        >>> halfway = interpolate("SLERP", keys, times, torch.tensor([0.5, 1.5], dtype=torch.float64)).value
        >>> [round(angle, 3) for angle in SO3.log(halfway)[:, 2].tolist()]
        [0.5, 1.2]
    """
    scheme, of, options = _resolve(method, keyframes, group, options)
    _check_keys(scheme, keyframes, times, of, way, validate)
    check_query(t, times, derivatives, extrapolate, validate, keyframes, keyframes=keyframes.shape[:-2])
    keys = signs_continued(keyframes, of) if way == "short" else _unit(keyframes, of)
    table = scheme.table(of, keys, times, **options)
    ends, fields = scheme.segments(times), partial(scheme.fields, of)
    return evaluate_segments(
        table, fields, of, t, ends, derivatives, extrapolate, validate, scheme.components
    )


def _unit(keyframes: Tensor, group: Group) -> Tensor:
    return join(group.arithmetic.normalize(split(keyframes)), keyframes)


def _find(method: str) -> tuple[Scheme, str | None]:
    names = {name.lower(): name for name in SURVEY}
    if isinstance(method, str) and method in SCHEMES:
        return SCHEMES[method], None
    if isinstance(method, str) and method.lower() in names:
        named = SURVEY[names[method.lower()]]
        return SCHEMES[named.scheme], named.group
    raise ValueError(f"method: expected one of {', '.join([*SURVEY, *SCHEMES])}, got {method!r}")


def _resolve(
    method: str, keyframes: Tensor, group: Group | None, options: dict[str, str]
) -> tuple[Scheme, Group, dict[str, str]]:
    scheme, name = _find(method)
    if group is not None:
        checks.instance("group", group, Group, "a torchspline.Group such as torchspline.SE3")
    if name is None:
        if group is None:
            raise ValueError(
                f"group: expected one with the plain name {method!r}, such as torchspline.SE3, got None"
            )
    else:
        if name == "Rn":
            checks.is_floating_tensor("keyframes", keyframes)
            name = f"R{keyframes.shape[-1] if keyframes.ndim and keyframes.shape[-1] else 1}"
        if group is not None and group.name != name:
            raise ValueError(
                f"group: expected none or {name} with {method!r}, which is defined there, got {group}"
            )
        group = Group(name)
    known = {key: values[0] for key, values in scheme.options.items()}
    for key, value in options.items():
        if key not in known:
            raise ValueError(
                f"{key}: expected an option of {method!r} ({', '.join(known) or 'it has none'}), got {key}"
            )
        known[key] = checks.choice(key, value, scheme.options[key])
    return scheme, group, known


def _check_keys(
    scheme: Scheme, keyframes: Tensor, times: Tensor, group: Group, way: str, validate: bool
) -> None:
    checks.choice("way", way, ("short", "signs"))
    checks.points("keyframes", keyframes, group, least=scheme.least, look=validate)
    check_knot_times(times, keyframes.shape[-2], what="keyframes")
    if times.device != keyframes.device:
        raise ValueError(
            f"times: on device {times.device}, but keyframes are on {keyframes.device}; move one with .to(device)"
        )


class KeyframeSpline(Trajectory):
    """Interpolated keyframes as a layer. See `interpolate`.

    Args:
        method, group, way, extrapolate, validate, options: as in `interpolate`.
        keyframes: `(*batch, M, P)`; tensors that require grad and Parameters are used as given, others copied into a
            Parameter, or a buffer if not `learnable`.
        times: `(M,)` seconds, kept in float64, or int64 nanoseconds; a tensor that requires grad is used as given.
        learnable: whether keyframes that do not require grad become a Parameter; never the times.
    """

    _times = ("times",)

    def __init__(
        self,
        method: str,
        keyframes: Tensor,
        times: Tensor,
        *,
        group: Group | None = None,
        way: Way = "short",
        learnable: bool = True,
        extrapolate: Extrapolate = "error",
        validate: bool = True,
        **options: str,
    ):
        super().__init__()
        scheme, self.group, self.options = _resolve(method, keyframes, group, options)
        _check_keys(scheme, keyframes, times, self.group, way, True)
        checks.choice("extrapolate", extrapolate, ("error", "clamp", "linear"))
        self.method, self.way, self.properties = method, way, scheme.properties
        self.extrapolate, self.validate = extrapolate, validate
        self.keyframes: Tensor
        self.times: Tensor
        self._adopt("keyframes", keyframes, learnable)
        self._adopt_seconds("times", times)

    @property
    def domain(self) -> tuple[float, float] | tuple[int, int]:
        """First and last key: seconds, or nanoseconds where their times are int64."""
        return self.times[0].item(), self.times[-1].item()

    def evaluate(self, t: Tensor, derivatives: int = 2) -> State:
        """Value and time derivatives at the times `t`, see `interpolate`."""
        return interpolate(
            self.method, self.keyframes, self.times, t, derivatives, group=self.group, way=self.way,
            extrapolate=self.extrapolate, validate=self.validate, **self.options,
        )  # fmt: skip
