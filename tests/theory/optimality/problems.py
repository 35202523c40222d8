"""Small random problems whose scales depend on one or two scalars, on affine and on other sets."""

from itertools import product

import jax.numpy as jnp
import numpy as np

import perfcontrol as pc

SHAPE = (1, 2, 2)  # memory, input, state: four parameters
SCALES = ("affine", "two affine", "norm", "squared norm")
SETS = ("unconstrained", "ball", "box", "rows")
KINDS = list(product(SCALES, SETS))


def reacting(kind: str, feasible: str, seed: int) -> pc.PerformativeProblem:
    """Two states, two inputs, six steps; two directions."""
    rng = np.random.default_rng(seed)
    offset, strength = rng.uniform(0, 0.4, 2), rng.uniform(0.1, 0.8)
    if kind in ("affine", "two affine"):
        slopes = rng.normal(size=(2, 4)) if kind == "two affine" else np.outer(rng.normal(size=2), rng.normal(size=4))
        scale: pc.AbstractPolicyMap = pc.Affine(offset, strength * slopes.reshape(2, *SHAPE))
    else:
        center = None if rng.random() < 0.5 else 0.3 * rng.normal(size=SHAPE)
        scale = pc.Norm(offset, strength * rng.uniform(0.2, 1, 2), center, squared=kind == "squared norm")
    sets = {
        "unconstrained": pc.Unconstrained(),
        "ball": pc.FrobeniusBall(rng.uniform(0.2, 1.0)),
        "box": pc.Box(-rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.6)),
        "rows": pc.RowSum(rng.uniform(-0.5, 0.5)),
    }
    A = rng.normal(size=(2, 2))
    A *= rng.uniform(0.4, 1.0) / np.max(np.abs(np.linalg.eigvals(A)))
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, np.eye(2) + 0.3 * rng.normal(size=(2, 2))),
        horizon=6,
        memory=1,
        gain=jnp.zeros((2, 2)),
        noise=pc.Gaussian(0.3 * rng.normal(size=2), np.diag(rng.uniform(0.3, 1.0, 2))),
        cost=pc.QuadraticCost(np.eye(2), rng.uniform(0.01, 0.3) * np.eye(2)),
        perturbation=pc.DirectionalPerturbation(rng.normal(size=(2, 2, 2)), scale),
        feasible_set=sets[feasible],
    )
