import jax
import jax.numpy as jnp

import perfcontrol as pc
from tests.contracts.perturbation import PerturbationContract
from tests.tools import assert_close


class TestNoPerturbation(PerturbationContract):
    samples = 10

    def perturbation(self):
        return pc.NoPerturbation()


def test_no_perturbation_is_zero_in_every_respect():
    law, M = pc.NoPerturbation(), jnp.ones((2, 2, 3))
    assert_close(law.sample(jax.random.key(0), M, 4).dense(), jnp.zeros((4, 3, 3)), 0, 0)
    assert_close(law.mean(M, 4), jnp.zeros((4, 3, 3)), 0, 0)
    assert_close(law.covariance(M, 4).apply(jnp.eye(3)), jnp.zeros((4, 3, 3)), 0, 0)
    assert_close(law.bound(None, 4), jnp.zeros(4), 0, 0)
    assert_close(law.sensitivity(None, 4), jnp.zeros(4), 0, 0)
