"""Bad arguments of what generates data sets."""

from collections.abc import Iterator
from typing import Any

from error_arguments import FOLDER, INF, NAN, Case, accept, refused, wholes

from torchspline import generate

FEW = {"motions": {"smooth": {}}, "duration": 0.1, "rate": 50.0}
RECIPE = generate.Recipe(**FEW)
ROOT = f"{FOLDER.name}/generated"
generate.write(RECIPE, ROOT, seed=0, items=2)


def _motion(parameters: dict[str, Any], **arguments: Any) -> Any:
    return generate.random_motion(**arguments, **parameters)


accept(
    {
        "random_motion": (
            _motion,
            {"kind": "drone", "count": 2, "duration": 1.0, "parameters": {"drag": {"uniform": [0, 1]}}},
        ),
        "Recipe": (generate.Recipe, FEW),
        "GeneratedDataset": (generate.GeneratedDataset, {"recipe": RECIPE, "seed": 0}),
        "items_per_block": (generate.items_per_block, {"recipe": RECIPE}),
        "write": (generate.write, {"recipe": RECIPE, "folder": ROOT, "seed": 0, "items": 2}),
        "read": (generate.read, {"folder": ROOT}),
        "ShardedDataset": (generate.ShardedDataset, {"folder": ROOT}),
    }
)

#: Where test_errors.py looks for public functions; what it finds that nobody is meant to call; what has no arguments.
ROOTS = (generate,)
RESULTS = ("Written",)
UNTRIED = {"Recipe.as_dict": "no arguments"}

_ALL = "random_motion Recipe GeneratedDataset items_per_block write read ShardedDataset"
#: Where a kind of mistake cannot be made, as in test_errors.py.
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    category: {"generation takes numbers and recipes, and no tensors": _ALL}
    for category in ("shape", "dtype", "device", "zero quaternion", "time")
}
NOT_APPLICABLE["nan"] = {
    "whole numbers and recipes that were checked": "GeneratedDataset items_per_block write read ShardedDataset"
}
NOT_APPLICABLE["count"] = {"as many as are asked for, one at least": _ALL}


def cases() -> Iterator[Case]:
    for function in ("GeneratedDataset", "items_per_block", "write"):
        for bad in (None, FEW, "configs/generate.yaml"):
            yield refused(function, "recipe", "type", bad, f"got {type(bad).__name__}", "expected a Recipe")
    for function in ("GeneratedDataset", "write"):
        yield from wholes(function, "seed", 0)
    for case in (*wholes("GeneratedDataset", "count", 0), *wholes("GeneratedDataset", "start", 0)):
        if case.changes.get("count", 0) is not None:
            yield case
    yield from wholes("write", "items", 1)
    yield from wholes("write", "items_per_shard", 1)
    for function in ("write", "read", "ShardedDataset"):
        for bad in (5, None):
            yield refused(function, "folder", "type", bad, f"got {type(bad).__name__}", "expected a path")
        yield refused(function, "folder", "option", __file__, "got the file", "expected a folder")
    for function in ("read", "ShardedDataset"):
        yield refused(function, "folder", "option", FOLDER.name, "found none", "expected dataset.json")
    yield from motions()
    yield from recipes()


def positive(function: str, name: str) -> Iterator[Case]:
    for bad in (NAN, INF, 0.0, -1.0):
        yield refused(function, name, "nan", bad, f"got {bad}", "expected a finite number")
    for bad in (None, True, [1.0]):
        yield refused(function, name, "type", bad, "got ", "expected a number")


def motions() -> Iterator[Case]:
    function = "random_motion"
    for bad in ("Drone", "", 5, None):
        yield refused(function, "kind", "option", bad, f"got {bad!r}", "expected one of 'smooth'")
    yield from wholes(function, "count", 1)
    for name in ("duration", "knot_spacing"):
        yield from positive(function, name)
    yield refused(function, "mounting", "option", "down", "got 'down'", "'upright', 'random'")
    yield refused(function, "generator", "type", 5, "got int", "expected a torch.Generator")
    yield refused(function, "rest", "option", -1.0, "from -1 to -1", "expected values from 0")
    for bad, category, came, expected, named in (
        ({"speed": 1.0}, "option", "got 'speed'", "out of bandwidth, acceleration", "speed"),
        ({"drag": NAN}, "nan", "got nan", "expected a finite number", "drag"),
        ({"drag": "much"}, "type", "got 'much'", "expected a number", "drag"),
        ({"drag": {"uniform": [1, 0]}}, "option", "got [1.0, 0.0]", "in this order", "drag.uniform"),
        ({"bandwidth": 9.0}, "option", "reach 9 Hz", "knot_spacing of at most", "drone"),
    ):
        yield refused(function, "parameters", category, bad, came, expected, named)


def recipes() -> Iterator[Case]:
    function = "Recipe"
    for name in ("duration", "rate", "knot_spacing"):
        yield from positive(function, name)
    for name, bad in (("rate", 1e300), ("knot_spacing", 1e-12)):
        yield refused(function, name, "option", bad, "in 0.1 s", "expected at most 10000000 readings")
    yield refused(
        function, "duration", "option", 1e12, "in 1e+12 s", "expected at most 10000000 readings", "rate"
    )
    for name in ("motions", "sensor"):
        for bad in (None, 5, ["smooth"]):
            yield refused(function, name, "type", bad, f"got {bad!r}", "expected a mapping")
        yield refused(function, name, "option", {"x": 1.0}, "got 'x'", "expected one of")
    yield refused(function, "motions", "option", {}, "got none", "at least one out of smooth")
    drone = {"drone": {"drag": {"gauss": [0, 1]}}}
    yield refused(function, "motions", "option", drone, "{'gauss': [0, 1]}", "one distribution out of uniform",
                  "motions.drone.drag")  # fmt: skip
    yield refused(function, "sensor", "nan", {"jitter": NAN}, "got nan", "a finite number", "sensor.jitter")
    yield refused(
        function, "sensor", "option", {"jitter": 3}, "from 3 to 3", "values from 0 to 0.1", "sensor.jitter"
    )
    yield refused(function, "rest", "type", None, "got None", "expected a number")
    yield refused(function, "mounting", "option", "down", "got 'down'", "'upright', 'random'")
    yield refused(function, "dtype", "option", "half", "got 'half'", "'float32', 'float64'")
