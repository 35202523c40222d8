"""What every law of a random vector must do."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.tools import assert_close, assert_mean_is, tolerance


class RandomVectorContract:
    """Inherit and define `law`. For laws that vary in time, their own length is the horizon."""

    horizon = 3
    samples = 8_000

    def law(self):
        """The law under test, with all its sizes known."""
        raise NotImplementedError

    @classmethod
    @functools.cache
    def drawn(cls) -> tuple[pc.AbstractRandomVector, np.ndarray]:
        """The law and many draws of a whole horizon (S, T, n), once a class."""
        law = cls().law()
        horizon = law.mean.shape[0] if law.mean.ndim == 2 else cls.horizon
        keys = jax.random.split(jax.random.key(3), cls.samples)
        draws = eqx.filter_jit(jax.vmap(lambda key: law.sample(key, horizon)))(keys)
        return law, np.asarray(draws, dtype=float)

    def test_law_has_consistent_shapes(self):
        law, draws = self.drawn()
        n = law.size
        horizon = draws.shape[1]
        assert draws.shape == (self.samples, horizon, n)
        assert law.mean.shape in {(n,), (horizon, n)}
        assert law.covariance.shape in {(n, n), (horizon, n, n)}
        assert law.mean.ndim == 1 or law.covariance.ndim == 3, "a law with a varying mean has a varying covariance"
        assert law.bound is None or jnp.shape(law.bound) == ()
        assert law.resize(n).size == n

    @pytest.mark.float32
    def test_sample_mean_within_five_standard_errors_of_mean(self):
        law, draws = self.drawn()
        assert_mean_is(draws, np.broadcast_to(law.mean, draws.shape[1:]))

    @pytest.mark.float32
    def test_sample_covariance_within_five_standard_errors_of_covariance(self):
        law, draws = self.drawn()
        centred = draws - np.asarray(law.mean, dtype=float)
        products = centred[..., :, None] * centred[..., None, :]
        assert_mean_is(products, np.broadcast_to(law.covariance, products.shape[1:]))

    def test_covariance_is_symmetric_and_positive_semidefinite(self):
        covariance = np.asarray(self.drawn()[0].covariance, dtype=float)
        scale = max(np.abs(covariance).max(), 1e-300)
        assert_close(covariance, covariance.swapaxes(-1, -2))
        assert np.linalg.eigvalsh(covariance).min() >= -tolerance(1e-13, 1e-5) * scale

    @pytest.mark.float32
    def test_bound_is_never_exceeded(self):
        law, draws = self.drawn()
        if law.bound is None:
            pytest.skip("unbounded law")
        slack = tolerance(1e-12, 1e-5) * float(law.bound)
        assert np.linalg.norm(draws, axis=-1).max() <= float(law.bound) + slack
        low, high = law.entry_range
        assert float(low) - slack <= draws.min() and draws.max() <= float(high) + slack

    def test_draws_are_independent_over_time(self):
        law, draws = self.drawn()
        centred = draws - np.asarray(law.mean, dtype=float)
        products = centred[:, :-1, :, None] * centred[:, 1:, None, :]
        assert_mean_is(products, np.zeros(products.shape[1:]))

    def test_same_key_gives_same_numbers_and_traces_under_jit(self):
        law, draws = self.drawn()
        first = jax.random.split(jax.random.key(3), self.samples)[0]
        assert_close(eqx.filter_jit(lambda law, key: law.sample(key, draws.shape[1]))(law, first), draws[0])

    def test_law_is_an_immutable_pytree(self):
        law, _ = self.drawn()
        leaves, structure = jax.tree.flatten(law)
        again = jax.tree.unflatten(structure, leaves)
        assert_close(again.mean, law.mean, 0, 0)
        assert_close(eqx.filter_jit(lambda law: law.covariance)(law), law.covariance, 1e-13)
        with pytest.raises(AttributeError):
            law.extra = 1
