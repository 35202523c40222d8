"""Sampled best responses: against CVXPY on every enumerated path, exact responses, differences of the same paths."""

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.reaction import reaction_jacobian
from perfcontrol.response.sampled import Sampled, averages, minimise, reaction, sampled_jacobian, uncertainty
from tests.evaluate.cases import directional_laws, replaced, sign_law, uniform_law
from tests.oracles.enumeration import enumerate_paths
from tests.oracles.enumeration import simulate as every_path
from tests.tools import assert_close, assert_mean_is, assert_refused, normal

T, H, N, M_SIZE = 3, 2, 2, 1
Q, R = np.array([1.0, 0.5]), np.array([0.3])
DEPLOYED = 0.5 * normal(1, H, M_SIZE, N)
DISCOUNT = 0.9


def quadratic_stage(t, x, u):
    return Q @ x**2 + R @ u**2


def problem(function=quadratic_stage, feasible_set=None, certain=False) -> pc.PerformativeProblem:
    """Two states, one input; `certain`: without any randomness."""
    scale = pc.Affine([0.4], 0.3 * normal(2, 1, H, M_SIZE, N))
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.8, 0.3], [0.0, 0.7]], [[0.5], [1.0]]),
        horizon=T,
        memory=H,
        gain=[[0.1, 0.2]],
        noise=pc.Sequence(normal(3, T, N)) if certain else pc.Rademacher([1.0, 0.6], mean=[0.3, 0.0]),
        cost=pc.ConvexCost(function, discount=DISCOUNT),
        perturbation=pc.NoPerturbation() if certain else pc.DirectionalPerturbation(normal(4, 1, N, N), scale),
        feasible_set=feasible_set,
        initial_state=[1.0, -1.0],
    )


def enumerated(world: pc.PerformativeProblem, certain: bool):
    """Probabilities (p,), and z (p, T+1, n+m) with its derivative by the policy, (p, T+1, n+m, H·m·n)."""
    noise = [uniform_law(w[None]) for w in normal(3, T, N)] if certain else [sign_law([0.3, 0], np.diag([1, 0.6]))] * T
    still = [uniform_law(np.zeros((1, N, N)))] * T
    law = world.perturbation
    moved = directional_laws(law, DEPLOYED, T) if isinstance(law, pc.DirectionalPerturbation) else still
    paths = enumerate_paths(noise, moved, uniform_law([[1.0, -1.0]]))
    K = np.broadcast_to(world.gain, (T + 1, M_SIZE, N))
    A, B = (np.broadcast_to(part, (T, *part.shape)) for part in (world.system.A, world.system.B))
    x, u, dx, du = every_path(A, B, K, np.zeros((H, M_SIZE, N)), paths)
    slopes = np.concatenate([dx, du], axis=2).reshape(*x.shape[:2], N + M_SIZE, -1)
    return paths.probability, np.concatenate([x, u], axis=2), slopes


def linear_exponential(z):
    return 2 * (cp.exp(0.5 * z) - 1 - 0.5 * z) / 0.25


FUNCTIONS = {  # ours, CVXPY's of states and of inputs
    "quadratic": (quadratic_stage, cp.square, cp.square),
    "huber": (pc.Huber(0.7, Q, R), *[lambda z: 0.49 * cp.huber(z / 0.7)] * 2),
    "log-cosh": (
        pc.LogCosh(0.7, Q, R),
        *[lambda z: 2 * 0.49 * (cp.logistic(2 * z / 0.7) - z / 0.7 - np.log(2))] * 2,
    ),
    "one-sided": (pc.OneSidedQuadratic("above", Q, R), lambda z: cp.square(cp.pos(z)), cp.square),
    "linear-exponential": (pc.LinearExponential(0.5, Q, R), linear_exponential, cp.square),
}
SETS = {
    "unconstrained": (None, lambda theta: []),
    "ball": (pc.FrobeniusBall(0.2), lambda theta: [cp.norm(theta) <= 0.2]),
    "box": (pc.Box(-0.1, 0.15), lambda theta: [theta >= -0.1, theta <= 0.15]),
    "rows": (pc.RowSum(0.1), lambda theta: [theta[0] + theta[1] == 0.1, theta[2] + theta[3] == 0.1]),
}


def solved_by_cvxpy(name, feasible_set, certain):
    """argmin of the expected cost over every path of the world that reacts to DEPLOYED."""
    function, of_state, of_input = FUNCTIONS[name]
    world = problem(function, certain=certain)
    probability, z, slopes = enumerated(world, certain)
    theta = cp.Variable(H * M_SIZE * N)
    expected = 0
    for i, weight in enumerate([*Q, *R]):
        value = z[:, :, i].reshape(-1) + slopes[:, :, i].reshape(-1, theta.size) @ theta
        count = (probability[:, None] * DISCOUNT ** np.arange(T + 1)).reshape(-1)
        expected += weight * count @ (of_state if i < N else of_input)(value)
    tight = {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-11}
    cp.Problem(cp.Minimize(expected), SETS[feasible_set][1](theta)).solve(solver=cp.CLARABEL, **tight)
    return np.asarray(theta.value).reshape(H, M_SIZE, N)


PAIRS = [("huber", "unconstrained"), ("log-cosh", "box")]
REST = [(name, "unconstrained") for name in FUNCTIONS if name != "huber"] + [("huber", "ball"), ("huber", "rows")]
EVERY_PAIR = pytest.mark.parametrize(
    ("name", "feasible_set"), [*PAIRS, *(pytest.param(*pair, marks=pytest.mark.slow) for pair in REST)]
)


@EVERY_PAIR
def test_response_in_a_certain_world_is_that_of_cvxpy(name, feasible_set):
    world = problem(FUNCTIONS[name][0], SETS[feasible_set][0], certain=True)
    found = pc.estimate_response(world, DEPLOYED, key=jax.random.key(0), sampling=pc.SampleAverage(2, 2))
    assert float(jnp.max(found.standard_error)) < 1e-6
    reference = solved_by_cvxpy(name, feasible_set, certain=True)
    ours, theirs = (cost_of_the_path(world, M) for M in (found.mean, reference))
    assert ours <= theirs * (1 + 1e-9)  # one path need not have one minimiser
    assert bool(world.feasible_set.contains(found.mean, 1e-9))


def cost_of_the_path(world, M):
    """In a certain world, from the oracle's derivatives."""
    _, z, slopes = enumerated(world, certain=True)
    at = z[0] + slopes[0] @ np.asarray(M).reshape(-1)
    return float(jnp.sum(world.cost.path_cost(jnp.asarray(at[:, :N]), jnp.asarray(at[:, N:]))))


@EVERY_PAIR
def test_response_is_that_of_cvxpy_on_every_path_within_its_error(name, feasible_set):
    world = problem(FUNCTIONS[name][0], SETS[feasible_set][0])
    reference = solved_by_cvxpy(name, feasible_set, certain=False)
    found = pc.estimate_response(world, DEPLOYED, key=jax.random.key(5), tolerance=0.02)
    scale = float(np.linalg.norm(found.standard_error))
    assert 0 < scale <= 0.02 * float(jnp.linalg.norm(found.mean))
    assert np.linalg.norm(found.mean - reference) <= 2.5 * scale


def finite(function=quadratic_stage):
    """Draws that stay put while their probabilities move."""

    def probabilities(M):
        moved = 0.3 * jnp.tanh(jnp.sum(M))
        return jnp.stack([0.5 + moved, 0.5 - moved])

    values = normal(6, 2, N, N) * jnp.asarray([0.5, 0.2])[:, None, None]
    return replaced(problem(function), perturbation=pc.FinitePerturbation(values, probabilities))


def sampled(world, samples, key=7):
    return Sampled(world, jax.random.key(key), np.asarray(samples))


@pytest.mark.float32
def test_averages_are_those_of_the_same_simulated_paths():
    world, M = problem(pc.LogCosh(0.7, Q, R)), 0.3 * normal(8, H, M_SIZE, N)
    key = jax.random.key(7)
    at = averages(sampled(world, 50), M, DEPLOYED)  # not a multiple of the lanes
    paths = pc.simulate(world, M, deployed=DEPLOYED, key=key, samples=50)
    assert_close(at.cost, jnp.mean(paths.cost), 1e-12, 1e-5)
    gradient = pc.sample_gradient(world, M, deployed=DEPLOYED, key=key, samples=50)
    assert_close(at.gradient, gradient, 1e-12, 1e-4)
    apart = jax.tree.map(lambda leaf: leaf[:, None], paths)
    single = jax.jit(jax.vmap(lambda path: pc.path_gradient(world, path)))(apart)
    covariance = np.cov(np.asarray(single).reshape(50, -1), rowvar=False, bias=True)
    assert_close(at.covariance, covariance, 1e-10, 1e-3)


def test_hessian_and_jacobian_match_central_differences_of_the_same_paths():
    for world in (problem(pc.LogCosh(0.7, Q, R)), problem(pc.LogCosh(0.7, Q, R), pc.FrobeniusBall(0.2))):
        few, M = sampled(world, 64), 0.3 * np.asarray(normal(8, H, M_SIZE, N))
        at = averages(few, M, DEPLOYED)
        steps = 1e-5 * np.eye(M.size).reshape(-1, *M.shape)
        pairs = [[averages(few, M + sign * step, DEPLOYED).gradient for sign in (1, -1)] for step in steps]
        columns = [(ahead - behind).reshape(-1) / 2e-5 for ahead, behind in pairs]
        assert_close(at.hessian, columns, 1e-7)
        response, unique = minimise(few, np.asarray(DEPLOYED), np.asarray(DEPLOYED))
        assert unique
        slope = sampled_jacobian(few, np.asarray(DEPLOYED), response)
        direction = 1e-5 * np.asarray(normal(9, H, M_SIZE, N))
        ahead, behind = (minimise(few, np.asarray(DEPLOYED) + s * direction, response)[0] for s in (1, -1))
        assert_close(slope @ direction.reshape(-1), (ahead - behind).reshape(-1) / 2, 1e-5)


@pytest.mark.parametrize("build", [problem, finite], ids=["draws that move", "probabilities that move"])
def test_reaction_of_the_mean_gradient_has_the_exact_mean(build):
    """Reparameterised draws, and the score of draws that stay put, against the derivative of exact moments."""
    convex = build()
    cost = pc.QuadraticCost(np.diag(Q), np.diag(R), discount=DISCOUNT)
    M = 0.3 * normal(8, H, M_SIZE, N)
    exact = reaction_jacobian(replaced(convex, cost=cost), M, DEPLOYED)
    several = [reaction(sampled(convex, 2000, key), M, DEPLOYED) for key in range(30)]
    assert np.abs(exact).max() > 0.1
    assert_mean_is(several, exact)


def test_huber_with_a_large_threshold_has_the_response_of_the_quadratic_on_the_same_paths():
    key = jax.random.key(1)
    options = {"key": key, "tolerance": 0.1}
    quadratic = pc.best_response(problem(), DEPLOYED, **options)
    gaps = [
        float(jnp.linalg.norm(pc.best_response(problem(pc.Huber(d, Q, R)), DEPLOYED, **options) - quadratic))
        for d in (1.0, 3.0, 1e3)
    ]
    assert gaps[0] > gaps[1] > gaps[2] and gaps[2] < 1e-9


def test_reported_error_is_the_spread_over_keys():
    world, zero = problem(pc.Huber(0.7, Q, R)), np.asarray(DEPLOYED)
    answers = np.stack([minimise(sampled(world, 512, key), zero, zero)[0] for key in range(60)])
    error = uncertainty(sampled(world, 512), answers[0], zero)
    spread = np.sqrt(answers.var(axis=0, ddof=1).sum())
    assert 0.75 * spread < float(error.total) < 1.35 * spread
    assert float(error.total) < float(error.radius) < 2 * float(error.total)


def test_response_works_under_jit_with_the_first_sample():
    world, key = problem(pc.LogCosh(0.7, Q, R)), jax.random.key(2)
    sampling = pc.SampleAverage(256, 256)
    traced = jax.jit(lambda M: pc.best_response(world, M, key=key, sampling=sampling))(DEPLOYED)
    expected, _ = minimise(sampled(world, 256, 2), np.asarray(DEPLOYED), np.asarray(DEPLOYED))
    assert_close(traced, expected, 1e-9)


def concave(t, x, u):
    return x @ x + u @ u + 3 * jnp.sum(jnp.cos(x))


REFUSED = {
    "no key": (lambda: pc.estimate_response(problem(), DEPLOYED), "key", "jax.random.key(0)"),
    "not convex": (
        lambda: pc.best_response(problem(concave), DEPLOYED, key=jax.random.key(0)),
        "function",
        "eigenvalue",
        "x = [",
    ),
    "too few paths": (
        lambda: pc.best_response(
            problem(), DEPLOYED, key=jax.random.key(0), tolerance=1e-3, sampling=pc.SampleAverage(64, 128)
        ),
        "sampling.limit",
        "128",
        "tolerance",
    ),
    "one path": (lambda: pc.SampleAverage(1), "samples", "at least 2"),
    "limit": (lambda: pc.SampleAverage(64, 32), "limit", "at least 64"),
    "tolerance": (
        lambda: pc.best_response(problem(), DEPLOYED, key=jax.random.key(0), tolerance=-1.0),
        "tolerance",
        "positive",
    ),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_sampled_response_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
