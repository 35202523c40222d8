"""Existence of a stable policy: which argument gives it, and whose word it rests on."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory import existence
from perfcontrol.theory.assumptions import weakest
from perfcontrol.theory.existence import constant_mean
from tests.theory.problems import random_problem

pytestmark = pytest.mark.float32
SLOPE = 0.1 * np.ones((2, 2, 1, 2))


def with_scale(scale, bounded=True, **others):
    base = random_problem(1, bounded=bounded)
    fields = {name: getattr(base, name) for name in ("system", "horizon", "memory", "gain", "noise", "cost")}
    fields |= {"feasible_set": base.feasible_set}
    fields |= {"perturbation": pc.DirectionalPerturbation(base.perturbation.directions, scale)}
    return pc.PerformativeProblem(**fields | others)


def jump(M):
    return jnp.where(M[0, 0, 0] > 0, 1.0, 0.5) * jnp.ones(2)


@pytest.mark.parametrize("bounded", [True, False])
@pytest.mark.parametrize(
    ("scale", "status"),
    [
        (np.ones(2), "proved"),
        (pc.Affine(np.ones(2), SLOPE), "proved"),
        (pc.Norm(np.ones(2), 0.1), "proved"),
        (jump, "declared"),  # discontinuous: nothing but the user's word says otherwise
    ],
)
def test_continuity_of_maps_is_proved_and_that_of_functions_is_the_users_word(scale, status, bounded):
    found = existence(with_scale(scale, bounded))
    assert found.exists is True and ("compact" in found.reason) is bounded
    assert {item.text: item.status for item in found.assumptions}[
        "the reaction is continuous in the deployed policy"
    ] == status
    assert weakest(found.assumptions) == status


def test_certificate_says_that_existence_is_declared_where_it_rests_on_a_function():
    certificate = pc.certify(with_scale(jump), "rigorous")
    assert certificate.applicable is False and certificate.exists is True
    assert certificate.existence_status == "declared"
    assert "A stable policy exists (declared)" in str(certificate) and "(proved)" in str(certificate)
    proved = pc.certify(with_scale(pc.Norm(np.ones(2), 0.1)), "global")
    assert proved.applicable and proved.existence_status == "proved"


def test_existence_that_the_solver_finds_is_estimated():
    base = with_scale(pc.Affine(np.ones(2), SLOPE), bounded=False)
    directions = base.perturbation.directions
    reacting_mean = pc.Affine(np.zeros((2, 2)), 0.01 * np.ones((2, 2, 2, 1, 2)))
    problem = eqx.tree_at(
        lambda p: p.perturbation, base, pc.DirectionalPerturbation(directions, np.ones(2), reacting_mean)
    )
    assert existence(problem).exists is None
    certificate = pc.certify(problem, pc.Sharp(samples=0, pairs=0))
    assert certificate.exists is True and certificate.existence_status == "estimated"
    assert not any("differentiable" in item.text for item in certificate.assumptions)
    function = eqx.tree_at(
        lambda p: p.perturbation.scale, problem, pc.Function(lambda M: 1 + 0.01 * jnp.sum(M) * jnp.ones(2))
    )
    declared = pc.certify(function, pc.Sharp(samples=0, pairs=0)).assumptions
    assert [item.status for item in declared if "differentiable" in item.text] == ["declared"]


def test_sampled_families_declare_their_bounds_and_leave_continuity_to_the_user():
    def sampler(key, M):
        return 0.1 * jnp.ones((5, 2, 2))

    told = with_scale(1.0, perturbation=pc.SampledPerturbation(sampler, bound=0.2, sensitivity=0.0))
    assert weakest(existence(told).assumptions) == "declared"
    declared = {item.text for item in pc.certify(told, "rigorous").assumptions if item.status == "declared"}
    assert "the almost-sure bound of the perturbations" in declared
    assert "the sensitivity of the perturbation law" in declared
    untold = with_scale(1.0, perturbation=pc.SampledPerturbation(sampler, bound=0.2))
    assert existence(untold).exists is None


class OwnNoise(pc.Uniform):
    """A user's own law."""


class OwnPerturbation(pc.DirectionalPerturbation):
    """A user's own family."""


def test_what_the_users_own_classes_say_is_declared():
    noisy = with_scale(pc.Affine(np.ones(2), SLOPE), noise=OwnNoise(-np.ones(2), np.ones(2)))
    certificate = pc.certify(noisy, "rigorous")
    assert certificate.applicable
    assert any(str(item) == "what OwnNoise says of itself (declared)" for item in certificate.assumptions)
    own = OwnPerturbation(noisy.perturbation.directions, pc.Affine(np.ones(2), SLOPE))
    assert weakest(existence(with_scale(1.0, perturbation=own)).assumptions) == "declared"


def test_convexity_of_a_function_as_cost_is_declared():
    cost = pc.ConvexCost(lambda t, x, u: jnp.sum(x**4) + jnp.sum(u**2))
    found = existence(with_scale(pc.Affine(np.ones(2), SLOPE), cost=cost))
    assert found.exists is True
    assert {item.text: item.status for item in found.assumptions}[
        "the stage cost is continuous and convex"
    ] == "declared"


def test_mean_is_constant_only_where_every_part_of_it_is():
    """E Δ = mean(M) + scale(M) E Z: a flat mean map is not enough where the scale reacts and Z has a mean."""
    flat = pc.Affine(np.ones((2, 2)), np.zeros((2, 2, 2, 1, 2)))
    reacting = pc.Affine(1.0, np.ones((2, 1, 2)))
    for Z, constant in ((pc.Uniform(np.zeros(4), np.ones(4)), False), ("uniform", True)):
        law = pc.DensePerturbation(reacting, mean=flat, law=Z)
        assert constant_mean(with_scale(1.0, perturbation=law)) is constant


def test_stock_mean_is_constant_where_the_rows_of_the_portfolio_are_fixed():
    problem = pc.experiments.stock_market("ascending", 1.0)
    assert constant_mean(problem)
    whole = eqx.tree_at(lambda p: p.structure, problem, pc.FullStructure())
    assert not constant_mean(whole)  # the rows of the lifted policy hold more than the portfolio
