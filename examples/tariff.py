"""Demand response: a tariff that teaches its customers to respond.

Every half hour the price of electricity corrects for shocks to the load, for a day. Customers put off what they can,
and make up for half of it later. By hand few respond. Where prices follow shocks closely, automation pays, and many do:
the response to the price, a column of the input matrix, grows with the policy that is deployed. That is a mean of
the perturbation of [x; u].

Run: python examples/tariff.py [--quick]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import perfcontrol as pc

jax.config.update("jax_enable_x64", True)

BY_HAND, AUTOMATED = 0.3, 20.0  # response of the load to the price; how much stronger automation can make it
REBOUND = 0.5  # of what is put off returns


def uptake(M):
    """How much automation adds to the response, relative to that by hand."""
    movement = jnp.sum(M**2)
    return AUTOMATED * movement / (1 + movement)


def reaction(M):
    """What the deployed tariff adds to [A, B], on average."""
    return uptake(M) * jnp.array([[0.0, 0.0, -BY_HAND], [0.0, 0.0, REBOUND * BY_HAND]])


def build(horizon):
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.8, 0.3], [0.0, 0.7]], [[-BY_HAND], [REBOUND * BY_HAND]]),  # load, put off
        horizon=horizon,
        memory=2,
        noise=pc.Gaussian(np.zeros(2), np.diag([1.0, 0.01])),
        cost=pc.QuadraticCost(np.diag([1.0, 0.0]), [[0.05]]),
        perturbation=pc.DirectionalPerturbation(np.zeros((1, 2, 3)), [0.0], mean=reaction),
    )


def main(quick=False):
    problem = build(horizon=12 if quick else 48)
    flat = problem.initial_policy()
    rounds = [flat]
    for _ in range(4 if quick else 12):
        rounds.append(pc.best_response(problem, rounds[-1]))
    naive = rounds[1]
    stable = pc.solve(problem, pc.StablePoint()).M
    optimal = pc.solve(problem, pc.PerformativeOptimum(starts=2)).M
    print(f"the naive tariff promises {float(pc.expected_cost(problem, naive, deployed=flat)):.1f}")
    policies = {
        "flat price": flat,
        "naive": naive,
        "last of retraining": rounds[-1],
        "stable": stable,
        "optimal": optimal,
    }
    costs = {}
    for name, M in policies.items():
        costs[name] = float(pc.expected_cost(problem, M))
        print(f"{name:18} costs {costs[name]:8.2f}, response {1 + float(uptake(M)):4.1f} times that by hand")
    print(pc.certify(problem, pc.Sharp(samples=0, pairs=0)))
    assert costs["optimal"] <= min(costs.values()) * (1 + 1e-9)
    return costs, [float(pc.expected_cost(problem, M)) for M in rounds]


if __name__ == "__main__":
    main(quick="--quick" in sys.argv)
