"""`pc.fast_key`: the generator against one in plain integers, its streams, and its use as an ordinary key."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import perfcontrol as pc
from perfcontrol.random_keys import ENABLE_X64
from tests.tools import assert_mean_is, assert_refused

WORD = 2**64
PINNED = [2855376189, 1468495518, 3463804336]


def _swap(x: int) -> int:
    return (x >> 32) | ((x << 32) % WORD)


def _squares(key: jax.Array, count: int, width: int) -> list[int]:
    """The published algorithm in Python's integers, on the multiplier and the first counter that a key stands for."""
    words = [int(word) for word in jax.random.key_data(key)]
    a, b = words[0] << 32 | words[1], words[2] << 32 | words[3]
    k, start = a | 1, b + (a % 2 << 63)
    numbers = []
    for counter in range(start, start + count):
        y = counter * k % WORD
        z = (y + k) % WORD
        x = _swap((y * y + y) % WORD)
        x = _swap((x * x + z) % WORD)
        x = _swap((x * x + y) % WORD)
        if width == 32:
            numbers.append((x * x + z) % WORD >> 32)
        else:
            fourth = (x * x + z) % WORD
            x = _swap(fourth)
            numbers.append(fourth ^ ((x * x + y) % WORD >> 32))
    return numbers


def _bits(key: jax.Array, count: int, width: int = 32) -> np.ndarray:
    """Raw numbers, read as pairs where 64-bit integers are switched off."""
    with ENABLE_X64(True):
        return np.asarray(jax.random.bits(key, (count,), f"uint{width}"))


@pytest.mark.float32
@pytest.mark.parametrize("seed", [0, 1, -1, 2**31, 2**63 - 1, -(2**63)])
def test_random_bits_match_the_algorithm_in_plain_integers(seed):
    key = pc.fast_key(seed)
    for made in (key, jax.random.fold_in(key, 3), jax.random.split(key, 5)[4]):
        assert _bits(made, 50).tolist() == _squares(made, 50, 32)
        assert _bits(made, 50, 64).tolist() == _squares(made, 50, 64)


@pytest.mark.float32
def test_random_bits_are_the_same_in_both_precisions():
    """Pinned, so that the run in single precision and the run in double check one another, and releases too."""
    numbers = jax.random.bits(jax.random.fold_in(pc.fast_key(7), 9), (3,), "uint32")
    assert numbers.tolist() == PINNED


def test_keys_of_children_are_distinct_and_start_at_one_counter():
    key, count = pc.fast_key(11), 200_000
    for children in (jax.vmap(lambda d: jax.random.fold_in(key, d))(jnp.arange(count)), jax.random.split(key, count)):
        words = np.asarray(jax.random.key_data(children)).astype(np.uint64)
        multipliers = words[:, 0] << np.uint64(32) | words[:, 1]
        assert len(np.unique(multipliers)) == count
        assert len(np.unique(words[:, 2:], axis=0)) == 1


def test_children_that_share_a_multiplier_start_half_a_cycle_apart():
    """No two such children are known: their parents' words are set by hand, one bit apart."""
    key = pc.fast_key(5)
    words = np.asarray(jax.random.key_data(key))
    last = words[1] & ~np.uint32(1)
    pair = [jnp.asarray([words[0], last | bit, *words[2:]], jnp.uint32) for bit in (np.uint32(0), np.uint32(1))]
    keys = [jax.random.wrap_key_data(data, impl=jax.random.key_impl(key)) for data in pair]
    far = _squares(keys[0], 1, 32), _squares(keys[1], 1, 32)
    assert far[0] != far[1]
    assert not set(_bits(keys[0], 100).tolist()) & set(_bits(keys[1], 100).tolist())


@pytest.mark.float32
def test_numbers_do_not_depend_on_batching():
    keys = jax.random.split(pc.fast_key(3), 6)
    alone = np.stack([jax.random.normal(key, (4, 5)) for key in keys])

    def draw(key):
        return jax.random.normal(key, (4, 5))

    _, scanned = jax.lax.scan(lambda carry, key: (carry, draw(key)), 0, keys)
    for together in (
        jax.vmap(draw)(keys),
        jax.jit(jax.vmap(draw))(keys),
        jax.lax.map(draw, keys, batch_size=4),
        scanned,
    ):
        np.testing.assert_allclose(together, alone, rtol=1e-6)  # erf_inv rounds by how it is compiled
    raw = np.stack([_bits(key, 7) for key in keys])
    assert (np.asarray(jax.vmap(lambda key: jax.random.bits(key, (7,), "uint32"))(keys)) == raw).all()


@pytest.mark.parametrize("law", ["norm", "uniform"])
def test_numbers_follow_their_law_by_kolmogorov_and_smirnov(law):
    draw = {"norm": jax.random.normal, "uniform": jax.random.uniform}[law]
    one = draw(pc.fast_key(1), (200_000,))
    many = jax.vmap(lambda d: draw(jax.random.fold_in(pc.fast_key(1), d)))(jnp.arange(200_000))
    for numbers in (one, many):
        assert scipy.stats.kstest(np.asarray(numbers, float), law).pvalue > 1e-4


def test_streams_of_children_are_uncorrelated():
    keys = jax.random.split(pc.fast_key(8), 64)
    draws = np.asarray(jax.vmap(lambda key: jax.random.normal(key, (20_000,)))(keys))
    correlations = np.corrcoef(draws)[np.triu_indices(64, 1)] * np.sqrt(20_000)
    assert scipy.stats.kstest(correlations, "norm").pvalue > 1e-4


def _world() -> pc.PerformativeProblem:
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.8, 0.1], [0.0, 0.7]], np.eye(2)),
        horizon=8,
        noise=pc.Rademacher(np.ones(2)),
        cost=pc.QuadraticCost(np.eye(2), 0.1 * np.eye(2)),
        perturbation=pc.DensePerturbation(pc.Norm(0.1, 0.2), law="uniform"),
        feasible_set=pc.FrobeniusBall(1.0),
    )


@pytest.mark.float32
def test_simulated_cost_by_fast_keys_within_five_standard_errors_of_expected_cost():
    problem, M = _world(), jnp.full((1, 2, 2), 0.2)
    costs = pc.simulate(problem, M, key=pc.fast_key(0), samples=20_000).cost
    assert_mean_is(costs, pc.expected_cost(problem, M))


def test_sampled_gradients_by_fast_keys_within_five_standard_errors_of_expected_gradient():
    problem, M = _world(), jnp.full((1, 2, 2), 0.2)
    keys = jax.vmap(lambda n: jax.random.fold_in(pc.fast_key(2), n))(jnp.arange(20_000))  # as RSGD takes them
    gradients = jax.jit(jax.vmap(lambda key: pc.sample_gradient(problem, M, key=key)))(keys)
    assert_mean_is(gradients, pc.expected_gradient(problem, M))


def test_fast_key_under_jit_equals_fast_key_outside():
    inside = jax.jit(lambda seed: jax.random.bits(pc.fast_key(seed), (3,), "uint32"))(12)
    assert (inside == jax.random.bits(pc.fast_key(12), (3,), "uint32")).all()


@pytest.mark.parametrize("seed", [2.5, "1", None, True, [1, 2], 2**63])
def test_seed_that_is_no_integer_of_64_bits_is_refused(seed):
    assert_refused(lambda: pc.fast_key(seed), "seed", "pc.fast_key(0)")
