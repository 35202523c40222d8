"""White matrices by two products, against whole matrices of the same law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import perfcontrol as pc
from perfcontrol.perturbations.white_draws import chi_squares
from tests.tools import assert_close, assert_mean_is, normal

LAWS = ("gaussian", "sphere")
SAMPLES = 20_000
SHAPES = {"tall": (4, 3), "wide": (2, 5), "one row": (1, 4), "one column": (3, 1), "number": (1, 1)}


def _products(law, n, p, whole, adaptive=True, z=None):
    """Z z and Zᵀ y over many draws, y following from Z z; by whole matrices or by products."""
    M = jnp.zeros((1, max(p - n, 1), n))  # p = n + m where Δ acts on the input; else sizes are passed by hand
    z = jnp.asarray(np.linspace(1.0, 2.0, p)) if z is None else z
    fixed = jnp.asarray(np.linspace(-1.0, 0.5, n))
    perturbation = pc.DensePerturbation(0.7, law=law)
    object.__setattr__(perturbation, "_shape", lambda M: (n, p))

    def one(key):
        draws = (perturbation.sample if whole else perturbation.sample_along)(key, M, 1)
        step = jax.tree.map(lambda leaf: leaf[0], draws.steps)
        ahead = draws.matvec_step(step, z)
        y = fixed + ahead if adaptive else fixed
        back = jax.tree.map(lambda leaf: leaf[0], draws.steps_back(z[None]))
        return ahead, draws.rmatvec_step(back, y), y

    return jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(int(whole)), SAMPLES)), z


@pytest.mark.float32
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", SHAPES)
def test_both_products_are_of_one_matrix(law, name):
    """yᵀ (Z z) = zᵀ (Zᵀ y) in every draw."""
    (ahead, back, y), z = _products(law, *SHAPES[name], whole=False)
    assert_close(jnp.sum(y * ahead, axis=1), back @ z, 1e-12, 1e-4)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", SHAPES)
def test_joint_law_of_the_products_is_that_of_whole_matrices(law, name):
    """Moments up to the fourth of all entries together, and the law along some directions (Kolmogorov and Smirnov)."""
    both = [np.concatenate(_products(law, *SHAPES[name], whole)[0][:2], axis=1) for whole in (True, False)]
    for power in (1, 2):
        first, second = [np.einsum("si,sj->sij", some**power, some**power) for some in both]
        spread = np.sqrt((first.var(axis=0) + second.var(axis=0)) / SAMPLES)
        assert np.all(np.abs(first.mean(axis=0) - second.mean(axis=0)) <= 5 * spread + 1e-9)
    for direction in np.random.default_rng(1).normal(size=(6, both[0].shape[1])):
        along = [np.round(some @ direction, 9) for some in both]  # a sphere of two points: ties, up to rounding
        assert scipy.stats.ks_2samp(*along).pvalue > 1e-4
    lengths = [np.round(np.linalg.norm(some, axis=1), 9) for some in both]
    assert scipy.stats.ks_2samp(*lengths).pvalue > 1e-4


@pytest.mark.parametrize("law", LAWS)
def test_adjoint_at_a_state_of_zero_has_the_law_of_whole_matrices(law):
    back = [_products(law, 3, 4, whole, z=jnp.zeros(4))[0][1] for whole in (True, False)]
    assert np.all(np.isfinite(back[1]))
    for direction in np.random.default_rng(2).normal(size=(4, 4)):
        assert scipy.stats.ks_2samp(*(np.asarray(some) @ direction for some in back)).pvalue > 1e-4


def _world(law, on_input):
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.8, 0.1], [0.0, 0.7]], np.eye(2)),
        horizon=6,
        memory=2,
        gain=0.2 * np.eye(2),
        noise=pc.Rademacher(np.ones(2)),
        cost=pc.QuadraticCost(np.eye(2), 0.1 * np.eye(2)),
        perturbation=pc.DensePerturbation(
            pc.Norm(0.2, 0.1), mean=0.05 * jnp.ones((2, 4 if on_input else 2)), law=law, on_input=on_input
        ),
        feasible_set=pc.FrobeniusBall(1.0),
    )


@pytest.mark.parametrize("on_input", [False, True])
@pytest.mark.parametrize("law", LAWS)
def test_sampled_cost_and_gradient_within_five_standard_errors_of_the_exact_ones(law, on_input):
    problem, M = _world(law, on_input), 0.2 * normal(3, 2, 2, 2)
    cost = pc.estimate_cost(problem, M, key=jax.random.key(0), samples=10_000)
    assert abs(float(cost.mean - pc.expected_cost(problem, M))) < 5 * float(cost.standard_error)
    keys = jax.random.split(jax.random.key(1), 10_000)
    gradients = jax.jit(jax.vmap(lambda key: pc.sample_gradient(problem, M, key=key)))(keys)
    assert_mean_is(gradients, pc.expected_gradient(problem, M))


@pytest.mark.parametrize("law", LAWS)
def test_sampled_gradients_have_the_law_of_those_of_whole_paths(law):
    problem, M = _world(law, False), 0.2 * normal(3, 2, 2, 2)
    by_products = jax.jit(jax.vmap(lambda key: pc.sample_gradient(problem, M, key=key)))
    whole = jax.jit(jax.vmap(lambda key: pc.path_gradient(problem, pc.simulate(problem, M, key=key))))
    samples = [
        np.asarray(draw(jax.random.split(jax.random.key(seed), 10_000))).reshape(10_000, -1)
        for seed, draw in enumerate((by_products, whole))
    ]
    for direction in np.random.default_rng(4).normal(size=(6, samples[0].shape[1])):
        assert scipy.stats.ks_2samp(*(some @ direction for some in samples)).pvalue > 1e-4


def test_chi_square_numbers_follow_scipys_law():
    degrees, count = (0, 1, 2, 3, 380), 100_000  # so many that one proposal in twenty accepted wrongly is seen
    rows = chi_squares(pc.fast_key(1), degrees, jnp.zeros(count))
    assert not np.any(rows[0])
    for freedom, row in zip(degrees[1:], rows[1:], strict=True):
        assert scipy.stats.kstest(np.asarray(row), scipy.stats.chi2(freedom).cdf).pvalue > 1e-3
    correlations = np.corrcoef(np.asarray(rows[1:])) - np.eye(4)
    assert np.abs(correlations).max() <= 5 / np.sqrt(count)
