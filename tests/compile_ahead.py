"""Compile an estimator once, for all workers of the tests; they wait for it."""

import sys
from contextlib import ExitStack

from gateway.compiled import digest_of
from gateway.compiled.machine_code import compiling
from gateway.estimation.complementary.complementary_kernels import KERNELS as COMPLEMENTARY
from gateway.estimation.eskf.eskf_kernels import KERNELS as ESKF
from tools.flights import simulated_flight
from tools.score_estimators import run_smoothed

KERNELS = {"complementary": COMPLEMENTARY, "eskf": ESKF}


def main(name: str) -> None:
    """Compile what is missing; nobody else may begin with a part of it, which shares the rest."""
    parts = (*KERNELS[name].live, KERNELS[name].run)
    if all(part.is_kept for part in parts):
        return
    with ExitStack() as held:
        for part in parts:
            held.enter_context(compiling(part._name))
        for part in parts:
            if not part.is_kept:
                part._compile(part._name, digest_of(part._function))
    if name == "eskf":
        run_smoothed(simulated_flight(1, calibrated=True))


if __name__ == "__main__":
    main(sys.argv[1])
