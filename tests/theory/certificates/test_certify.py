"""The certificates against exact evaluation: nothing that is called proved may ever fail."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import perfcontrol as pc
from perfcontrol.theory.certificates.ingredients import gather
from perfcontrol.theory.derivatives import hessian
from perfcontrol.theory.stability.sampled_jacobian import sample_gradients
from tests.theory.problems import random_problem
from tests.tools import assert_refused

SLACK = 1 + 1e-7
responses = jax.jit(jax.vmap(pc.best_response, in_axes=(None, 0)))


def feasible_pairs(problem, seed, count=6):
    r = np.random.default_rng(seed)
    radius = float(problem.feasible_set.limit)
    M = r.standard_normal((2 * count, *problem.policy_shape))
    M *= (
        radius
        * r.uniform(0.2, 1, (2 * count, 1, 1, 1))
        / np.linalg.norm(M.reshape(2 * count, -1), axis=1)[:, None, None, None]
    )
    M[1] = -M[0]  # a diameter
    M[count + 1 : 2 * count] = M[1:count] * 0.999  # and close pairs
    return M[:count], M[count:]


def norms(M):
    return np.linalg.norm(np.asarray(M).reshape(len(M), -1), axis=1)


@settings(max_examples=6, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), skew=st.sampled_from([0.0, 2.0]), strength=st.sampled_from([1e-4, 1e-2, 0.3]))
def test_contraction_bounds_are_never_exceeded_and_order_as_proved(seed, skew, strength):
    assert_contraction_bounds_hold(random_problem(seed, skew=skew, strength=strength), seed)


@pytest.mark.parametrize("squared", [False, True])
def test_scales_by_the_norm_are_certified_on_a_bounded_set_without_declarations(squared):
    """Contraction bounds hold, and are those of the range and Lipschitz constants worked out by hand."""
    base, r = random_problem(5, strength=0.0), np.random.default_rng(5)
    offset, weight = r.uniform(0.1, 0.3, (5, 2)), r.uniform(-0.1, 0.1, (5, 2))
    scale = pc.Norm(offset, weight, 0.3 * r.standard_normal((2, 1, 2)), squared)
    problem = eqx.tree_at(lambda p: p.perturbation.scale, base, scale)
    assert_contraction_bounds_hold(problem, 5)
    radius, center = float(problem.feasible_set.limit), float(np.linalg.norm(scale.center))
    near, far = max(center - radius, 0.0), center + radius
    ends = np.sort([offset + weight * reach ** (2 if squared else 1) for reach in (near, far)], axis=0)
    declared = pc.certify(problem, "global", scale_range=(*ends, np.abs(weight) * (2 * far if squared else 1)))
    assert pc.certify(problem, "global").rate == pytest.approx(declared.rate, rel=1e-9)


def assert_contraction_bounds_hold(problem, seed):
    first, second = feasible_pairs(problem, seed)
    moved = np.asarray(responses(problem, first) - responses(problem, second))
    rigorous, bound = pc.certify(problem, "rigorous"), pc.certify(problem, "global")
    repaired = pc.certify(problem, "paper", repaired=True)
    assert rigorous.applicable and bound.applicable and repaired.applicable
    assert np.all(norms(moved) <= SLACK * rigorous.rate * norms(first - second) + 1e-11)
    metric, basis = bound.values["metric"], bound.values["basis"]

    def metric_norms(M):
        y = M.reshape(len(M), -1) @ basis
        return np.sqrt(np.einsum("pi,ij,pj->p", y, metric, y))

    assert np.all(metric_norms(moved) <= SLACK * bound.rate * metric_norms(first - second) + 1e-11)
    assert rigorous.rate <= repaired.rate * SLACK
    assert rigorous.holds or not repaired.holds


@settings(max_examples=3, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), skew=st.sampled_from([0.0, 2.0]))
def test_gradient_of_the_expected_cost_is_smooth_convex_and_of_bounded_variance(seed, skew):
    problem = random_problem(seed, skew=skew, strength=0.3)
    certificate = pc.certify(problem, "rigorous")
    constants, items = certificate.values["constants"], certificate.values["ingredients"]
    first, second = (jnp.asarray(M) for M in feasible_pairs(problem, seed, 3))
    for M, deployed, N, reacting in zip(first, second, second[::-1], first[::-1], strict=True):
        change = pc.expected_gradient(problem, M, deployed=deployed) - pc.expected_gradient(
            problem, N, deployed=reacting
        )
        allowed = constants.total_smoothness * jnp.linalg.norm(M - N) + certificate.lhs * jnp.linalg.norm(
            deployed - reacting
        )
        assert jnp.linalg.norm(change) <= SLACK * allowed
        values = np.linalg.eigvalsh(hessian(problem, deployed))
        assert values[0] * SLACK >= certificate.rhs > 0
        printed = pc.certify(problem, "paper").rhs
        assert values[0] * SLACK >= printed
    keys = jax.random.split(jax.random.key(seed), 64)
    gradients = np.asarray(sample_gradients(problem, first[0], keys))
    assert gradients.var(axis=0).sum() <= constants.variance
    assert np.all(np.linalg.norm(gradients, axis=1) <= np.sqrt(constants.variance) * SLACK)
    assert items.missing == ()


@pytest.mark.parametrize("seed", range(3))
def test_strong_convexity_holds_when_the_mean_of_the_perturbations_depends_on_the_policy(seed):
    """The Jensen bound is false then: the certificate must fall back on the feedforward bound."""
    one = np.ones((1, 1))
    r = np.random.default_rng(seed)
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0.5 * one, r.uniform(0.5, 1.5) * one),
        horizon=4,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost(one, 0.1 * one),
        gain=r.uniform(0.2, 0.5) * one,
        perturbation=pc.DirectionalPerturbation(
            [one], np.array([0.1]), mean=pc.Affine(0 * one, -0.4 * np.ones((1, 1, 1, 1, 1)))
        ),
        feasible_set=pc.FrobeniusBall(1.0),
    )
    certificate = pc.certify(problem, "rigorous")
    assert certificate.values["convexity"] == "feedforward"
    for M in np.linspace(-1, 1, 9):
        assert np.linalg.eigvalsh(hessian(problem, jnp.full((1, 1, 1), M)))[0] >= certificate.rhs * (1 - 1e-12)


def test_certificates_name_what_is_missing_and_never_say_does_not_hold():
    problem = random_problem(0, bounded=False)
    for kind in ("paper", "rigorous", "global"):
        certificate = pc.certify(problem, kind)
        assert certificate.applicable is False and certificate.holds is None and certificate.rate is None
        assert any("unbounded" in text or "bound" in text for text in certificate.missing)
        assert "not applicable" in str(certificate)
        assert certificate.margin is None


def test_unbounded_noise_is_named_and_may_be_declared_bounded():
    base = random_problem(1)
    problem = pc.PerformativeProblem(
        system=base.system,
        horizon=5,
        memory=2,
        gain=base.gain,
        noise=pc.Gaussian(np.zeros(2), np.eye(2)),
        cost=base.cost,
        perturbation=base.perturbation,
        feasible_set=base.feasible_set,
    )
    assert any("W of the noise" in text for text in pc.certify(problem, "rigorous").missing)
    declared = pc.certify(problem, "rigorous", noise_bound=4.0)
    assert declared.applicable
    assert any(item.status == "declared" and "noise" in item.text for item in declared.assumptions)


def test_singular_noise_is_reported_with_the_direction_that_is_not_excited():
    base = random_problem(2)
    problem = pc.PerformativeProblem(
        system=base.system,
        horizon=5,
        memory=2,
        gain=base.gain,
        noise=pc.Rademacher(np.array([1.0, 0.0])),
        cost=base.cost,
        perturbation=base.perturbation,
        feasible_set=base.feasible_set,
    )
    certificate = pc.certify(problem, "rigorous")
    assert certificate.rhs == 0 and certificate.holds is False
    assert "does not excite the direction" in str(certificate)
    np.testing.assert_allclose(np.abs(certificate.values["ingredients"].quiet_direction), [0, 1], atol=1e-12)
    assert pc.certify(problem, "paper").rhs == 0


def test_general_costs_need_their_constants_declared_or_estimated():
    base = random_problem(3)

    def function(t, x, u):
        return jnp.sum(x**2) / 2 + jnp.sum(jnp.log(jnp.cosh(x))) + jnp.sum(u**2)

    def build(**constants):
        return pc.PerformativeProblem(
            system=base.system,
            horizon=5,
            memory=2,
            gain=base.gain,
            noise=base.noise,
            cost=pc.ConvexCost(function, **constants),
            perturbation=base.perturbation,
            feasible_set=base.feasible_set,
        )

    unknown = pc.certify(build(), "rigorous")
    assert not unknown.applicable and any("smoothness" in text for text in unknown.missing)
    known = pc.certify(build(strong_convexity=1.0, smoothness=2.0, gradient_bound=2.0), "rigorous")
    assert known.applicable and any(item.status == "declared" for item in known.assumptions)
    estimated = pc.certify(build(), "rigorous", estimate=True)
    assert estimated.applicable and any(item.status == "estimated" for item in estimated.assumptions)
    assert estimated.rate <= known.rate * 1.01  # samples find no more curvature than there is
    assert pc.certify(build(), "sharp").applicable is False


def test_certificate_of_a_discounted_quadratic_is_the_same_when_it_is_declared_as_a_function():
    base = random_problem(3)

    def certificate(cost):
        parts = {name: getattr(base, name) for name in ("system", "gain", "noise", "perturbation", "feasible_set")}
        return pc.certify(pc.PerformativeProblem(horizon=5, memory=2, cost=cost, **parts), "rigorous")

    n, m = base.state_size, base.input_size
    by_weights = certificate(pc.QuadraticCost(1.5 * np.eye(n), 1.5 * np.eye(m), discount=0.8))
    by_function = certificate(pc.ConvexCost(lambda t, x, u: 1.5 * (x @ x + u @ u), 3.0, 3.0, 3.0, discount=0.8))
    undiscounted = certificate(pc.QuadraticCost(1.5 * np.eye(n), 1.5 * np.eye(m)))
    assert by_function.lhs == pytest.approx(by_weights.lhs, rel=1e-12)
    assert by_weights.lhs < 0.95 * undiscounted.lhs
    assert by_function.rhs <= by_weights.rhs * (1 + 1e-12)  # weights know more of the curvature than their least one


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sensitivity": [-0.1, 0, 0, 0, 0]}, "-0.1 at t = 0"),
        ({"sensitivity": [0.1, 0.1]}, "one entry for each t"),
        ({"perturbation_bound": np.full(5, -1.0)}, "non-negative"),
        ({"noise_bound": -1.0}, "non-negative"),
        ({"wrong": 1.0}, "Check the spelling"),
        ({"smoothness": -2.0}, "Pass zero or more"),
    ],
)
def test_bad_declarations_raise(options, words):
    with pytest.raises(pc.InputError, match=words):
        pc.certify(random_problem(0), "rigorous", **options)


def test_unknown_kind_raises():
    with pytest.raises(pc.InputError, match="paper"):
        pc.certify(random_problem(0), "best")


def test_a_gain_that_does_not_stabilise_makes_the_paper_inapplicable_but_not_the_rigorous_one():
    problem = random_problem(4, growth=1.2, strength=1e-6)
    certificate = pc.certify(problem, "paper")
    assert not certificate.applicable and any("spectral radius 1.2" in text for text in certificate.missing)
    assert pc.certify(problem, "rigorous").applicable


def test_weights_fall_in_time_and_contributions_add_up():
    certificate = pc.certify(random_problem(5, "wide", strength=1e-3), "rigorous")
    items = gather(random_problem(5, "wide", strength=1e-3))
    np.testing.assert_allclose(certificate.contributions, items.sensitivity * certificate.weights)
    assert certificate.lhs == pytest.approx(certificate.contributions.sum())
    assert certificate.margin == pytest.approx(certificate.rhs - certificate.lhs)


def test_declared_values_of_the_wrong_sign_or_shape_are_refused_at_construction():
    assert_refused(lambda: pc.Rigorous(noise_bound=-1.0), "noise_bound", "-1")
    assert_refused(lambda: pc.Paper(sensitivity=[0.1, -0.1]), "sensitivity", "-0.1 at t = 1")
    assert_refused(lambda: pc.Rigorous(smoothness=np.ones((2, 2))), "smoothness", "(2, 2)", "T+1")
    assert_refused(lambda: pc.Sharp(batch=0), "batch", "at least 1")
    problem = random_problem(0)
    assert_refused(lambda: pc.certify(problem, pc.Rigorous(smoothness=np.ones(5))), "smoothness", "(T+1,) = (6,)")
    assert_refused(lambda: pc.certify(problem, pc.GlobalBound(scale_range=(0.0, 1.0))), "scale_range", "three")
    wrong = pc.GlobalBound(scale_range=(np.zeros(3), 1.0, 0.5))
    assert_refused(lambda: pc.certify(problem, wrong), "scale_range", "(5, 2)")
    assert_refused(lambda: pc.certify(problem, pc.Sharp(M=np.zeros((1, 1, 2)))), "M", "(2, 1, 2)")


def with_scale(scale, **others):
    base = random_problem(1)
    directions = base.perturbation.directions
    fields = {"system": base.system, "horizon": 5, "memory": 2, "gain": base.gain, "noise": base.noise}
    fields |= {"cost": base.cost, "feasible_set": base.feasible_set}
    return pc.PerformativeProblem(**fields | others, perturbation=pc.DirectionalPerturbation(directions, scale))


@pytest.mark.parametrize(
    ("kind", "problem", "argument"),
    [
        ("rigorous", lambda: with_scale(lambda M: 0.1 * jnp.ones(2)), "sensitivity=0.1"),
        ("rigorous", lambda: with_scale(lambda M: 0.1 * jnp.ones(2)), "perturbation_bound=0.5"),
        ("rigorous", lambda: with_scale(np.ones(2), noise=pc.Gaussian(np.zeros(2), np.eye(2))), "noise_bound=2.0"),
        ("global", lambda: with_scale(lambda M: 0.1 * jnp.ones(2)), "scale_range=(0.0, 1.0, 0.5)"),
        ("global", lambda: with_scale(lambda M: 0.1 * jnp.ones(2)), "pc.Affine(offset, slope)"),
        ("global", lambda: with_scale(lambda M: 0.1 * jnp.ones(2)), "pc.Norm(offset, weight)"),
        ("rigorous", lambda: with_scale(lambda M: 0.1 * jnp.ones(2)), "pc.Norm(offset, weight)"),
        (
            "paper",
            lambda: with_scale(np.ones(2), gain=0, system=pc.LinearSystem(2 * np.eye(2), np.ones((2, 1)))),
            "gain=",
        ),
        (
            "sharp",
            lambda: with_scale(np.ones(2), cost=pc.ConvexCost(lambda t, x, u: jnp.sum(x**4))),
            "pc.QuadraticCost",
        ),
    ],
)
def test_what_is_missing_names_the_argument_that_makes_the_certificate_applicable(kind, problem, argument):
    assert any(argument in reason for reason in pc.certify(problem(), kind).missing)


def test_example_values_that_are_named_make_the_certificates_applicable():
    problem = with_scale(lambda M: 0.1 * jnp.ones(2))
    assert pc.certify(problem, pc.Rigorous(sensitivity=0.1, perturbation_bound=0.5)).applicable
    assert pc.certify(problem, pc.GlobalBound(scale_range=(0.0, 1.0, 0.5))).applicable
