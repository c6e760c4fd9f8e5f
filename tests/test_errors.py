"""Bad arguments of every public function: the error names the argument, what came and what was expected."""

import inspect
import re
from collections.abc import Callable
from types import ModuleType
from typing import Any

import error_calibration_files
import error_generate
import error_imu
import error_imu_allan
import error_imu_earth
import error_imu_noise
import error_imu_strapdown
import error_interop
import error_online
import error_robot
import error_splines
import error_view
import pytest
from error_arguments import ACCEPTED, FOLDER, TOGETHER, Case

import torchspline
import torchspline.io as records
from torchspline.fit import BatchProblem, SlidingWindow
from torchspline.fit.losses import Loss
from torchspline.fit.residuals import RESIDUALS
from torchspline.fit.variables import Variable
from torchspline.splines.trajectory import Mounted

#: Files of cases, each with `CASES` and `NOT_APPLICABLE`; arguments that are accepted register themselves.
FILES = (
    error_online,
    error_imu_noise,
    error_imu_strapdown,
    error_imu_earth,
    error_imu_allan,
    error_imu,
    error_generate,
    error_interop,
    error_robot,
    error_splines,
    error_calibration_files,
    error_view,
)
CASES = [case for file in FILES for case in file.CASES]


def label(case: Case) -> str:
    return f"{case.function}-{case.argument}-{case.category}-{case.came}".replace(FOLDER.name, "")


@pytest.mark.parametrize("case", CASES, ids=label)
def test_the_message_says_what_is_wrong(case):
    function, good = ACCEPTED[case.function]
    wrong_type = case.category in ("type", "dtype", "mixed dtype")
    with pytest.raises(TypeError if wrong_type else (ValueError, FileNotFoundError)) as caught:
        function(**{**good, **case.changes})
    message = str(caught.value)
    # Two arguments that do not go together are named in the order of the check; else the culprit comes first.
    named = re.escape(case.named)
    if case.category in TOGETHER:
        assert re.search(rf"\b{named}\b", message), message
    else:
        assert re.match(rf"({named}\b|.*\b{named}\b[^:]*: )", message), message
    assert case.came in message, message
    assert case.expected in message, message


# ---------------------------------------------------------------------- nothing is left out


def public() -> dict[str, Callable[..., Any]]:
    """Functions, constructors and methods by qualified name, found by walking what the package exports."""
    found: dict[str, Callable[..., Any]] = {}

    def visit(x: Any) -> None:
        if isinstance(x, ModuleType):
            names = getattr(x, "__all__", None) or [
                name
                for name, y in vars(x).items()
                if inspect.isfunction(y) and y.__module__ == x.__name__ and not name.startswith("_")
            ]
            for name in names:
                visit(getattr(x, name))
        elif inspect.isclass(x):
            if not inspect.isabstract(x) and x.__name__ not in RESULTS:
                found[x.__name__] = x
            for name, method in inspect.getmembers(x, inspect.isfunction):
                own = method.__module__.startswith("torchspline.") and not hasattr(tuple, name)
                if own and not name.startswith("_") and not getattr(method, "__isabstractmethod__", False):
                    found[method.__qualname__] = method
        elif callable(x) and not isinstance(x, torchspline.Group):
            found[x.__name__] = x

    for root in (
        torchspline,
        records,
        Mounted,
        SlidingWindow,
        BatchProblem,
        *error_generate.ROOTS,
        *error_robot.ROOTS,
        *error_calibration_files.ROOTS,
        *error_view.ROOTS,
    ):
        visit(root)
    return found


#: What the library makes and hands out; nobody is meant to call these.
RESULTS = {
    "State",
    "AllanDeviation",
    "Kinematics",
    "NoiseEstimate",
    "ImuReading",
    "Increments",
    "Navigation",
    "PoseFit",
    "Result",
    "BatchResult",
    "Alignment",
    "Differentials",
    "Readings",
    "AmbientReadings",
    *error_generate.RESULTS,
    *error_robot.RESULTS,
    *error_splines.RESULTS,
    *error_view.RESULTS,
}

#: Methods that are public by name alone, with nothing to get wrong.
UNTRIED = {
    "PoseFit.rms": "no arguments",
    "LowPass.extra_repr": "no arguments; PyTorch calls it",
    **error_generate.UNTRIED,
    **error_robot.UNTRIED,
    **error_view.UNTRIED,
    "BSpline.extra_repr": "no arguments; PyTorch calls it",
    "BSpline.get_extra_state": "no arguments; PyTorch calls it",
    "BSpline.set_extra_state": "PyTorch calls it with what the method above made",
    "Problem.prepare": "no arguments",
    "Residual.bind": "tried through Problem.add, which calls it",
    **{
        getattr(kind, method).__qualname__: "called by the solver, on numbers that were checked"
        for kinds, methods in (
            (RESIDUALS.values(), ("evaluate", "reverse")),
            (Loss.__subclasses__(), ("rho", "weight")),
            ((Variable,), ("basis", "points", "retract")),
        )
        for kind in kinds
        for method in methods
    },
}

#: Parameters that take anything.
FREE = {
    **error_view.FREE,
    **dict.fromkeys(
        ("validate", "learnable", "degrees", "progress"), "a truth value, and everything has one"
    ),
    "device": "goes straight to PyTorch, which lists the devices there are",
    "source": "goes into messages as it is",
    "name": "goes into messages as it is",
    "options": "those of BSpline or of a scheme, tried one by one",
    "arguments": "those of the residual, tried one by one",
    "index": "for arguments of the residual, tried with one",
}

_MAKERS = "Group Rn product use_kernels"
_GROUP_TANGENT = (
    "Group.exp Group.left_jacobian Group.left_jacobian_inverse "
    "Group.right_jacobian Group.right_jacobian_inverse"
)
_GROUP_POINT = "Group.adjoint Group.inverse Group.log Group.normalize Group.to_matrix"
_WEIGHTED = "Group.power Group.interpolate from_screw"
_GROUP_TWO = (
    f"{_WEIGHTED} Group.compose Group.between Group.act Group.adjoint_act Group.retract Group.bracket"
)
_MATRIX = "Group.from_matrix from_rotation_matrix from_transform_matrix from_transform3d"
_VECTOR = "from_rotation_vector from_euler"
_DUAL = "pose_to_dual_quaternion pose_from_dual_quaternion to_screw"
_QUATERNION = (
    "to_xyzw from_xyzw pose_to_xyzw pose_from_xyzw to_rotation_matrix to_rotation_vector to_transform_matrix "
    "to_euler to_scipy to_pypose from_pypose to_transform3d"
)
_POINTWISE = f"{_GROUP_TANGENT} {_GROUP_POINT} {_MATRIX} {_VECTOR} {_QUATERNION} {_DUAL} from_scipy"
_NEW = "Group.identity Group.random"
_HERMITE = (
    "HermiteSpline.evaluate HermiteSpline.differentials NonuniformBSpline.evaluate KeyframeSpline.evaluate"
)
_AT_TIMES = (
    f"{_HERMITE} BSpline.evaluate BSpline.jacobians Trajectory.forward Trajectory.kinematics Mounted.evaluate"
)
_SPLINES = "BSpline SplitBSpline HermiteSpline NonuniformBSpline KeyframeSpline"
_TIMELESS = f"geodesic_product consistent_signs phantom_points {_SPLINES} Trajectory.mounted Mounted"
_INSERT = "NonuniformBSpline.insert_knot"
_ALIGNED = "Alignment.pose_time"
_FILES = "read_poses read_imu write_poses write_imu"
_WINDOWS = "_Record.seconds _Record.window"
_RESIDUALS = " ".join(RESIDUALS)
_WITHOUT_QUATERNIONS = " ".join(
    name
    for name, kind in RESIDUALS.items()
    if name != "StateValue"
    and not kind.measured_signs
    and all(slot.group is None for slot in kind.slots.values())
)
_LOSSES = " ".join(loss.__name__ for loss in Loss.__subclasses__())
_COVARIANCES = "Result.covariance Result.standard_deviation"
_SOLVING = f"Problem.add_prior Problem.freeze Problem.release Problem.solve {_COVARIANCES}"

#: Where a kind of mistake cannot be made: category -> reason -> functions.
NOT_APPLICABLE = {
    "shape": {
        "no tensor": f"{_MAKERS} from_scipy {_WINDOWS} {_INSERT} {_LOSSES} Problem.release Problem.solve "
        f"{_COVARIANCES}",
        "a foreign object or a record, whose shape is its own affair": "from_pypose from_transform3d "
        "write_poses write_imu",
        "any shape": _ALIGNED,
    },
    "dtype": {
        "no tensor": f"{_MAKERS} {_FILES} {_WINDOWS} {_INSERT} {_LOSSES} Problem Problem.release Problem.solve "
        f"{_COVARIANCES}",
        "a foreign object with a dtype of its own": "from_pypose from_transform3d",
    },
    "device": {
        "no two tensors": f"{_MAKERS} {_NEW} {_POINTWISE} {_FILES} {_WINDOWS} {_INSERT} {_ALIGNED} "
        "consistent_signs phantom_points",
        "the mount waits for the first call, and is refused there": "Trajectory.mounted Mounted",
        "measurements are copied to the CPU": f"{_RESIDUALS} Variable Clock smoothness Problem.add",
        "no tensor that stays": f"{_LOSSES} {_SOLVING}",
    },
    "nan": {
        "no numbers": f"{_MAKERS} {_NEW} {_WINDOWS} from_scipy",
        "rows with NaN stay as they are": f"{_FILES} {_ALIGNED} PoseRecord ImuRecord",
        "checked when the residual was made": "Problem.add",
        "no numbers that can be one": f"Problem.freeze Problem.release {_COVARIANCES}",
    },
    "zero quaternion": {
        "no quaternion goes in": f"{_MAKERS} {_NEW} {_MATRIX} {_GROUP_TANGENT} {_VECTOR} {_WINDOWS} Group.bracket "
        f"from_screw from_scipy read_imu write_imu ImuRecord {_ALIGNED}",
        "control points and mount were checked when the trajectory was made": f"{_AT_TIMES} {_INSERT} align_imu",
        "rows stay as they are until they are used": "PoseRecord",
        "no quaternion in it": f"{_WITHOUT_QUATERNIONS} {_LOSSES} Clock",
        "checked when residual and trajectory were made": f"smoothness Problem.add {_SOLVING} "
        "Result.trajectory_covariance",
    },
    "count": {
        "any number of points": f"{_NEW} {_POINTWISE} {_GROUP_TWO} {_AT_TIMES} {_WINDOWS} {_INSERT} {_ALIGNED} measure",
        "one of it": "Group Rn use_kernels Trajectory.mounted Mounted",
        "any number of measurements, unknowns and control points": f"{_LOSSES} Variable Clock smoothness Problem "
        f"Problem.add Result.trajectory_covariance {_SOLVING}",
    },
    "time": {
        "no times": f"{_MAKERS} {_NEW} {_POINTWISE} {_GROUP_TWO} {_TIMELESS}",
        "no domain before there is a trajectory": "initial_control_points fit_poses",
        "any time, also none at all": f"{_FILES} {_WINDOWS} {_ALIGNED} PoseRecord ImuRecord",
        "no trajectory to lie on before Problem.add": f"{_RESIDUALS} {_LOSSES} Variable Clock",
        "times come with residuals": f"smoothness Problem {_SOLVING}",
    },
}

for _more in FILES:
    for _category, _reasons in _more.NOT_APPLICABLE.items():
        for _reason, _names in _reasons.items():  # the same reason may stand in several files
            NOT_APPLICABLE[_category][_reason] = f"{NOT_APPLICABLE[_category].get(_reason, '')} {_names}"

#: What counts as a case of the categories above.
COUNTS_AS = {"batch": "shape", "mixed dtype": "dtype"}


def test_every_public_function_is_tried_with_every_mistake():
    functions = public()
    assert set(functions) == set(ACCEPTED) | set(UNTRIED)
    tried = {(case.function, COUNTS_AS.get(case.category, case.category)) for case in CASES}
    excused = {
        (function, category)
        for category, reasons in NOT_APPLICABLE.items()
        for names in reasons.values()
        for function in names.split()
    }
    assert {function for function, _ in excused} <= set(ACCEPTED)
    needed = {(function, category) for function in ACCEPTED for category in NOT_APPLICABLE}
    assert needed - tried == excused


def test_every_parameter_is_tried():
    tried = {(case.function, argument) for case in CASES for argument in case.changes}
    parameters = {
        (name, parameter)
        for name, function in public().items()
        if name not in UNTRIED
        for parameter in inspect.signature(function).parameters
        if parameter != "self" and parameter not in FREE
    }
    assert parameters <= tried, sorted(parameters - tried)


@pytest.mark.parametrize("function", ACCEPTED)
def test_arguments_are_accepted_when_nothing_is_wrong(function):
    call, good = ACCEPTED[function]
    call(**good)
