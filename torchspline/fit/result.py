"""What a solution says about itself."""

from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from torchspline.fit.model import State
from torchspline.fit.solver import Trace
from torchspline.fit.system import System

if TYPE_CHECKING:
    from torchspline.fit.problem import Linearizer

Array = NDArray[Any]


class Result:
    """Of `Problem.solve`."""

    def __init__(self, linearizer: "Linearizer", state: State, system: System, trace: Trace):
        self._linearizer, self._state, self._system, self._trace = linearizer, state, system, trace
        #: Half the (robust) weighted sum of squares at the start and after each accepted step.
        self.cost = list(trace.cost)
        #: How often residuals and Jacobians were evaluated.
        self.evaluations = trace.evaluations
        #: Why it stopped, and whether that was convergence.
        self.reason, self.converged = trace.reason, trace.converged
        #: Wall time by phase, s.
        self.seconds = dict(trace.seconds)
