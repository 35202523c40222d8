"""Random multiples of fixed directions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import perfcontrol as pc
from perfcontrol.perturbations.scalar_laws import SCALAR_LAWS
from perfcontrol.sets import LiftedSet
from tests.contracts.perturbation import PerturbationContract
from tests.tools import assert_close, assert_mean_is, assert_refused, normal

DIRECTIONS = 0.4 * normal(1, 2, 3, 3)
WIDE_DIRECTIONS = 0.4 * normal(2, 3, 3, 5)
SCALE = pc.Affine(1 + 0.1 * normal(3, 3, 2), 0.2 * normal(4, 3, 2, 2, 2, 3))
MEAN = pc.Affine(0.3 * normal(5, 3, 3, 3), 0.1 * normal(6, 3, 3, 3, 2, 2, 3))


class TestRademacherScales(PerturbationContract):
    def perturbation(self):
        return pc.DirectionalPerturbation(DIRECTIONS, SCALE, MEAN)


class TestUniformScales(PerturbationContract):
    def perturbation(self):
        return pc.DirectionalPerturbation(DIRECTIONS, SCALE, law="uniform")


class TestTruncatedGaussianScales(PerturbationContract):
    def perturbation(self):
        return pc.DirectionalPerturbation(DIRECTIONS, SCALE, mean=0.3 * normal(5, 3, 3), law="truncated_gaussian")


class TestConstantScales(PerturbationContract):
    def perturbation(self):
        return pc.DirectionalPerturbation(DIRECTIONS, [0.5, 2.0], mean=0.3 * normal(5, 3, 3, 3))


class TestPerformativeInputMatrix(PerturbationContract):
    """Directions of n + m columns act on [x; u]."""

    def perturbation(self):
        scale = pc.Affine([0.5, -1.0, 0.2], 0.1 * normal(7, 3, 2, 2, 3))
        return pc.DirectionalPerturbation(
            WIDE_DIRECTIONS, scale, pc.Affine(0.2 * normal(8, 3, 5), np.zeros((3, 5, 2, 2, 3)))
        )


class TestScalesByTheNorm(PerturbationContract):
    """Scales of both signs, and a mean that grows with the distance from a policy."""

    def perturbation(self):
        mean = pc.Norm(np.zeros((3, 3)), 0.3 * normal(14, 3, 3), center=normal(15, 2, 2, 3), squared=True)
        return pc.DirectionalPerturbation(DIRECTIONS, pc.Norm([0.5, 0.3], [0.4, -0.6]), mean)


class TestFunctionOfThePolicy(PerturbationContract):
    knows = ("mean", "covariance")

    def perturbation(self):
        return pc.DirectionalPerturbation(DIRECTIONS[:1], lambda M: 0.1 + jnp.sum(M**2)[None])


class TestUnboundedSet(PerturbationContract):
    feasible_set = pc.Unconstrained()
    knows = ("mean", "covariance", "sensitivity")

    def perturbation(self):
        return pc.DirectionalPerturbation(DIRECTIONS, SCALE, MEAN)


class TestUnderAStructure(PerturbationContract):
    shape = (1, 2, 4)
    structure = pc.RepeatedBlock(2)
    feasible_set = pc.RowSimplex(0.8)

    def perturbation(self):
        return pc.DirectionalPerturbation(normal(9, 1, 4, 4), pc.Affine([0.3], normal(10, 1, 1, 2, 4)))


def test_directional_covariance_matches_the_sum_over_directions():
    law, M = pc.DirectionalPerturbation(DIRECTIONS, SCALE), normal(11, 2, 2, 3)
    X, D = np.asarray(normal(12, 3, 3)), np.asarray(DIRECTIONS)
    scales = np.asarray(SCALE(M))
    expected = sum(scales[:, k, None, None] ** 2 * (D[k] @ X @ D[k].T) for k in range(2))
    assert_close(law.covariance(M, 3).apply(jnp.asarray(X)), expected)


def test_scale_map_of_either_sign_gives_the_same_law():
    """Draws differ by the sign of ζ alone; all that is exact is the same. A constant of known sign must be positive."""
    offset, slope = normal(16, 2), normal(17, 2, 2, 2, 3)
    one, two = (pc.DirectionalPerturbation(DIRECTIONS, pc.Affine(sign * offset, sign * slope)) for sign in (1, -1))
    M, X = normal(11, 2, 2, 3), normal(12, 3, 3)
    ball = LiftedSet(pc.FrobeniusBall(0.5), pc.FullStructure(), (2, 2, 3))
    assert_close(two.covariance(M, 3).apply(X), one.covariance(M, 3).apply(X), 0, 0)
    assert_close(two.bound(ball, 3), one.bound(ball, 3))
    assert_close(two.sensitivity(ball, 3), one.sensitivity(ball, 3))
    assert_close(two.sample(jax.random.key(0), M, 3).dense(), -one.sample(jax.random.key(0), M, 3).dense(), 0, 0)


def test_sensitivity_is_attained_by_one_direction_whose_scale_keeps_its_sign():
    """For Δ = scale ζ D with scale > 0, W₁ = |scale - scale'| E|ζ| ‖D‖, largest along the slope."""
    slope = np.asarray(normal(13, 1, 2, 2, 3))
    law = pc.DirectionalPerturbation(DIRECTIONS[:1], pc.Affine([9.0], slope), law="uniform")
    expected = np.linalg.norm(slope) * np.sqrt(3) / 2 * np.linalg.norm(DIRECTIONS[0], 2)
    ball = LiftedSet(pc.FrobeniusBall(1.0), pc.FullStructure(), (2, 2, 3))
    assert_close(law.sensitivity(ball, 4), np.full(4, expected))


def test_bound_is_attained_by_one_direction_on_a_ball():
    slope = np.asarray(normal(13, 1, 2, 2, 3))
    law = pc.DirectionalPerturbation(DIRECTIONS[:1], pc.Affine([9.0], slope))
    ball = LiftedSet(pc.FrobeniusBall(0.5), pc.FullStructure(), (2, 2, 3))
    expected = (9 + 0.5 * np.linalg.norm(slope)) * np.linalg.norm(DIRECTIONS[0], 2)
    assert_close(law.bound(ball, 4), np.full(4, expected))


@pytest.mark.float32
@pytest.mark.parametrize("name", SCALAR_LAWS)
def test_scalar_law_has_zero_mean_unit_variance_and_its_absolute_mean_and_bound(name):
    law = SCALAR_LAWS[name]
    draws = np.asarray(law.sample(jax.random.key(1), (100_000,), jnp.result_type(float)), dtype=float)
    assert_mean_is(draws, 0.0)
    assert_mean_is(draws**2, 1.0)
    assert_mean_is(np.abs(draws), law.mean_absolute)
    assert np.abs(draws).max() <= law.bound * (1 + 1e-6)


def test_truncated_gaussian_constants_match_quadrature():
    def moment(power):
        return scipy.integrate.quad(lambda z: z**power * np.exp(-(z**2) / 2), 0, 3, epsabs=1e-14)[0]

    deviation = np.sqrt(moment(2) / moment(0))
    law = SCALAR_LAWS["truncated_gaussian"]
    assert law.bound == pytest.approx(3 / deviation, rel=1e-10)
    assert law.mean_absolute == pytest.approx(moment(1) / moment(0) / deviation, rel=1e-10)


def check(**kwargs):
    arguments = {"directions": DIRECTIONS, "scale": [1.0, 1.0], **kwargs}
    pc.DirectionalPerturbation(**arguments).check((2, 2, 3), 3)


DIRECTIONALS_REFUSED = {
    "one matrix": (lambda: pc.DirectionalPerturbation(np.eye(3), [1.0]), "directions", "[D]"),
    "unknown law": (lambda: pc.DirectionalPerturbation(DIRECTIONS, [1, 1], law="gaussian"), "law", "'gaussian'"),
    "nan": (lambda: pc.DirectionalPerturbation(DIRECTIONS.at[0, 1, 2].set(np.nan), [1, 1]), "directions", "[0, 1, 2]"),
    "rows": (lambda: check(directions=normal(1, 2, 4, 3)), "directions", "(2, 3, 3)", "(2, 3, 5)"),
    "columns": (lambda: check(directions=normal(1, 2, 3, 4)), "directions", "(2, 3, 4)"),
    "negative scale": (lambda: pc.DirectionalPerturbation(DIRECTIONS, [1.0, -0.5]), "scale", "-0.5", "absolute value"),
    "scale shape": (lambda: check(scale=[1.0, 1.0, 1.0]), "scale", "(3,)", "(3, 2)"),
    "scale map shape": (lambda: check(scale=lambda M: jnp.sum(M)), "scale", "()", "(3, 2)"),
    "scale time axis": (lambda: check(scale=np.ones((4, 2))), "scale", "(4, 2)", "(3, 2)"),
    "mean map shape": (lambda: check(mean=lambda M: M[0]), "mean", "(2, 3)", "(3, 3, 3)"),
    "map of another policy": (lambda: check(scale=pc.Affine([1.0, 1.0], np.ones((2, 1, 2, 3)))), "scale", "(2, 2, 3)"),
    "map of two arguments": (lambda: check(scale=lambda M, extra: M[0, 0, :2]), "scale", "policy map"),
}


@pytest.mark.parametrize("case", DIRECTIONALS_REFUSED.values(), ids=DIRECTIONALS_REFUSED.keys())
def test_directional_perturbation_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
