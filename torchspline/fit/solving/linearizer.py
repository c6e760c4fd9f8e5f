"""From the numbers of all unknowns to the normal equations of a step: the sum of the terms of the cost."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from torchspline.fit.solving.model import Model, State
from torchspline.fit.solving.system import BandSystem, SparseSystem, System
from torchspline.fit.solving.terms import Term

Array = NDArray[Any]
#: Beyond these the equations are no band with a narrow border any more, and go to a sparse factorisation.
_WIDEST_BORDER = 300
_WIDEST_BAND = 6


class CostTerm(Protocol):
    """A term of the cost: a residual (`Term`), smoothness (`Bends`, `Walk`) or earlier knowledge (`BoundPrior`)."""

    def touched(self, state: State) -> Array:
        """Columns of the unknowns (runs, C) that a run of its rows ties together; -1 for those that stay."""

    def add_to(self, system: System, state: State) -> None:
        """Add cost, `J^T J` and `J^T r` where the unknowns stand."""

    def cost_of(self, numbers: Mapping[int, torch.Tensor], given: Mapping[int, torch.Tensor]) -> torch.Tensor:
        """The cost as differentiable operations.

        Args:
            numbers: of the unknowns, by their `id`. given: what stands in for tensors that it was made of, by theirs.
        """


class Linearizer:
    """From numbers of the unknowns to normal equations."""

    def __init__(self, model: Model, terms: Sequence[CostTerm]):
        self.model, self.terms = model, list(terms)
        self.fused = model.trajectory.local.fused
        #: Of each term that touches the same unknowns wherever these stand: how far apart, and how many at a time.
        self._reaches: dict[int, tuple[int, int]] = {}

    @property
    def measured(self) -> list[Term]:
        """The terms that are residuals, in the order in which they were added."""
        return [term for term in self.terms if isinstance(term, Term)]

    def __call__(self, state: State) -> System:
        system = self._empty(state)
        for term in self.terms:
            term.add_to(system, state)
        return system

    def system_of(self, term: CostTerm, state: State) -> System:
        """What one of the terms has in the normal equations."""
        system = self._empty(state)
        term.add_to(system, state)
        return system

    def _empty(self, state: State) -> System:
        """A band as wide as the measurements want it now, or a sparse matrix if that is much wider than one needs."""
        model = self.model
        width = narrow = 1
        for term in self.terms:
            reach = self._reaches.get(id(term))
            if reach is None:
                reach = self._reach(term.touched(state))
                if not (isinstance(term, Term) and term.clock):
                    self._reaches[id(term)] = reach
            width, narrow = max(width, reach[0]), max(narrow, reach[1])
        if width > _WIDEST_BAND * narrow or model.total - model.band > _WIDEST_BORDER:
            return SparseSystem(model, self.fused)
        return BandSystem(model, self.fused, width)

    def _reach(self, columns: Array) -> tuple[int, int]:
        """How wide a band these columns (runs, C) of unknowns need, and C."""
        if columns.size == 0:
            return 1, 1
        model = self.model
        spline = np.where(columns < model.band, columns, -1)
        low = np.where(spline < 0, model.total, spline).min(axis=1)
        return int((spline.max(axis=1) - low).max()) + 1, columns.shape[1]
