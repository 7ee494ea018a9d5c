"""How well the exposure of a photograph is foretold by its neighbours in the flight, and by what its camera metered.

    python -m experiments.reports.analyses.metering RUN

RUN was trained with --exposure-compensation. Errors are those of photographs that the law was not learnt from, one left out after
the other; all are training photographs, against the training photographs before and after them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from experiments.microbench.hardware_info import describe
from vdgs.evaluation.view_exposures import make_exposures
from vdgs.runs.open_run import open_run

#: What fitted exposures are compared on.
GREY = 0.4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    asked = parser.parse_args()
    run = open_run(asked.run, "coarse")
    exposures = make_exposures(run.model, run.capture)
    if exposures is None:
        raise SystemExit(f"{asked.run}: was trained without --exposure-compensation")
    law = exposures.auto_exposure
    grey = np.stack([exposures(view).numpy() @ [GREY, GREY, GREY, 1.0] for view in run.capture.train_views])
    print(describe())
    print(
        f"{len(grey)} training photographs, in which grey deviates by {np.log(grey.mean(1)).std():.1%}; errors of the"
    )
    print("logarithm of brightness:")
    print(f"by neighbours alone {law.residual_error[0]:.4f}, by what is metered as well {law.residual_error[1]:.4f}")
    print(f"a view that is 1 % brighter is exposed {law.slope:+.2f} %" if law.slope else "the law is not used")


if __name__ == "__main__":
    main()
