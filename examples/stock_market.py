"""The paper's stock market: ten stocks whose volatility grows with what is traded of them.

A stable portfolio exists, and retraining reaches it at once; it costs several times what the best portfolio costs. Runs
of stochastic gradient descent diverge here with the paper's step, for another reason: the noise of the gradient allows
far shorter ones than its mean does.

Run: python examples/stock_market.py [--quick]
"""

import sys

import jax

import perfcontrol as pc

jax.config.update("jax_enable_x64", True)


def main(quick=False):
    problem = pc.experiments.stock_market("descending")  # the market reacts most in the first of sixty days
    start = problem.initial_policy()
    rounds = [start]
    for _ in range(2 if quick else 5):
        rounds.append(pc.best_response(problem, rounds[-1]))
    solution = pc.solve(problem, pc.StablePoint())
    policies = {"start": start, "naive": rounds[1], "stable": solution.M}
    if not quick:
        policies["optimal"] = pc.solve(problem, pc.PerformativeOptimum(starts=1)).M
    costs = {name: float(pc.expected_cost(problem, M)) for name, M in policies.items()}
    for name, cost in costs.items():
        print(f"{name:7} costs {cost:8.0f}")
    certificate = pc.certify(problem, pc.Sharp(samples=0, pairs=0))
    print(certificate)
    assert certificate.exists and float(pc.residual(problem, solution.M)) < 1e-11

    if not quick:
        step = pc.safe_step(problem)
        print(f"stochastic gradient descent is safe near it with a constant step of {step:.1e}")
    return costs, [float(pc.expected_cost(problem, M)) for M in rounds]


if __name__ == "__main__":
    main(quick="--quick" in sys.argv)
