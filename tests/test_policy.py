"""The disturbance-action law: in steps, for a whole path, and its adjoint."""

import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.policy import feedforward, feedforward_adjoint, lagged
from tests.tools import assert_close, normal

H, m, n, T = 3, 2, 4, 5
M, W, X = normal(1, H, m, n), normal(2, T, n), normal(3, T + 1, n)


def test_lagged_noise_is_zero_before_time_zero():
    windows = np.asarray(lagged(W, H))
    assert windows.shape == (T + 1, H, n)
    for t in range(T + 1):
        for i in range(1, H + 1):
            assert_close(windows[t, i - 1], W[t - i] if t >= i else np.zeros(n), 0, 0)


@pytest.mark.float32
def test_feedforward_is_the_sum_over_lags():
    expected = np.zeros((T + 1, m))
    for t in range(T + 1):
        for i in range(1, min(H, t) + 1):
            expected[t] += np.asarray(M[i - 1]) @ np.asarray(W[t - i])
    assert_close(feedforward(M, W), expected, 1e-13, 1e-5)


@pytest.mark.float32
def test_feedforward_adjoint_is_its_adjoint():
    h = normal(4, T + 1, m)
    assert_close(jnp.sum(feedforward(M, W) * h), jnp.sum(M * feedforward_adjoint(h, W, H)), 1e-12, 1e-4)


@pytest.mark.parametrize("varying", [False, True], ids=["constant gain", "varying gain"])
def test_law_in_steps_equals_the_law_of_a_whole_path(varying):
    gain = normal(5, T + 1, m, n) if varying else normal(5, m, n)
    law = pc.DisturbanceAction(gain, M)
    memory, inputs = law.init(), []
    for t in range(T + 1):
        inputs.append(law.act(memory, X[t], t))
        if t < T:
            memory = law.observe(memory, W[t])
    fed_back = jnp.einsum("tmn,tn->tm", jnp.broadcast_to(gain, (T + 1, m, n)), X)
    assert_close(jnp.stack(inputs), feedforward(M, W) - fed_back, 1e-13)
