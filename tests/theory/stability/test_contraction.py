"""The sampled stretch against the proved modulus."""

import perfcontrol as pc
from perfcontrol.theory.stability.contraction import contraction_estimate
from tests.theory.problems import random_problem


def test_contraction_estimate_is_a_lower_estimate_of_the_proved_modulus():
    problem = random_problem(1, strength=0.1)
    assert contraction_estimate(problem, pairs=6) <= pc.certify(problem, "rigorous").rate
