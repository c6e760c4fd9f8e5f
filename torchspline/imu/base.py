"""What all sensors on a trajectory share: when they sample, how fast, and in which dtype they report."""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

from torchspline import checks
from torchspline.imu.noise import Generators
from torchspline.imu.parts import batch_of
from torchspline.imu.sampling import Instants, Sampling
from torchspline.splines.trajectory import Trajectory


class Sensor(nn.Module):
    """A layer from a trajectory and stamps to readings.

    Its parameters are buffers or `Parameter`s of their own name, (n,) or (*batch, n), see `parts.keep`. The signatures
    of sensors spell out all parameters, those of this chain included: that is what `help` and editors show.

    Args:
        rate: Hz, samples per second that the sensor takes; None: from the mean interval of the stamps, of each row.
        dtype: of the readings; None: that of the trajectory.
    """

    sampling: Sampling
    #: Names of parameters that are matrices, (n, n) or (*batch, n, n).
    matrices: ClassVar[tuple[str, ...]] = ()

    def __init__(self, rate: float | None, dtype: torch.dtype | None):
        super().__init__()
        if rate is not None:
            checks.positive("rate", rate)
        if dtype not in (None, torch.float32, torch.float64):
            raise TypeError(f"dtype: expected torch.float32 or torch.float64, got {dtype}")
        self.rate, self.dtype = rate, dtype

    def _batches(self) -> dict[str, torch.Size]:
        """Batch shapes of the parameters that may have one."""
        own = {**self._parameters, **self._buffers}
        return {n: x.shape[: -2 if n in self.matrices else -1] for n, x in own.items() if x is not None}

    def _instants(
        self,
        trajectory: Trajectory,
        at: Tensor,
        generator: Generators,
        biases: Mapping[str, Trajectory] | None = None,
    ) -> Instants:
        """When samples with the stamps `at` are taken, and which arrive; each of a batch has its own if that is random.

        Args:
            biases: those that are trajectories, by name; they may bring a batch as well.
        """
        own = self._batches()
        if self.sampling.random:
            own |= {name: batch_of(x, at) for name, x in {"trajectory": trajectory, **(biases or {})}.items()}
        return self.sampling(trajectory, at, generator, checks.broadcast(**own))
