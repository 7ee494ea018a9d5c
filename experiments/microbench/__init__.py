"""How fast single parts of the package are: `python -m experiments.microbench.NAME` from the root of a checkout."""
