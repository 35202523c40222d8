"""The forward moment recursion: an oracle of the engine that shares nothing with it, and what it says of states."""

import numpy as np
import pytest

import perfcontrol as pc
from tests.evaluate.cases import BUILDERS, case
from tests.oracles.enumeration import enumerate_paths, simulate
from tests.tools import assert_close, relative_error

EVERY_CASE = pytest.mark.parametrize("name", BUILDERS)


@EVERY_CASE
def test_cost_by_moments_matches_enumeration_of_every_path(name):
    c = case(name)
    cost = pc.expected_cost_by_moments(c.problem, c.M, deployed=c.deployed)
    assert float(cost) == pytest.approx(c.enumerated()[0], rel=1e-11)


@EVERY_CASE
def test_state_moments_match_enumeration_of_every_path(name):
    c = case(name)
    paths = enumerate_paths(**c.laws())
    x, u, _, _ = simulate(**c.system(), M=np.asarray(c.problem.structure.lift(c.M)), paths=paths)
    z = np.concatenate([x, u], axis=2)
    moments = pc.state_moments(c.problem, c.M, deployed=c.deployed)
    mean = np.einsum("p,pta->ta", paths.probability, z)
    second = np.einsum("p,pta,ptb->tab", paths.probability, z, z)
    assert relative_error(moments.mean, mean) < 1e-11
    assert relative_error(moments.second, second) < 1e-11
    assert_close(moments.covariance, second - mean[:, :, None] * mean[:, None, :], 1e-10)


@pytest.mark.float32
def test_both_forms_agree_in_the_precision_of_the_run():
    c = case("everything varies")
    forward = pc.expected_cost_by_moments(c.problem, c.M, deployed=c.deployed)
    assert_close(pc.expected_cost(c.problem, c.M, deployed=c.deployed), forward, 1e-12, 1e-5)
