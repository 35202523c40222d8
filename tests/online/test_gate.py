"""The gate: what it lets pass, and that the last policy stays where it does not."""

import jax
import numpy as np
import optax
import pytest

import perfcontrol as pc
from perfcontrol.online.gate import endless
from perfcontrol.online.learning import iterate
from tests.online.plants import drawn, run_episode
from tests.solvers.problems import drifting, performative_prediction
from tests.tools import assert_refused, normal

key = jax.random.key(5)
OFF = {"cost": None, "radius": None, "step": False, "certificate": False}


def volatile(offset=0.2, weight=0.4) -> pc.PerformativeProblem:
    """Two states; the plant scatters with the norm of the policy, until it is no longer mean-square stable."""
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.8, 0.2], [0.0, 0.7]], np.eye(2)),
        horizon=8,
        noise=pc.Gaussian(np.zeros(2), np.eye(2)),
        cost=pc.QuadraticCost(np.eye(2), 0.1 * np.eye(2)),
        perturbation=pc.DirectionalPerturbation([np.eye(2)], pc.Norm([offset], [weight])),
    )


def learn(controller, state, problem, episodes):
    for _ in range(episodes):
        state = run_episode(
            controller, state, problem, drawn(problem, state.deployed, jax.random.fold_in(key, int(state.episode)))
        )
    return state


def kept(state, *words):
    """Whether the last episode left the policy as it was, for a reason with these words."""
    entry = state.log[-1]
    assert not entry.deployed and str(entry).count("kept the last policy")
    for word in words:
        assert word in entry.reason, entry.reason


def test_step_above_the_safe_step_is_refused_until_it_has_diminished():
    problem = volatile()
    safe = pc.safe_step(problem)
    steps = pc.InverseStep(3 * safe, 1.5)  # 2, 1.2, 0.86, ... times the safe step
    controller = pc.online.Controller(problem, pc.RSGD(10, steps))
    state = learn(controller, controller.init(), problem, 2)
    assert state.limits.step == safe
    assert [entry.deployed for entry in state.log] == [False, False]
    kept(state, "step size", f"{1.2 * safe:.3g}", f"{safe:.3g}")
    np.testing.assert_array_equal(state.deployed, 0)
    after = learn(controller, state, problem, 1)
    assert after.log[-1].deployed and np.linalg.norm(after.deployed) > 0
    # steps that were refused count, and the gradient is that of the policy that stayed
    gradient = pc.sample_gradient(problem, state.deployed, key=jax.random.fold_in(key, 2))
    np.testing.assert_allclose(after.deployed, -3 * safe / 3.5 * np.asarray(gradient), rtol=1e-12)


def test_safe_step_in_the_long_run_is_that_of_gradients_per_stage():
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.5]], [[1.0]]),
        horizon=np.inf,
        noise=pc.Gaussian([0.0], [[1.0]]),
        cost=pc.QuadraticCost([[1.0]], [[0.1]]),
        perturbation=pc.DirectionalPerturbation([[[1.0]]], pc.Norm([0.1], [0.2])),
    )
    finite = problem.truncated(9)
    safe = pc.safe_step(finite)
    limits = pc.online.Gate(certificate=False).limits(problem, pc.RSGD(1, 1.0, truncation=9), np.zeros((1, 1, 1)))
    ended = pc.solve(finite, pc.RSGD(1, safe), key=key).M
    np.testing.assert_allclose(pc.solve(problem, pc.RSGD(1, limits.step, truncation=9), key=key).M, ended, rtol=1e-12)
    assert float(ended[0, 0, 0]) != 0


def radius_of(problem, M):
    """ρ(𝒯) by Kronecker products."""
    A, B, K = (np.asarray(matrix) for matrix in (problem.system.A, problem.system.B, problem.gain))
    law = problem.perturbation
    F, scale = A - B @ K, np.asarray(law.scale(jax.numpy.asarray(M)))
    D = np.asarray(law.directions)
    lyapunov = np.kron(F, F) + sum(s**2 * np.kron(d, d) for s, d in zip(scale, D, strict=True))
    return np.abs(np.linalg.eigvals(lyapunov)).max()


@pytest.mark.parametrize("size", [0.3, 0.9, 1.5])
def test_policy_passes_where_its_world_is_mean_square_stable_or_no_worse_than_the_last(size):
    problem = volatile()
    gate, solver = pc.online.Gate(**OFF | {"radius": 1.0}), pc.RSGD(10, 0.1)
    candidate = np.asarray(size * normal(1, 1, 2, 2) / np.linalg.norm(normal(1, 1, 2, 2)))
    limits = gate.limits(problem, solver, 0 * candidate)
    radius = radius_of(problem, candidate)
    reasons = gate.refuses(problem, endless(problem), limits, candidate, 0 * candidate, 0.1)
    assert bool(reasons) == (radius >= 1) == (size > 1)
    assert not reasons or f"{radius:.4g}" in reasons[0]
    assert not gate.refuses(problem, endless(problem), limits, candidate, 1.001 * candidate, 0.1)
    tight = pc.online.Gate(**OFF | {"radius": 0.99 * radius})
    assert tight.refuses(problem, endless(problem), limits, candidate, 0 * candidate, 0.1)


def test_radius_is_not_asked_for_where_the_model_varies_in_time():
    problem = volatile()
    assert endless(problem) is not None
    matrices = np.broadcast_to(np.asarray(problem.system.A), (8, 2, 2))
    varying = pc.PerformativeProblem(
        system=pc.LinearSystem(matrices, np.eye(2)), horizon=8, noise=problem.noise, cost=problem.cost
    )
    gate = pc.online.Gate(**OFF | {"radius": 1e-9})
    M = np.zeros((1, 2, 2))
    assert (
        endless(varying) is None
        and gate.refuses(varying, endless(varying), gate.limits(varying, pc.RSGD(1, 0.1), M), M, M, 0.1) == []
    )


def test_predicted_cost_may_grow_by_the_factor_of_the_gate_and_no_more():
    problem, solver = volatile(), pc.RSGD(10, 0.1)
    nothing, candidate = np.zeros((1, 2, 2)), np.asarray(normal(1, 1, 2, 2))
    factor = float(pc.expected_cost(problem, candidate) / pc.expected_cost(problem, nothing))
    assert factor > 1.5
    for cost, passes in ((1.001 * factor, True), (0.999 * factor, False)):
        gate = pc.online.Gate(**OFF | {"cost": cost})
        reasons = gate.refuses(
            problem, endless(problem), gate.limits(problem, solver, nothing), candidate, nothing, 0.1
        )
        assert (not reasons) == passes
    assert "predicted cost" in reasons[0] and f"{float(pc.expected_cost(problem, candidate)):.4g}" in reasons[0]


def test_nothing_passes_where_the_certificate_of_the_model_does_not_allow_it():
    # repeated minimisation multiplies by the sensitivity, and the mean field by 1 - sensitivity < 0
    problem = performative_prediction(1.5)
    controller = pc.online.Controller(problem, pc.RSGD(10, 1e-3), gate=pc.online.Gate(cost=None, radius=None))
    state = learn(controller, controller.init(), problem, 2)
    kept(state, "mean field", "unstable")
    np.testing.assert_array_equal(state.deployed, 0)
    calm = performative_prediction(0.5)
    controller = pc.online.Controller(calm, pc.RSGD(10, 1e-3), gate=pc.online.Gate(cost=None, radius=None))
    assert learn(controller, controller.init(), calm, 1).log[-1].deployed


def test_step_without_a_policy_is_taken_back_and_learning_goes_on():
    problem = drifting()
    controller = pc.online.Controller(problem, pc.RSGD(10, lambda n: 1e12), gate=pc.online.Gate(**OFF))
    first = controller.init()
    state = learn(controller, first, problem, 1)
    kept(state, "no policy came of the step", "divergence threshold")
    assert state.learner.result == pc.Result.running
    np.testing.assert_array_equal(state.deployed, first.deployed)


@pytest.mark.parametrize(
    "settings",
    [{"average": pc.Average(0.0, "batch means"), "steps": 100}, {"schedule": pc.Lazy(2)}],
    ids=["averaged", "lazy"],
)
def test_what_was_learnt_since_the_last_deployment_is_taken_back_where_it_is_refused(settings):
    problem = drifting()
    controller = pc.online.Controller(
        problem, pc.RSGD(**({"steps": 10, "step_size": 0.02} | settings)), gate=pc.online.Gate(**OFF | {"cost": 1e-6})
    )
    state = learn(controller, controller.init(), problem, 4)
    kept(state, "predicted cost")
    assert int(state.learner.own.count) == int(state.learner.steps) == 4
    np.testing.assert_array_equal(iterate(state.learner), 0)
    np.testing.assert_array_equal(state.learner.M, 0)


def test_gate_that_asks_for_what_the_model_does_not_know_is_refused_before_anything_is_deployed():
    problem = volatile()
    convex = pc.PerformativeProblem(
        system=problem.system, horizon=8, noise=problem.noise, cost=pc.ConvexCost(lambda t, x, u: x @ x + u @ u)
    )
    solver = pc.RSGD(10, 0.1)
    assert_refused(lambda: pc.online.Controller(convex, solver), "gate", "cost=None", "not quadratic")
    gate = pc.online.Gate(cost=None, step=False, certificate=False, radius=None)
    pc.online.Controller(convex, solver, gate=gate)
    adam = pc.RSGD(10, 0.1, transform=optax.scale_by_adam())
    assert_refused(lambda: pc.online.Controller(problem, adam), "gate", "step=False")
