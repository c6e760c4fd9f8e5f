"""What a data set is made of: kinds of motion and qualities of sensors, and what they are drawn from."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from torchspline import checks
from torchspline.generate.distributions import Distribution, distribution_of, number_at
from torchspline.generate.motions import MOTIONS
from torchspline.generate.sensors import SENSOR_PARAMETERS
from torchspline.generate.trajectories import MOUNTINGS, REST, Mounting, motion_distributions
from torchspline.io.yaml import read_yaml, short

#: Readings and control points of an item; more would fill any memory.
MOST = 10_000_000


@dataclass(frozen=True)
class Recipe:
    """What items of a data set are drawn from.

    Args:
        motions: the kinds there are, with parameters and a `weight` (1 unless given) that says how often they come:
            `{"drone": {"weight": 2, "bandwidth": {"uniform": [0.3, 1.0]}}, "walking": {}}`.
        sensor: parameters of the IMU by name, see `SENSOR_PARAMETERS`; those left out are those of a perfect one.
        duration: of an item, s.
        rate: of the readings, Hz.
        knot_spacing: of the trajectories, s.
        rest: s at the start without motion.
        mounting: "upright" or "random", see `random_motion`.
        dtype: of readings and labels; they are computed in float64.
    Every parameter is a number or a distribution: `{"uniform": [least, most]}`, `{"log_uniform": [least, most]}`,
    `{"normal": [mean, deviation]}`, `{"choice": [a, b, ...]}`.
    Raises:
        TypeError, ValueError: the message names the key, as in `motions.drone.bandwidth`.
    """

    motions: dict[str, Any]
    sensor: dict[str, Any] = field(default_factory=dict)
    duration: float = 10.0
    rate: float = 200.0
    knot_spacing: float = 0.02
    rest: Any = 0.0
    mounting: Mounting = "random"
    dtype: Literal["float32", "float64"] = "float32"

    def __post_init__(self) -> None:
        for name in ("duration", "rate", "knot_spacing"):
            # As a number: YAML takes `1e3` for text.
            object.__setattr__(self, name, checks.positive(name, number_at(name, getattr(self, name))))
        checks.choice("mounting", self.mounting, MOUNTINGS)
        checks.choice("dtype", self.dtype, ("float32", "float64"))
        for name, count in (
            ("rate", self.duration * self.rate),
            ("knot_spacing", self.duration / self.knot_spacing),
        ):
            if count > MOST:
                raise ValueError(
                    f"{name}: expected at most {MOST} readings and as many control points in an item, got {count:.3g} "
                    f"in {self.duration:g} s"
                )
        if self.samples < 1:
            raise ValueError(
                f"duration: {self.duration} s at {self.rate} Hz makes no reading; expected at least one"
            )
        _mapping("motions", self.motions, MOTIONS)
        if not self.motions:
            raise ValueError(f"motions: expected at least one out of {', '.join(MOTIONS)}, got none")
        _mapping("sensor", self.sensor, SENSOR_PARAMETERS)
        # Looked at now, for the errors.
        _ = self.weights, self.motion_distributions, self.sensor_distributions, self.rest_distribution

    @property
    def samples(self) -> int:
        """Readings of an item: at 0, 1/rate, ... before `duration`."""
        return int(self.duration * self.rate + 1e-9)

    @property
    def weights(self) -> dict[str, float]:
        """How often a kind of motion comes, in no unit."""
        found = {}
        for kind, options in self.motions.items():
            options = _mapping(f"motions.{kind}", {} if options is None else options)
            found[kind] = number_at(f"motions.{kind}.weight", options.get("weight", 1.0))
            if found[kind] < 0:
                raise ValueError(f"motions.{kind}.weight: expected zero or more, got {found[kind]}")
        if not sum(found.values()) > 0:
            raise ValueError(f"motions: expected a weight above zero, got {found}")
        return found

    @property
    def motion_distributions(self) -> dict[str, dict[str, Distribution]]:
        """By kind and parameter."""
        return {
            kind: motion_distributions(
                f"motions.{kind}",
                kind,
                {name: x for name, x in (options or {}).items() if name != "weight"},
                self.knot_spacing,
            )
            for kind, options in self.motions.items()
        }

    @property
    def sensor_distributions(self) -> dict[str, Distribution]:
        """By parameter; those of a perfect sensor are left out."""
        found = {
            name: distribution_of(f"sensor.{name}", value, SENSOR_PARAMETERS[name])
            for name, value in self.sensor.items()
        }
        return {name: d for name, d in found.items() if d != SENSOR_PARAMETERS[name].default}

    @property
    def rest_distribution(self) -> Distribution:
        return distribution_of("rest", self.rest, REST)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as they stand in a file; the same for recipes that say the same."""
        return {name: _plain(getattr(self, name)) for name in self.__dataclass_fields__}

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "Recipe":
        """The `recipe` of a YAML file such as `configs/generate.yaml`.

        Raises:
            FileNotFoundError: no such file. TypeError, ValueError: with the file and the key.
        """
        path = Path(path)
        names = "a key `recipe` that holds motions and sensor"
        content = read_yaml(path, names)
        if "recipe" not in content:
            raise ValueError(f"{path}: expected {names}")
        given = content["recipe"]
        try:
            given = _mapping("recipe", given, cls.__dataclass_fields__)
            if "motions" not in given:
                raise ValueError("recipe.motions: expected kinds of motion, got none")
            return cls(**given)
        except (TypeError, ValueError) as error:
            kind = TypeError if isinstance(error, TypeError) else ValueError
            raise kind(f"{path}: {short(error, 500)}") from None


def _plain(value: Any) -> Any:
    """Numbers as floats, also those that YAML took for text (see `number_at`)."""
    if isinstance(value, Mapping):
        return {name: _plain(x) for name, x in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(x) for x in value]
    if value is None:
        return {}
    try:
        return float(value)
    except ValueError:
        return value


def _mapping(path: str, value: Any, known: Mapping[str, Any] | None = None) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise TypeError(f"{path}: expected a mapping of names to values, got {value!r}")
    for name in value:
        if known is not None and name not in known:
            raise ValueError(f"{path}.{name}: expected one of {', '.join(known)}, got {name!r}")
    return dict(value)
