"""A credit rule and applicants who adapt to it slowly: stateful performative prediction, linearised.

Applicants move two features towards what the rule rewards, with diminishing returns, and only a share of them in any
month (the pool remembers: Brown, Hod and Kalemaj, "Performative Prediction in a Stateful World", 2022). The lender
corrects the rule month by month for shocks to the pool; the more nervously it does so, the less predictable is the
share that still follows it.

Run: python examples/credit_rule.py [--quick]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import perfcontrol as pc

jax.config.update("jax_enable_x64", True)

SHARE, GAIN = 0.3, jnp.array([[1.0, 0.2], [0.1, 0.8]])  # of applicants who adapt in a month; what effort achieves
BASE = jnp.array([1.0, 2.0])  # features without any rule to please
HORIZON, NOISE = 36, 0.05
UNREST = pc.Norm([0.2], [0.6])  # scatter of that share, relative to it, given how strongly the rule follows shocks


def pool(features, rule, share=SHARE):
    """Next month's mean features."""
    return features + share * (BASE + GAIN @ (0.8 * jnp.tanh(rule / 0.8)) - features)


def main(samples):
    rule = jnp.array([0.6, 0.4])
    rest = BASE + GAIN @ (0.8 * jnp.tanh(rule / 0.8))  # where the pool comes to rest under that rule
    near = pc.linearise(pool, rest, rule)
    for radius in (0.1, 0.3):
        error = near.error(radius, key=jax.random.key(0))
        print(f"linearisation error within {radius}: {error.largest:.2g}, {error.relative:.1%} of the distance")

    # A share that scatters moves A and B together: a perturbation of [x; u] along [A - I, B].
    problem = pc.PerformativeProblem(
        system=near.system,
        horizon=HORIZON,
        noise=pc.Gaussian(np.zeros(2), NOISE**2 * np.eye(2)),
        cost=pc.QuadraticCost(np.eye(2), 0.02 * np.eye(2)),
        memory=3,
        perturbation=pc.DirectionalPerturbation(jnp.hstack([near.A - jnp.eye(2), near.B])[None], UNREST),
    )
    price = pc.price_of_stability(problem)
    print(price)

    for name, M in (("stable", price.stable), ("optimal", price.optimal)):
        expected = float(pc.expected_cost(problem, M))
        true = nonlinear_costs(M, rest, rule, samples)
        error = true.std() / np.sqrt(samples)
        print(f"{name}: {expected:.4f} expected of the linear system, {true.mean():.4f} ± {error:.4f} in the true pool")
        assert abs(true.mean() - expected) < 0.05 * expected + 4 * error


def nonlinear_costs(M, rest, rule, samples):
    """Costs of a policy in the pool itself, its noise drawn anew."""
    M = jnp.asarray(M)

    def path(key):
        noise_key, share_key = jax.random.split(key)
        noise = NOISE * jax.random.normal(noise_key, (HORIZON, 2))
        signs = jax.random.rademacher(share_key, (HORIZON,), dtype=float)

        def month(carry, step):
            features, memory = carry
            w, sign = step
            change = jnp.einsum("imn,in->m", M, memory)
            cost = jnp.sum((features - rest) ** 2) + 0.02 * jnp.sum(change**2)
            following = pool(features, rule + change, SHARE * (1 + UNREST(M)[0] * sign)) + w
            return (following, jnp.concatenate([w[None], memory[:-1]])), cost

        (features, memory), costs = jax.lax.scan(month, (rest, jnp.zeros((3, 2))), (noise, signs))
        change = jnp.einsum("imn,in->m", M, memory)
        return costs.sum() + jnp.sum((features - rest) ** 2) + 0.02 * jnp.sum(change**2)

    return np.asarray(jax.jit(jax.vmap(path))(jax.random.split(jax.random.key(1), samples)))


if __name__ == "__main__":
    main(samples=2_000 if "--quick" in sys.argv else 50_000)
