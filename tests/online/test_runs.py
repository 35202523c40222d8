"""Runs on a plant that the model does not quite fit: the gate keeps it mean-square stable where RSGD alone does not."""

import jax
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.rollout import draw_path
from perfcontrol.evaluate.stationary import mean_square_radius
from perfcontrol.online.gate import endless
from tests.online.plants import run_episode
from tests.online.test_gate import radius_of


def world(A, offset, weight):
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, np.eye(2)),
        horizon=8,
        noise=pc.Gaussian(np.zeros(2), np.eye(2)),
        cost=pc.QuadraticCost(np.eye(2), 0.1 * np.eye(2)),
        perturbation=pc.DirectionalPerturbation([np.eye(2)], pc.Norm([offset], [weight])),
    )


PLANT = world([[0.8, 0.2], [0.0, 0.7]], 0.2, 0.2)
MODEL = world([[0.77, 0.22], [0.02, 0.72]], 0.18, 0.18)  # reactions a tenth too weak

# Steps twelve times the safe one and the gate that does not look at them; steps that become safe, and all checks.
CASES = {
    "too large": (pc.RSGD(40, 0.02), pc.online.Gate(step=False, cost=1.0, radius=0.9), 200),
    "diminishing": (pc.RSGD(40, pc.InverseStep(0.04, 1.0)), pc.online.Gate(radius=0.9), 40),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_gate_keeps_the_plant_mean_square_stable_in_every_run_that_diverges_without_it(case):
    solver, gate, count = CASES[case]
    keys = jax.random.split(jax.random.key(0), 400)
    # without a gate the controller's iterates are these: test_controller.py
    ungated = jax.vmap(lambda key: pc.solve(PLANT, solver, key=key, throw=False))(keys)
    diverging = np.flatnonzero(np.asarray(ungated.result != pc.Result.success))[:count]
    assert len(diverging) == count
    unstable = endless(PLANT)
    last = jax.vmap(lambda M: mean_square_radius(unstable, M))(ungated.M[diverging])
    assert np.all(np.asarray(last) > 1)

    draw = jax.jit(lambda M, key: _dense(*draw_path(PLANT, M, key)))
    controller = pc.online.Controller(MODEL, solver, gate=gate)
    first = controller.init()
    radii, passed, costs = [], [], []
    for key in keys[diverging]:
        state, worst = first, radius_of(PLANT, first.deployed)
        for n in range(solver.steps):
            draws = draw(state.deployed, jax.random.fold_in(key, n))
            state = run_episode(controller, state, PLANT, [np.asarray(part) for part in draws])
            worst = max(worst, radius_of(PLANT, state.deployed))
        radii.append(worst)
        passed.append(sum(entry.deployed for entry in state.log))
        costs.append(float(pc.expected_cost(PLANT, state.deployed)))
    print(f"{case}: stable {sum(r < 1 for r in radii)} of {count}, largest radius {max(radii):.3f},", end=" ")
    print(f"deployed {np.median(passed)} of {solver.steps}, cost {np.median(costs):.2f} at the end")
    assert max(radii) < 1
    assert min(passed) > 10 and np.median(costs) < 0.8 * float(pc.expected_cost(PLANT, first.deployed))


def _dense(x0, w, draws):
    return x0, w, draws.dense()
