"""How a problem is solved.

From the bottom to the top: `model` says which columns the unknowns have, `kernel` differentiates residuals, `system`
holds the normal equations, `terms`, `bends` and `priors` are the terms of the cost that add to them, `linearizer` adds
them all, and `solver` takes the steps. Of a solution, `implicit` has its derivatives and `scatter` how sure it is.
"""
