"""`python -m benchmarks.at_once`: one path where JAX works on a call at once, instead of handing it to another thread.

That is settled when JAX starts, so it is measured in a process of its own, the printed formula beside it.
"""

import json
import subprocess
import sys

import jax

import perfcontrol as pc
from benchmarks.gradients import BY_KERNEL, numpy_baselines, path_row
from benchmarks.measure import Row
from benchmarks.problems import policy_of, problem_of

AT_ONCE = ", called at once"


def rows(case: str) -> list[Row]:
    """The rows of such a process."""
    run = subprocess.run([sys.executable, "-m", "benchmarks.at_once", case], capture_output=True, text=True, check=True)
    return [(case, what, seconds, note) for case, what, seconds, note in json.loads(run.stdout)]


def _measured(case: str) -> list[Row]:
    printed, _ = numpy_baselines(problem_of(20, 1, 60), policy_of(problem_of(20, 1, 60)))
    problem = problem_of(20, 1, 60, law="uniform")
    M = policy_of(problem)
    measured = [path_row(case, f"float64{AT_ONCE}", problem, M, printed)]
    pc.use_kernel()
    return [*measured, path_row(case, f"float64{BY_KERNEL}{AT_ONCE}", problem, M, printed)]


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    print(json.dumps(_measured(sys.argv[1])))
