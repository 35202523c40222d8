"""A controller of a plant that reacts: it learns while it acts, keeps to what its model allows, and survives a crash.

Run: python examples/online.py [--quick]
"""

import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

import perfcontrol as pc

jax.config.update("jax_enable_x64", True)
rng = np.random.default_rng(1)


def world(A, sensitivity):
    """The harder the policy acts, the more the world scatters."""
    reaction = pc.DirectionalPerturbation([np.eye(2)], pc.Norm([0.1], [sensitivity]))
    cost = pc.QuadraticCost(np.eye(2), 0.1 * np.eye(2))
    noise = pc.Gaussian(np.zeros(2), 0.25 * np.eye(2))
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, np.eye(2)), horizon=20, noise=noise, cost=cost, perturbation=reaction
    )


truth = world([[0.82, 0.2], [0.0, 0.69]], 0.16)
model = world([[0.8, 0.2], [0.0, 0.7]], 0.15)  # what we take it to be


def plant(x, u, deployed):
    """One step of the true plant, which reacts to the deployed policy: the next state and the matrix to it."""
    scale = 0.1 + 0.16 * np.linalg.norm(deployed)
    A = np.array([[0.82, 0.2], [0.0, 0.69]]) + scale * rng.choice([-1, 1]) * np.eye(2)
    return A @ x + u + 0.5 * rng.normal(size=2), A


def main(episodes):
    file = Path(tempfile.mkdtemp()) / "plant.npz"
    controller = pc.online.Controller(model, pc.RSGD(episodes, pc.safe_step(model)))
    state = controller.init(key=jax.random.key(0))
    print(f"expected cost in the true world: {pc.expected_cost(truth, state.deployed):.2f} at the start")
    for _ in range(episodes):
        x = np.zeros(2)
        for _ in range(model.horizon):
            u = controller.act(state, x)
            x_next, A = plant(x, u, state.deployed)
            state = controller.observe(state, x, u, x_next, A)
            x = x_next
        state = controller.end_episode(state)
        controller.save(state, file)
    state = controller.restore(file)  # as another process would after a crash
    print(state.log[-1])
    stable = pc.solve(truth, pc.StablePoint()).M
    reached, goal = (pc.expected_cost(truth, M) for M in (state.deployed, stable))
    print(f"{reached:.2f} after {episodes} episodes; {goal:.2f} at the stable policy of the true world")


if __name__ == "__main__":
    main(5 if "--quick" in sys.argv else 300)
