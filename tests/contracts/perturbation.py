"""What every perturbation law must do."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol._linalg import as_dense
from perfcontrol.sets import LiftedSet
from tests.tools import assert_close, assert_mean_is, normal, random_psd, tolerance


class PerturbationContract:
    """Inherit and define `perturbation`, fit for the sizes below; set `knows` to what the law must not leave out."""

    shape = (2, 2, 3)  # of the lifted policy: (memory, input, state)
    horizon = 3
    samples = 8_000
    feasible_set: pc.AbstractSet = pc.FrobeniusBall(1.5)
    structure: pc.AbstractStructure = pc.FullStructure()
    same_mean = 0.0  # relative: how far policy-free means may differ
    knows = ("mean", "covariance", "bound", "sensitivity")  # the rest may be None

    def perturbation(self):
        """The law under test."""
        raise NotImplementedError

    def lifted_set(self) -> LiftedSet:
        return LiftedSet(self.feasible_set, self.structure, self.shape)

    def policies(self) -> list[jax.Array]:
        """Four feasible lifted policies: small ones, and ones on the boundary where there is one."""
        free = self.structure.free_shape(self.shape)
        points = [scale * normal(31 + i, *free) for i, scale in enumerate((0.2, 0.3, 3.0, 5.0))]
        return [self.structure.lift(self.feasible_set.project(point)) for point in points]

    def columns(self) -> int:
        _, m, n = self.shape
        return self.perturbation().columns(n, m)

    @classmethod
    @functools.cache
    def drawn(cls) -> tuple[pc.AbstractPerturbation, list[jax.Array], list[np.ndarray]]:
        """The law, its policies and dense draws under each, (S, T, n, p), once a class."""
        law, policies = cls().perturbation(), cls().policies()
        keys = jax.random.split(jax.random.key(7), cls.samples)

        @eqx.filter_jit
        def dense(law, M, keys):
            return jax.lax.map(lambda key: law.sample(key, M, cls.horizon).dense(), keys, batch_size=500)

        return law, policies, [np.asarray(dense(law, M, keys), dtype=float) for M in policies]

    @classmethod
    @functools.cache
    def moments(cls, index: int) -> dict | None:
        """Mean and covariance operator under one policy, the latter applied to fixed matrices; None if unknown."""
        law, policies, _ = cls.drawn()
        p, n, T = law.columns(cls.shape[2], cls.shape[1]), cls.shape[2], cls.horizon
        if law.mean(policies[index], T) is None:
            return None
        arguments = {
            "X": random_psd(43, p),
            "Y": random_psd(47, n),
            "Xt": normal(44, T, p, p),
            "Yt": normal(45, T, n, n),
        }

        @eqx.filter_jit
        def compute(law, M, X, Y, Xt, Yt):
            covariance, operator = law.covariance(M, T), law.mean_operator(M, T)
            applied = {"X": covariance.apply(X), "Xt": covariance.apply(Xt)}
            applied |= {"Y": covariance.adjoint(Y), "Yt": covariance.adjoint(Yt)}
            applied |= {
                "X again": covariance.apply(jnp.stack([X] * T)),
                "Y again": covariance.adjoint(jnp.stack([Y] * T)),
            }
            return law.mean(M, T), None if operator is None else as_dense(operator), applied

        mean, operator, applied = compute(law, policies[index], **arguments)
        return {"mean": mean, "operator": operator, "applied": applied, "arguments": arguments}

    def known_moments(self, index: int) -> dict:
        moments = self.moments(index)
        if moments is None:
            pytest.skip("moments unknown")
        return moments

    def test_law_fits_its_shape_and_draws_have_it(self):
        law, _, draws = self.drawn()
        _, m, n = self.shape
        law.check(self.shape, self.horizon)
        assert self.columns() in (n, n + m)
        assert draws[0].shape == (self.samples, self.horizon, n, self.columns())

    @pytest.mark.parametrize("name", ["mean", "covariance", "bound", "sensitivity"])
    def test_law_knows_what_it_claims(self, name):
        law, policies, _ = self.drawn()
        argument = policies[0] if name in ("mean", "covariance") else self.lifted_set()
        assert name not in self.knows or getattr(law, name)(argument, self.horizon) is not None

    @pytest.mark.float32
    def test_draws_are_operators_that_match_dense_and_the_key(self):
        """Draws come back from one batched program and serve a second one; the same keys give the same numbers."""
        law, policies, draws = self.drawn()
        keys = jax.random.split(jax.random.key(7), self.samples)[:3]
        z, y = normal(41, self.horizon, self.columns()), normal(42, self.horizon, self.shape[2])
        drawn = eqx.filter_jit(jax.vmap(lambda key: law.sample(key, policies[2], self.horizon)))(keys)

        def products(drawn):
            by_step = jax.vmap(drawn.matvec_step)(drawn.steps, z), jax.vmap(drawn.rmatvec_step)(drawn.steps, y)
            return drawn.dense(), drawn.matvec(z), drawn.rmatvec(y), *by_step

        dense, ahead, back, ahead_by_step, back_by_step = eqx.filter_jit(jax.vmap(products))(drawn)
        assert_close(dense, draws[2][:3])
        expected = np.einsum("stab,tb->sta", draws[2][:3], z), np.einsum("stab,ta->stb", draws[2][:3], y)
        for value, reference in zip((ahead, back, ahead_by_step, back_by_step), 2 * expected, strict=True):
            assert_close(value, reference, 1e-12, 1e-5)

    @pytest.mark.float32
    @pytest.mark.parametrize("index", [0, 2])
    def test_sample_mean_within_five_standard_errors_of_mean(self, index):
        mean, draws = self.known_moments(index)["mean"], self.drawn()[2][index]
        assert mean.shape == draws.shape[1:]
        assert_mean_is(draws, mean)

    def test_mean_operator_equals_the_mean(self):
        moments = self.known_moments(2)
        mean, operator = moments["mean"], moments["operator"]
        assert_close(np.zeros(mean.shape) if operator is None else operator, mean)

    @pytest.mark.float32
    @pytest.mark.parametrize("index", [0, 2])
    def test_covariance_apply_within_five_standard_errors_of_samples(self, index):
        moments, draws = self.known_moments(index), self.drawn()[2][index]
        centred = draws - np.asarray(moments["mean"], dtype=float)
        right = np.asarray(moments["arguments"]["X"], dtype=float) @ centred.swapaxes(-1, -2)
        assert_mean_is(centred @ right, moments["applied"]["X"])

    @pytest.mark.float32
    def test_covariance_adjoint_is_the_adjoint_of_apply(self):
        """<apply(X), Y> = <X, adjoint(Y)> for X and Y that vary in time and need not be symmetric."""
        moments = self.known_moments(2)
        X, Y = moments["arguments"]["Xt"], moments["arguments"]["Yt"]
        applied, pulled = moments["applied"]["Xt"], moments["applied"]["Yt"]
        assert applied.shape == Y.shape and pulled.shape == X.shape
        left, right = jnp.sum(applied * Y, axis=(1, 2)), jnp.sum(X * pulled, axis=(1, 2))
        scale = jnp.sqrt(jnp.sum(applied**2) * jnp.sum(Y**2)) + 1e-30
        assert float(jnp.max(jnp.abs(left - right))) <= tolerance(1e-12, 1e-5) * float(scale)

    def test_covariance_of_a_constant_matrix_equals_that_of_its_repetition(self):
        applied = self.known_moments(0)["applied"]
        assert_close(applied["X"], applied["X again"], 1e-13)
        assert_close(applied["Y"], applied["Y again"], 1e-13)

    def test_draws_are_independent_over_time(self):
        """Fixed combinations of the entries of Δ_t and Δ_{t+1} are uncorrelated."""
        draws = self.drawn()[2][2]
        weights = np.asarray(normal(48, 4, *draws.shape[2:]), dtype=float)
        values = np.einsum("stab,kab->stk", draws, weights)
        values = values - values.mean(axis=0)
        assert_mean_is(values[:, :-1, :, None] * values[:, 1:, None, :], np.zeros((self.horizon - 1, 4, 4)))

    @pytest.mark.float32
    def test_bound_is_never_exceeded(self):
        law, _, draws = self.drawn()
        bound = law.bound(self.lifted_set(), self.horizon)
        if bound is None:
            pytest.skip("bound unknown")
        assert bound.shape == (self.horizon,)
        largest = np.max([np.linalg.norm(some, ord=2, axis=(-2, -1)).max(axis=0) for some in draws], axis=0)
        assert np.all(largest <= np.asarray(bound) * (1 + tolerance(1e-12, 1e-5)))

    def test_sensitivity_is_not_below_an_empirical_lower_bound(self):
        """W₁ is at least |E f(Δ) - E f(Δ')| for every f of Lipschitz constant 1 in the spectral norm."""
        law, policies, draws = self.drawn()
        sensitivity = law.sensitivity(self.lifted_set(), self.horizon)
        if sensitivity is None:
            pytest.skip("sensitivity unknown")
        assert sensitivity.shape == (self.horizon,)
        for one, two in ((0, 1), (0, 2), (1, 3), (2, 3)):
            distance = float(jnp.linalg.norm(policies[one] - policies[two]))
            centre = (draws[one].mean(axis=0) + draws[two].mean(axis=0)) / 2
            left, _, right = np.linalg.svd(draws[one].mean(axis=0) - draws[two].mean(axis=0))
            leading = left[:, :, 0], right[:, 0, :]

            def dual_values(some, centre=centre, leading=leading):
                spectral = np.linalg.norm(some - centre, ord=2, axis=(-2, -1))
                along = np.einsum("ta,stab,tb->st", leading[0], some - centre, leading[1])
                return np.stack([spectral, along, np.abs(along), np.linalg.norm(some, ord=2, axis=(-2, -1))], axis=-1)

            first, second = dual_values(draws[one]), dual_values(draws[two])
            error = np.sqrt((first.var(axis=0) + second.var(axis=0)) / self.samples)
            lower = np.abs(first.mean(axis=0) - second.mean(axis=0)) - 5 * error
            assert np.all(lower.max(axis=-1) <= np.asarray(sensitivity) * distance * (1 + 1e-9) + 1e-12)

    def test_mean_moves_as_its_derivative_says(self):
        law, policies, _ = self.drawn()
        derivative = law.mean_derivative()
        if derivative is None:
            pytest.skip("the mean is not known to be affine")
        for M in policies[1:]:
            moved = law.mean(M, self.horizon) - law.mean(policies[0], self.horizon)
            by_derivative = jnp.tensordot(derivative, M - policies[0], 3)
            assert_close(moved, jnp.broadcast_to(by_derivative, moved.shape))

    def test_mean_is_the_same_everywhere_where_it_is_said_to_be_policy_free(self):
        law, policies, _ = self.drawn()
        if not law.policy_free_mean(self.lifted_set()):
            pytest.skip("the mean may depend on the policy")
        for M in policies[1:]:
            assert_close(law.mean(M, self.horizon), law.mean(policies[0], self.horizon), self.same_mean)
