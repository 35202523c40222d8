"""Code that is written once for known and for traced numbers does the same with both."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from perfcontrol import _programs
from perfcontrol._programs import choose, cond, known, numerics, program, while_loop


def count_traces(function):
    """`function` as a program, and the list that grows by one whenever it is traced."""
    traces = []

    def counted(*arguments):
        traces.append(len(traces))
        return function(*arguments)

    return program(counted), traces


def test_program_compiles_once_for_equal_kinds_of_arguments_and_again_for_other_shapes():
    double, traces = count_traces(lambda x, power: x**power + jnp.arange(2).sum())
    for value in (1.0, 2.0, 3.0):
        np.testing.assert_allclose(double(np.full(3, value), 2), value**2 + 1)
    assert len(traces) == 1
    double(np.ones(4), 2)
    double(np.ones(3), 3)
    assert len(traces) == 3


def test_program_gives_numpy_arrays_for_known_numbers_and_traced_ones_inside_a_trace():
    plain = program(lambda x: {"sum": jnp.sum(x)})
    assert isinstance(plain(jnp.ones(3))["sum"], np.ndarray)
    assert isinstance(program(lambda x: x + 1, on_device=True)(np.ones(2)), jax.Array)
    seen = []

    @jax.jit
    def outer(x):
        seen.append(known(plain(x)))
        return plain(x)["sum"]

    assert float(outer(jnp.ones(3))) == 3.0 and seen == [False]


def test_program_keeps_known_numbers_known_inside_somebody_elses_trace():
    seen = []

    @jax.jit
    def outer(x):
        value = program(lambda y: jnp.sum(y) + jnp.arange(3)[1])(np.ones(2))
        seen.append(known(value))
        return x + value

    assert float(outer(1.0)) == 4.0 and seen == [True]


def test_program_differentiates_and_maps_where_its_arguments_are_traced():
    square = program(lambda x: jnp.sum(x**2))
    np.testing.assert_allclose(jax.grad(square)(jnp.arange(3.0)), [0.0, 2.0, 4.0])
    np.testing.assert_allclose(jax.vmap(square)(jnp.ones((2, 3))), [3.0, 3.0])


def test_program_compiles_without_options_that_this_version_of_xla_does_not_know(monkeypatch):
    monkeypatch.setattr(_programs, "QUICK", {"xla_no_such_option": True})
    _programs.compiler_options.cache_clear()
    try:
        assert _programs.compiler_options() == {}
        assert float(program(lambda x: 2 * x)(np.ones(()))) == 2.0
    finally:
        _programs.compiler_options.cache_clear()


def test_program_raises_what_its_function_raises():
    def refuse(x):
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        program(refuse)(np.ones(2))


def collatz(n, counter):
    """Steps until 1, by the three controls at once."""
    xp, _ = numerics(n)

    def body(carry):
        n, count = carry
        following = choose(n % 2 == 0, n // 2, 3 * n + 1)
        return cond(n > 1, lambda: following, lambda: n), count + 1

    return while_loop(lambda carry: carry[0] > 1, body, (n, xp.zeros_like(n) + counter))[1]


@pytest.mark.parametrize("n, steps", [(1, 0), (6, 8), (27, 111)])
def test_control_flow_is_the_same_from_the_host_and_inside_a_program(n, steps):
    assert int(collatz(np.asarray(n), 0)) == steps
    assert int(jax.jit(collatz)(n, 0)) == steps
