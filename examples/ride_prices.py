"""Prices of rides in two zones, and riders who learn how prices move: a map that depends on the deployed policy.

Demand drifts to what a logit model of price says, a part of the way each week (a geometrically decaying environment, as
in Ray, Ratliff, Drusvyatskiy and Fazel, "Decision-Dependent Risk Minimization in Geometrically Decaying Dynamic
Environments", 2022). Riders who see that prices follow demand shocks wait for cheaper hours: the stronger the policy,
the more elastic they are. So input matrix and mean demand react to the policy that is deployed.

Run: python examples/ride_prices.py [--quick]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import perfcontrol as pc

jax.config.update("jax_enable_x64", True)

PULL, APPEAL, ELASTICITY = 0.4, jnp.array([1.2, 0.8]), 1.5
HORIZON, NOISE = 52, 0.02


def demand(share, price, M):
    """Next week's shares of the riders in each zone; the rest stay at home."""
    elasticity = ELASTICITY * (1 + 0.05 * jnp.trace(M[0]))
    odds = jnp.exp(APPEAL - elasticity * price)
    return share + PULL * (odds / (1 + odds.sum()) - share)


def main(quick=False):
    samples = 2_000 if quick else 50_000
    price, silent = jnp.array([0.8, 0.5]), jnp.zeros((1, 2, 2))
    odds = jnp.exp(APPEAL - ELASTICITY * price)
    near = pc.linearise(demand, odds / (1 + odds.sum()), price, policy=silent)
    for radius in (0.05, 0.2):
        error = near.error(radius, key=jax.random.key(0))
        print(f"linearisation error within {radius}: {error.largest:.2g}, {error.relative:.1%} of the distance")

    covariance = NOISE**2 * np.eye(2)
    problem = pc.PerformativeProblem(
        system=near.system,
        horizon=HORIZON,
        noise=lambda M: pc.Gaussian(near.offset_reaction(M), covariance),  # mean demand reacts
        cost=pc.QuadraticCost(np.eye(2), 0.02 * np.eye(2)),
        perturbation=pc.DirectionalPerturbation(np.zeros((1, 2, 4)), [0.0], mean=near.reaction),  # the input matrix too
        feasible_set=pc.FrobeniusBall(3.0),
    )
    stable = pc.solve(problem, pc.StablePoint())
    optimal = pc.solve(problem, pc.PerformativeOptimum())
    print(pc.certify(problem, pc.Sharp(samples=0, pairs=0)))
    costs = {}
    for name, M in (("no correction", silent), ("stable", stable.M), ("optimal", optimal.M)):
        expected = float(pc.expected_cost(problem, M))
        true = nonlinear_costs(M, near.state, price, samples)
        error = true.std() / np.sqrt(samples)
        print(f"{name}: {expected:.4f} expected of the linear system, {true.mean():.4f} ± {error:.4f} with true riders")
        assert abs(true.mean() - expected) < 0.1 * expected + 4 * error
        costs[name] = expected, true.mean()
    return costs


def nonlinear_costs(M, rest, price, samples):
    """Costs of a policy with the riders themselves."""

    def path(key):
        def week(carry, w):
            share, before = carry
            change = M[0] @ before
            cost = jnp.sum((share - rest) ** 2) + 0.02 * jnp.sum(change**2)
            seen = w + demand(rest, price, M) - rest  # noise and its reacting mean, as the policy recovers them
            return (demand(share, price + change, M) + w, seen), cost

        noise = NOISE * jax.random.normal(key, (HORIZON, 2))
        (share, before), costs = jax.lax.scan(week, (rest, jnp.zeros(2)), noise)
        return costs.sum() + jnp.sum((share - rest) ** 2) + 0.02 * jnp.sum((M[0] @ before) ** 2)

    return np.asarray(jax.jit(jax.vmap(path))(jax.random.split(jax.random.key(1), samples)))


if __name__ == "__main__":
    main(quick="--quick" in sys.argv)
