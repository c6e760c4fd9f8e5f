"""Parts of `experiments/benchmark.py`.

`problems` says what is computed, `ours` and the `peers_*` files how each contender does it, `contenders` lists them,
`timing` runs them against each other; `goals`, `sweeps`, `operations` and `processes` are the sections;
`tables` and `document` make the page of what they record, `plots` the figures.
"""
