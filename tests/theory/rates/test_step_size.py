"""The step size of Theorem 1."""

import pytest

import perfcontrol as pc
from perfcontrol.theory.rates.step_size import descent_constants
from tests.theory.problems import random_problem, small_reaction


def test_theorem_step_size_satisfies_both_conditions_tightly():
    problem = small_reaction()
    m, L, _, _ = descent_constants(problem)
    phi1, phi2 = pc.theorem_step_size(problem)
    assert phi2 >= 1 and phi1 / phi2 <= min(m / L**2, 1 / m) * (1 + 1e-12)
    assert phi1 / (1 + 1 / phi2) == pytest.approx(2 / m)
    pc.InverseStep(phi1, phi2)


def test_theorem_step_size_says_why_none_exists():
    with pytest.raises(pc.InputError, match=r"S = .* μ̃"):
        pc.theorem_step_size(random_problem(0, strength=5.0))
    with pytest.raises(pc.InputError, match="unbounded"):
        pc.theorem_step_size(random_problem(0, bounded=False))
