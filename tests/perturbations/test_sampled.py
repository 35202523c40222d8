"""Perturbations known only through a sampler."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.perturbation import PerturbationContract
from tests.tools import assert_close, assert_refused, normal


class Scaled(eqx.Module):
    """A sampler with a number to sweep."""

    size: jax.Array
    columns: int = eqx.field(static=True)

    def __call__(self, key, M):
        return self.size * jnp.sum(M) * jax.random.uniform(key, (3, 3, self.columns), M.dtype, -1.0, 1.0)


class TestSampledOnStateAndInput(PerturbationContract):
    knows = ("bound", "sensitivity")

    def perturbation(self):
        """‖Δ‖ ≤ size |Σ M| √15, |Σ M| ≤ √12 ‖M‖ and ‖M‖ ≤ 1.5."""
        slope = 0.1 * np.sqrt(12 * 15)
        return pc.SampledPerturbation(Scaled(jnp.asarray(0.1), 5), 1.5 * slope, np.full(3, slope)).resize((2, 2, 3), 3)


def problem(perturbation, **kwargs):
    arguments = {
        "system": pc.LinearSystem(0.4 * normal(1, 3, 3), normal(2, 3, 2)),
        "horizon": 3,
        "memory": 2,
        "noise": pc.Rademacher(np.ones(3)),
        "cost": pc.QuadraticCost(np.eye(3), np.eye(2)),
        "perturbation": perturbation,
        **kwargs,
    }
    return pc.PerformativeProblem(**arguments)


def test_sampled_perturbation_simulates_like_the_family_it_copies():
    """The same draws given as a sampler: the same paths, costs and gradients, Δ acting on [x; u]."""
    family = pc.DensePerturbation(lambda M: 0.1 + 0.1 * jnp.sum(M**2), on_input=True)
    copied = pc.SampledPerturbation(lambda key, M: family.sample(key, M, 3).dense())
    M, key = 0.5 * normal(3, 2, 2, 3), jax.random.key(4)
    one, two = problem(family), problem(copied)
    assert two.perturbation.columns(3, 2) == 5
    first, second = pc.simulate(one, M, key=key, samples=5), pc.simulate(two, M, key=key, samples=5)
    assert_close(second.x, first.x)
    assert_close(pc.sample_gradient(two, M, key=key, samples=5), pc.sample_gradient(one, M, key=key, samples=5))
    assert_close(pc.path_gradient(two, second), pc.path_gradient(one, first))


def test_exact_evaluation_of_a_sampled_perturbation_names_what_is_missing():
    sampled = problem(pc.SampledPerturbation(Scaled(jnp.asarray(0.1), 3)))
    M, key = jnp.zeros((2, 2, 3)), jax.random.key(0)
    refused = [
        lambda: pc.expected_cost(sampled, M),
        lambda: pc.expected_gradient(sampled, M),
        lambda: pc.best_response(sampled, M),
        lambda: pc.residual(sampled, M),
        lambda: pc.state_moments(sampled, M),
        lambda: pc.solve(sampled, pc.RRM()),
        lambda: pc.solve(sampled, pc.StablePoint()),
        lambda: pc.solve(sampled, pc.RSGD(3, 0.1, gradient=pc.Exact()), key=key),
    ]
    for build in refused:
        assert_refused(build, "perturbation", "SampledPerturbation", "moments", "pc.estimate_cost")
    solution = pc.solve(sampled, pc.RSGD(3, 0.01), key=key)
    assert solution.result == pc.Result.success


def test_sampler_with_leaves_is_swept_without_recompiling():
    traces = []

    class Counting(eqx.Module):
        size: jax.Array

        def __call__(self, key, M):
            traces.append(None)
            return self.size * jax.random.uniform(key, (3, 3, 3), M.dtype)

    M, counts = jnp.ones((2, 2, 3)), []
    for size in (0.1, 0.2, 0.3):
        law = pc.SampledPerturbation(Counting(jnp.asarray(size)), columns=3)
        built = problem(law)
        before = len(traces)
        pc.estimate_cost(built, M, key=jax.random.key(0), samples=4)
        counts.append(len(traces) - before)
    assert counts[0] > 0 and counts[1:] == [0, 0]


def test_declared_numbers_are_per_step():
    law = problem(pc.SampledPerturbation(Scaled(jnp.asarray(0.1), 3), bound=2.0, sensitivity=[1.0, 2.0, 3.0]))
    assert_close(law.perturbation_bound(), [2.0, 2.0, 2.0], 0, 0)
    assert_close(law.sensitivity(), [1.0, 2.0, 3.0], 0, 0)


def sampler(*shape):
    return lambda key, M: jnp.zeros(shape)


REFUSED = {
    "no function": (lambda: pc.SampledPerturbation(np.eye(3)), "sampler", "callable"),
    "negative bound": (lambda: pc.SampledPerturbation(sampler(3, 3, 3), bound=-1.0), "bound", "-1.0"),
    "time axis": (lambda: problem(pc.SampledPerturbation(sampler(4, 3, 3))), "sampler", "(4, 3, 3)", "(3, 3, 5)"),
    "no axes": (lambda: problem(pc.SampledPerturbation(sampler())), "sampler", "()"),
    "bound per step": (lambda: problem(pc.SampledPerturbation(sampler(3, 3, 3), bound=[1.0, 2.0])), "bound", "(2,)"),
    "another signature": (lambda: problem(pc.SampledPerturbation(lambda key: key)), "sampler", "accept a key"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_sampled_perturbation_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
