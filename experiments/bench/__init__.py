"""Methods × scenes × seeds to tables, figures and a check of the paper's claims: `python -m experiments.bench`."""
