"""The oracles against each other, on random problems and on published numbers."""

from typing import NamedTuple

import numpy as np
import pytest

from .enumeration import enumerate_cost, enumerate_paths, simulate, stage_gradients
from .lqr import generalised_riccati_gain, infinite_horizon_cost, riccati_gain
from .moments import expected_cost_moments
from .performative_prediction import published_step_size, squared_errors, stable_decision
from .printed_gradient import printed_gradient, printed_state


class Problem(NamedTuple):
    """A random problem: its matrices, finite laws and the optional parts of its cost."""

    system: dict
    cost: dict
    M: np.ndarray
    laws: dict


def random_law(rng: np.random.Generator, shape: tuple[int, ...], count: int, *, centred: bool) -> tuple:
    """`count` random atoms of the given shape with random probabilities, of mean zero if centred."""
    probability = rng.dirichlet(np.full(count, 3.0))
    atoms = rng.normal(size=(count, *shape))
    if centred:
        atoms = atoms - np.tensordot(probability, atoms, axes=1)
    return atoms, probability


def random_positive(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """`count` random positive semidefinite matrices, (count, size, size)."""
    root = rng.normal(size=(count, size, size))
    return root @ root.swapaxes(1, 2) / size


def random_problem(
    seed: int,
    n: int,
    m: int,
    horizon: int,
    memory: int,
    atoms: tuple[int, int],
    *,
    centred: bool,
    on_input: bool,
    full_cost: bool,
) -> Problem:
    """A random time-varying problem; `atoms` are the numbers of atoms of each w_t and of each Delta_t."""
    rng = np.random.default_rng(seed)
    columns = n + m if on_input else n
    noise = [random_law(rng, (n,), atoms[0], centred=centred) for _ in range(horizon)]
    perturbations = [random_law(rng, (n, columns), atoms[1], centred=centred) for _ in range(horizon)]
    perturbations = [(0.5 * values, probability) for values, probability in perturbations]
    optional = {
        "cross": 0.3 * rng.normal(size=(horizon + 1, n, m)),
        "state_target": rng.normal(size=(horizon + 1, n)),
        "input_target": rng.normal(size=(horizon + 1, m)),
    }
    return Problem(
        system={
            "A": 0.6 * rng.normal(size=(horizon, n, n)),
            "B": rng.normal(size=(horizon, n, m)),
            "K": 0.4 * rng.normal(size=(horizon + 1, m, n)),
        },
        cost={
            "Q": random_positive(rng, horizon + 1, n),
            "R": random_positive(rng, horizon + 1, m),
            **(optional if full_cost else {}),
        },
        M=rng.normal(size=(memory, m, n)),
        laws={
            "noise": noise,
            "perturbations": perturbations,
            "initial": random_law(rng, (n,), 2, centred=centred),
        },
    )


def first_moment(law: tuple) -> np.ndarray:
    """The mean of a finite law."""
    atoms, probability = law
    return np.tensordot(probability, atoms, axes=1)


def covariance(law: tuple) -> np.ndarray:
    """The covariance of a finite law on vectors."""
    atoms, probability = law
    centred = atoms - first_moment(law)
    return np.einsum("k,ka,kb->ab", probability, centred, centred)


def cost_from_moments(problem: Problem, M: np.ndarray) -> float:
    """The expected cost of a problem by the moment oracle."""
    noise, perturbations, initial = (problem.laws[name] for name in ("noise", "perturbations", "initial"))

    def covariance_apply(t: int, X: np.ndarray) -> np.ndarray:
        atoms, probability = perturbations[t]
        centred = atoms - first_moment(perturbations[t])
        return sum(p * D @ X @ D.T for p, D in zip(probability, centred, strict=True))

    return expected_cost_moments(
        **problem.system,
        **problem.cost,
        M=M,
        noise_mean=np.stack([first_moment(law) for law in noise]),
        noise_covariance=np.stack([covariance(law) for law in noise]),
        perturbation_mean=np.stack([first_moment(law) for law in perturbations]),
        covariance_apply=covariance_apply,
        initial_mean=first_moment(initial),
        initial_covariance=covariance(initial),
    )


def central_differences(function, M: np.ndarray, step: float) -> np.ndarray:
    """The gradient of a scalar function of M by central differences, exact up to rounding for a quadratic."""
    gradient = np.zeros_like(M)
    for index in np.ndindex(*M.shape):
        forward, backward = M.copy(), M.copy()
        forward[index] += step
        backward[index] -= step
        gradient[index] = (function(forward) - function(backward)) / (2 * step)
    return gradient


def relative_error(value: np.ndarray, reference: np.ndarray) -> float:
    """The largest deviation, relative to the largest entry of the reference."""
    return float(np.abs(value - reference).max() / np.abs(reference).max())


SHAPES = {  # n, m, horizon, memory, (atoms of the noise, atoms of the perturbation)
    "scalar": (1, 1, 4, 1, (2, 2)),
    "one_input": (2, 1, 4, 2, (2, 2)),
    "many_atoms": (2, 2, 3, 2, (3, 3)),
    "long_memory": (3, 2, 4, 3, (2, 2)),
    "memory_above_horizon": (2, 3, 2, 3, (3, 2)),
    "long_horizon": (2, 2, 6, 3, (2, 2)),
}
STATE_PROBLEMS = {
    f"{name}-{'centred' if centred else 'means'}-{'full' if full else 'plain'}": (
        *shape,
        {"centred": centred, "on_input": False, "full_cost": full},
    )
    for name, shape in SHAPES.items()
    for centred, full in ((True, False), (True, True), (False, False), (False, True))
}
INPUT_PROBLEMS = {
    f"{name}-on_input": (*shape, {"centred": False, "on_input": True, "full_cost": True})
    for name, shape in SHAPES.items()
}
ALL_PROBLEMS = STATE_PROBLEMS | INPUT_PROBLEMS


def build(case: tuple) -> Problem:
    """The problem of one row of the tables."""
    *shape, options = case
    return random_problem(7, *shape, **options)


@pytest.mark.parametrize("case", ALL_PROBLEMS.values(), ids=ALL_PROBLEMS.keys())
def test_enumerated_cost_matches_moment_propagation(case):
    problem = build(case)
    enumerated, _ = enumerate_cost(**problem.system, **problem.cost, M=problem.M, **problem.laws)
    assert cost_from_moments(problem, problem.M) == pytest.approx(enumerated, rel=1e-12)


@pytest.mark.parametrize("case", ALL_PROBLEMS.values(), ids=ALL_PROBLEMS.keys())
def test_enumerated_gradient_matches_central_differences_of_the_moment_cost(case):
    problem = build(case)
    _, gradient = enumerate_cost(**problem.system, **problem.cost, M=problem.M, **problem.laws)
    differences = central_differences(lambda M: cost_from_moments(problem, M), problem.M, step=1.0)
    assert relative_error(gradient, differences) < 1e-11


@pytest.mark.parametrize("name", ["scalar-means-full", "many_atoms-means-full", "many_atoms-on_input"])
def test_enumerated_gradient_matches_central_differences_of_the_enumerated_cost(name):
    problem = build(ALL_PROBLEMS[name])

    def cost(M):
        return enumerate_cost(**problem.system, **problem.cost, M=M, **problem.laws)[0]

    _, gradient = enumerate_cost(**problem.system, **problem.cost, M=problem.M, **problem.laws)
    assert relative_error(gradient, central_differences(cost, problem.M, step=1.0)) < 1e-11


@pytest.mark.parametrize(
    "case",
    [case for name, case in STATE_PROBLEMS.items() if not name.startswith("long_horizon")],
    ids=[name for name in STATE_PROBLEMS if not name.startswith("long_horizon")],
)
def test_printed_gradient_averages_to_the_enumerated_gradient(case):
    problem = build(case)
    paths = enumerate_paths(**problem.laws)
    x, u, _, _ = simulate(**problem.system, M=problem.M, paths=paths)
    _, grad_x, grad_u = stage_gradients(x, u, **problem.cost)
    average = sum(
        paths.probability[p]
        * printed_gradient(
            **problem.system,
            deltas=paths.perturbation[p],
            x=x[p],
            w=paths.noise[p],
            M_shape=problem.M.shape,
            grad_x=grad_x[p],
            grad_u=grad_u[p],
        )
        for p in range(paths.probability.size)
    )
    _, gradient = enumerate_cost(**problem.system, **problem.cost, M=problem.M, **problem.laws)
    assert relative_error(average, gradient) < 1e-12


@pytest.mark.parametrize("case", STATE_PROBLEMS.values(), ids=STATE_PROBLEMS.keys())
def test_printed_gradient_and_state_match_forward_sensitivity_on_single_paths(case):
    problem = build(case)
    paths = enumerate_paths(**problem.laws)
    chosen = np.random.default_rng(0).choice(paths.probability.size, size=5)
    paths = type(paths)(*(part[chosen] for part in paths))
    x, u, dx, du = simulate(**problem.system, M=problem.M, paths=paths)
    _, grad_x, grad_u = stage_gradients(x, u, **problem.cost)
    for p in range(len(chosen)):
        path = {"deltas": paths.perturbation[p], "w": paths.noise[p]}
        for t in range(x.shape[1]):
            state = printed_state(**problem.system, **path, M=problem.M, initial_state=paths.initial_state[p], t=t)
            np.testing.assert_allclose(state, x[p, t], rtol=0, atol=1e-13 * max(1.0, np.abs(x[p]).max()))
        printed = printed_gradient(
            **problem.system, **path, x=x[p], M_shape=problem.M.shape, grad_x=grad_x[p], grad_u=grad_u[p]
        )
        forward = np.einsum("ta,taibc->ibc", grad_x[p], dx[p]) + np.einsum("ta,taibc->ibc", grad_u[p], du[p])
        assert relative_error(printed, forward) < 1e-12


def test_printed_gradient_matches_central_differences_when_the_cost_is_not_quadratic():
    problem = build(STATE_PROBLEMS["long_memory-means-full"])
    paths = enumerate_paths(**problem.laws)
    path = type(paths)(*(part[100:101] for part in paths))

    def cost(M):
        x, u, _, _ = simulate(**problem.system, M=M, paths=path)
        return np.sum(np.logaddexp(x, -x)) + np.sum(np.sqrt(1 + u**2)) + np.sum(x[..., :1] * u[..., :1])

    x, u, _, _ = simulate(**problem.system, M=problem.M, paths=path)
    grad_x, grad_u = np.tanh(x[0]), u[0] / np.sqrt(1 + u[0] ** 2)
    grad_x[:, 0] += u[0, :, 0]
    grad_u[:, 0] += x[0, :, 0]
    printed = printed_gradient(
        **problem.system,
        deltas=path.perturbation[0],
        x=x[0],
        w=path.noise[0],
        M_shape=problem.M.shape,
        grad_x=grad_x,
        grad_u=grad_u,
    )
    assert relative_error(printed, central_differences(cost, problem.M, step=1e-5)) < 1e-8


def test_printed_formulas_refuse_perturbations_of_the_input():
    problem = build(INPUT_PROBLEMS["many_atoms-on_input"])
    paths = enumerate_paths(**problem.laws)
    with pytest.raises(ValueError, match="perturbations of shape"):
        printed_state(
            **problem.system,
            deltas=paths.perturbation[0],
            M=problem.M,
            initial_state=paths.initial_state[0],
            w=paths.noise[0],
            t=1,
        )


def test_enumerated_cost_equals_a_sum_done_by_hand():
    """Scalar, T = H = 1: x_1 = (A + d) x_0 + w_0, u_0 = 0 and u_1 = M w_0, with A = 0.5, K = 0, Q = R = 1."""
    noise = [(np.array([[-1.0], [3.0]]), np.array([0.75, 0.25]))]  # mean 0, second moment 3
    perturbations = [(np.array([[[0.2]], [[-0.2]]]), np.array([0.5, 0.5]))]
    initial = (np.array([[2.0]]), np.array([1.0]))
    one, two = np.ones((1, 1, 1)), np.ones((2, 1, 1))
    cost, gradient = enumerate_cost(0.5 * one, one, 0 * two, two, two, 4.0 * one, noise, perturbations, initial)
    assert cost == pytest.approx(4 + (4 * (0.25 + 0.04) + 3) + 16 * 3, rel=1e-14)
    assert gradient == pytest.approx(np.array([[[2 * 4 * 3.0]]]), rel=1e-14)


def test_enumeration_refuses_probabilities_that_do_not_sum_to_one():
    law = (np.zeros((2, 1)), np.array([0.5, 0.4]))
    with pytest.raises(ValueError, match="sum 1"):
        enumerate_paths([law], [(np.zeros((1, 1, 1)), np.ones(1))], (np.zeros((1, 1)), np.ones(1)))


A_PUBLISHED = np.array([[0.7, 0.3, 0.2], [-0.2, 0.4, 0.5], [-0.4, 0.2, -0.3]])
B_PUBLISHED = np.array([[0.5, -0.3], [0.8, 0.3], [0.1, 0.9]])
DIRECTION_PUBLISHED = 0.1 * np.array([[2.0, 9.0, -6.0], [9.0, 9.0, 4.0], [-9.0, -2.0, 5.0]])
GAIN_PUBLISHED = -np.array([[-0.2130622, -0.34520195, -0.33427461], [0.39663286, -0.0863928, 0.14257925]])
COST_WITH_MULTIPLICATIVE_NOISE = 4.858605014
COST_WITHOUT_MULTIPLICATIVE_NOISE = 4.062689566


def test_multiplicative_noise_cost_matches_published_number():
    arguments = (DIRECTION_PUBLISHED[None], [0.1], np.eye(3), np.eye(2))
    cost, P = infinite_horizon_cost(A_PUBLISHED, B_PUBLISHED, GAIN_PUBLISHED, *arguments)
    assert cost == pytest.approx(COST_WITH_MULTIPLICATIVE_NOISE, abs=1e-9)
    np.testing.assert_allclose(P, P.T, atol=1e-13)


def test_generalised_riccati_gain_matches_published_gain():
    gain = generalised_riccati_gain(A_PUBLISHED, B_PUBLISHED, DIRECTION_PUBLISHED[None], [0.1], np.eye(3), np.eye(2))
    np.testing.assert_allclose(gain, GAIN_PUBLISHED, rtol=0, atol=1e-8)


def test_plain_lqr_cost_matches_published_number():
    gain = riccati_gain(A_PUBLISHED, B_PUBLISHED, np.eye(3), np.eye(2))
    cost, _ = infinite_horizon_cost(A_PUBLISHED, B_PUBLISHED, gain, [], [], np.eye(3), np.eye(2))
    assert cost == pytest.approx(COST_WITHOUT_MULTIPLICATIVE_NOISE, abs=1e-9)


def test_infinite_horizon_cost_is_refused_when_not_mean_square_stable():
    with pytest.raises(ValueError, match="mean square"):
        infinite_horizon_cost(
            A_PUBLISHED, B_PUBLISHED, GAIN_PUBLISHED, DIRECTION_PUBLISHED[None], [10.0], np.eye(3), np.eye(2)
        )


@pytest.mark.parametrize(("variance", "expected"), [(0.1, COST_WITH_MULTIPLICATIVE_NOISE), (0.0, None)])
def test_finite_horizon_moments_tend_to_the_infinite_horizon_cost(variance, expected):
    horizon = 400
    gain = GAIN_PUBLISHED if expected else riccati_gain(A_PUBLISHED, B_PUBLISHED, np.eye(3), np.eye(2))
    cost = expected_cost_moments(
        A=np.tile(A_PUBLISHED, (horizon, 1, 1)),
        B=np.tile(B_PUBLISHED, (horizon, 1, 1)),
        K=np.tile(gain, (horizon + 1, 1, 1)),
        Q=np.tile(np.eye(3), (horizon + 1, 1, 1)),
        R=np.tile(np.eye(2), (horizon + 1, 1, 1)),
        M=np.zeros((1, 2, 3)),
        noise_mean=np.zeros((horizon, 3)),
        noise_covariance=np.zeros((horizon, 3, 3)),
        perturbation_mean=np.zeros((horizon, 3, 3)),
        covariance_apply=lambda t, X: variance * DIRECTION_PUBLISHED @ X @ DIRECTION_PUBLISHED.T,
        initial_mean=np.zeros(3),
        initial_covariance=np.eye(3),
    )
    assert cost == pytest.approx(expected or COST_WITHOUT_MULTIPLICATIVE_NOISE, abs=1e-9)


MEAN, SENSITIVITY, DEVIATION, FIRST = 10.0, 0.9, 0.1, 10.0


def prediction_problem(decision: float, deployed: float) -> tuple[float, float]:
    """Cost and gradient of performative mean estimation, enumerated as a control problem with T = 2."""
    one = np.ones((1, 1))
    centre = MEAN - 1 + SENSITIVITY * deployed
    reaction = np.array([centre - DEVIATION, centre + DEVIATION]).reshape(2, 1, 1)
    certain = np.ones(1)
    Q = np.array([0.0, 0.0, 0.5]).reshape(3, 1, 1)
    cost, gradient = enumerate_cost(
        A=np.zeros((2, 1, 1)),
        B=-np.ones((2, 1, 1)),
        K=np.zeros((3, 1, 1)),
        Q=Q,
        R=np.zeros((3, 1, 1)),
        M=decision * np.ones((1, 1, 1)),
        noise=[(one, certain), (one, certain)],
        perturbations=[(np.zeros((1, 1, 1)), certain), (reaction, np.full(2, 0.5))],
        initial=(np.zeros((1, 1)), certain),
    )
    return cost, gradient.item()


def test_prediction_embedding_has_the_loss_and_gradient_of_mean_estimation():
    decision, deployed = 3.7, -2.0
    gap = decision - MEAN - SENSITIVITY * deployed
    cost, gradient = prediction_problem(decision, deployed)
    assert cost == pytest.approx((gap**2 + DEVIATION**2) / 2, rel=1e-13)
    assert gradient == pytest.approx(gap, rel=1e-13)


def test_prediction_embedding_contracts_at_the_sensitivity_under_repeated_minimisation():
    stable = stable_decision(MEAN, SENSITIVITY)
    deployed = FIRST
    for _ in range(5):
        slope = prediction_problem(1.0, deployed)[1] - prediction_problem(0.0, deployed)[1]
        response = -prediction_problem(0.0, deployed)[1] / slope
        assert (response - stable) / (deployed - stable) == pytest.approx(SENSITIVITY, rel=1e-12)
        deployed = response
    assert prediction_problem(stable, stable)[1] == pytest.approx(0.0, abs=1e-12)


def test_greedy_descent_error_matches_published_numbers():
    steps = [published_step_size(t, SENSITIVITY) for t in range(1, 10_001)]
    np.testing.assert_allclose(steps, [10 / (k + 801) for k in range(10_000)], rtol=1e-14)
    errors = squared_errors(steps, FIRST, MEAN, SENSITIVITY, DEVIATION)
    assert errors[100] == pytest.approx(6400.00012, abs=5e-6)
    assert errors[1000] == pytest.approx(1600.00031, abs=5e-6)
    assert errors[10_000] == pytest.approx(44.44453, abs=5e-6)


def test_greedy_descent_error_matches_its_telescoped_form():
    """With eta_k = 10 / (k + 801) and 1 - sensitivity = 0.1, every factor is (k + 800) / (k + 801)."""
    errors = squared_errors([10 / (k + 801) for k in range(2000)], FIRST, MEAN, SENSITIVITY, DEVIATION)
    n = np.arange(2001)
    expected = (800**2 * 90.0**2 + 100 * DEVIATION**2 * n) / (800 + n) ** 2
    np.testing.assert_allclose(errors, expected, rtol=1e-12)


def test_greedy_descent_error_matches_simulation_within_five_standard_errors():
    rng = np.random.default_rng(3)
    steps = [0.3] * 30
    decision = np.full(20_000, 4.0)
    for step in steps:
        data = 2.0 + 0.5 * decision + 1.5 * rng.choice([-1.0, 1.0], size=decision.size)
        decision = decision - step * (decision - data)
    squares = (decision - stable_decision(2.0, 0.5)) ** 2
    exact = squared_errors(steps, 4.0, 2.0, 0.5, 1.5)[-1]
    assert abs(squares.mean() - exact) < 5 * squares.std() / np.sqrt(squares.size)
