"""A driver whose style changes the traffic: whoever follows nervously is cut in on more often.

Adaptive cruise control in discrete time: gap error, closing speed and own acceleration, half a second a step. The
policy corrects for what happened in the last two steps. Drivers beside read a jerky car as one that leaves room: the
larger the corrections, the more of them cut in, four metres each. Cut-ins are noise whose mean and variance depend on
the policy that is deployed; all that exact costs need of a law are these two.

Run: python examples/traffic.py [--quick]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import perfcontrol as pc

jax.config.update("jax_enable_x64", True)

STEP, CUT = 0.5, 4.0  # seconds; metres lost to who cuts in
PATIENT, PROVOKED = 0.004, 0.05  # cut-ins a step behind a calm car, and how many more behind a jerky one


def cut_ins(M):
    """Cut-ins a step, given the policy that others have come to know."""
    jerk = jnp.sum(M**2)
    return PATIENT + PROVOKED * jerk / (1 + jerk)


def traffic(M):
    """Law of the noise on gap, closing speed, acceleration."""
    p = cut_ins(M)
    return pc.Gaussian(jnp.array([-CUT * p, 0.0, 0.0]), jnp.diag(jnp.array([0.01 + CUT**2 * p * (1 - p), 0.09, 0.01])))


def build(horizon):
    system = pc.LinearSystem([[1.0, STEP, 0.0], [0.0, 0.98, -STEP], [0.0, 0.0, 0.6]], [[0.0], [0.0], [0.4]])
    return pc.PerformativeProblem(
        system=system,
        horizon=horizon,
        memory=2,
        gain=pc.design_gain(system, Q=np.eye(3), R=5 * np.eye(1)),
        noise=traffic,
        cost=pc.QuadraticCost(np.diag([1.0, 1.0, 0.1]), 0.5 * np.eye(1)),
    )


def main(quick=False):
    problem = build(horizon=20 if quick else 120)
    calm = problem.initial_policy()
    rounds = [calm]
    for _ in range(3 if quick else 8):
        rounds.append(pc.best_response(problem, rounds[-1]))
    naive = rounds[1]
    stable = pc.solve(problem, pc.StablePoint()).M
    optimal = pc.solve(problem, pc.PerformativeOptimum(starts=2)).M
    print(f"the naive policy promises {float(pc.expected_cost(problem, naive, deployed=calm)):.1f}")
    costs = {}
    for name, M in {"gain alone": calm, "naive": naive, "stable": stable, "optimal": optimal}.items():
        costs[name] = float(pc.expected_cost(problem, M))
        minutes = 60 / STEP * float(cut_ins(M))
        print(f"{name:11} costs {costs[name]:6.1f}, {minutes:.1f} cut-ins a minute")
    print(pc.certify(problem, pc.Sharp(samples=0, pairs=0)))
    assert costs["optimal"] <= min(costs.values()) * (1 + 1e-9)
    return costs, [float(pc.expected_cost(problem, M)) for M in rounds]


if __name__ == "__main__":
    main(quick="--quick" in sys.argv)
