"""Many small problems of one shape, solved at once."""

from torchspline.fit.batch.together import BatchProblem, BatchResult

__all__ = ["BatchProblem", "BatchResult"]
