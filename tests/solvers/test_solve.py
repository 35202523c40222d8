"""The loop that every solver runs in, tested on a random walk that needs no problem."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.solvers.base import State, start
from perfcontrol.solvers.runs import CHUNK
from tests.solvers.problems import performative_prediction
from tests.tools import assert_close

PROBLEM = performative_prediction(0.5)
KEY = jax.random.key(3)
LONG = 2 * CHUNK + 207  # neither a multiple of the chunk nor of the record intervals below


class Walk(pc.AbstractSolver):
    """M_{n+1} = M_n + a normal number; ends with `outcome` at step `last`."""

    length: int = eqx.field(static=True)
    last: int = eqx.field(static=True, default=10**9)
    outcome: pc.Result = eqx.field(default_factory=lambda: pc.Result.success)

    @property
    def max_steps(self):
        return self.length

    @property
    def needs_key(self):
        return True

    def check(self, problem):
        pass

    def init(self, problem, M0):
        return start(M0)

    def step(self, problem, state, key):
        ended = state.steps + 1 == self.last
        result = pc.Result.where(ended, self.outcome, pc.Result.running)
        return State(state.M + jax.random.normal(key, state.M.shape, state.M.dtype), state.steps + 1, result, None)

    def finish(self, problem, state, stopped):
        unfinished = pc.Result.running if stopped else pc.Result.not_converged
        result = pc.Result.where(state.result == pc.Result.running, unfinished, state.result)
        return result, {"final": jnp.sum(state.M)}


@pytest.fixture(scope="module")
def path() -> np.ndarray:
    """The walk by hand: iteration n draws from fold_in(key, n)."""
    draws = jax.vmap(lambda n: jax.random.normal(jax.random.fold_in(KEY, n), (1, 1, 1)))(jnp.arange(LONG))
    return np.concatenate([np.zeros((1, 1, 1, 1)), np.cumsum(np.asarray(draws, dtype=float), axis=0)])


@pytest.mark.float32
@pytest.mark.parametrize("every", [1, 7, 600])
def test_history_holds_every_recorded_iterate_when_run_in_several_chunks(path, every):
    solution = pc.solve(PROBLEM, Walk(LONG), key=KEY, every=every, throw=False)
    assert solution.history.shape == (LONG // every + 1, 1, 1, 1)
    assert_close(solution.history, path[: LONG + 1 : every], 1e-12, 1e-4)
    assert_close(solution.M, path[LONG], 1e-12, 1e-4)
    assert int(solution.steps) == LONG
    assert_close(solution.stats["final"], path[LONG].sum(), 1e-12, 1e-4)


@pytest.mark.parametrize("last", [3, CHUNK, CHUNK + 100])
@pytest.mark.parametrize("every", [1, 7])
def test_history_repeats_the_last_value_when_the_run_ends_early(path, last, every):
    solver = Walk(LONG, last)
    on_host = pc.solve(PROBLEM, solver, key=KEY, every=every)
    expected = path[np.minimum(np.arange(0, LONG + 1, every), last)]
    assert on_host.result == pc.Result.success and int(on_host.steps) == last
    assert_close(on_host.M, path[last])
    assert on_host.history.shape == expected.shape
    assert_close(on_host.history, expected)
    traced = jax.jit(lambda key: pc.solve(PROBLEM, solver, key=key, every=every))(KEY)
    assert traced.history.shape == expected.shape
    assert_close(traced.history, expected)


def test_history_is_a_pytree_when_the_record_is_one(path):
    def record(M):
        return {"square": M[0, 0, 0] ** 2, "parts": (M, M.sum() > 0)}

    history = pc.solve(PROBLEM, Walk(9), key=KEY, record=record, throw=False).history
    assert_close(history["square"], path[:10, 0, 0, 0] ** 2)
    assert history["parts"][0].shape == (10, 1, 1, 1)
    np.testing.assert_array_equal(history["parts"][1], path[:10, 0, 0, 0] > 0)


def test_solve_takes_more_steps_than_the_solver_asks_when_max_steps_says_so(path):
    assert_close(pc.solve(PROBLEM, Walk(4), key=KEY, max_steps=9, throw=False).M, path[9])


def test_solve_reports_progress_after_each_chunk():
    seen = []
    pc.solve(PROBLEM, Walk(LONG), key=KEY, throw=False, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(CHUNK, LONG), (2 * CHUNK, LONG), (LONG, LONG)]


def test_solve_ends_after_the_chunk_in_which_the_run_ended():
    seen = []
    pc.solve(PROBLEM, Walk(LONG, 3), key=KEY, progress=lambda done, total: seen.append(done))
    assert seen == [CHUNK]


@pytest.mark.parametrize("outcome", [pc.Result.diverged, pc.Result.nonfinite], ids=["diverged", "nonfinite"])
def test_solve_raises_with_the_solution_when_the_run_failed(path, outcome):
    with pytest.raises(pc.SolveError) as caught:
        pc.solve(PROBLEM, Walk(20, 7, outcome), key=KEY)
    assert pc.Result[outcome] in str(caught.value) and "step 7" in str(caught.value)
    assert_close(caught.value.solution.M, path[7])
    assert caught.value.solution.result == outcome
    assert pc.solve(PROBLEM, Walk(20, 7, outcome), key=KEY, throw=False).result == outcome


def test_solve_tells_a_run_cut_short_from_one_that_did_not_converge():
    assert pc.solve(PROBLEM, Walk(20, 30), key=KEY, throw=False).result == pc.Result.not_converged
    assert pc.solve(PROBLEM, Walk(20, 15), key=KEY, max_steps=10, throw=False).result == pc.Result.running


def test_solve_never_raises_under_jit():
    solver = Walk(20, 7, pc.Result.diverged)
    assert jax.jit(lambda key: pc.solve(PROBLEM, solver, key=key))(KEY).result == pc.Result.diverged


def test_solve_maps_over_keys_alone(path):
    keys = jax.random.split(KEY, 3)
    together = jax.vmap(lambda key: pc.solve(PROBLEM, Walk(20), key=key))(keys)
    for i in range(3):
        assert_close(together.history[i], pc.solve(PROBLEM, Walk(20), key=keys[i], throw=False).history)


def test_solve_maps_over_starts_alone(path):
    starts = jnp.asarray([0.0, 2.0])[:, None, None, None]
    together = jax.vmap(lambda M0: pc.solve(PROBLEM, Walk(9), M0, key=KEY))(starts)
    assert_close(together.M[1] - together.M[0], np.full((1, 1, 1), 2.0))


def test_solve_accepts_raw_keys():
    raw = jax.random.PRNGKey(5)
    expected = jax.random.normal(jax.random.fold_in(raw, 0), (1, 1, 1))
    assert_close(pc.solve(PROBLEM, Walk(1), key=raw, throw=False).M, expected)


def test_results_say_what_to_do():
    for result in (pc.Result.running, pc.Result.diverged, pc.Result.nonfinite, pc.Result.not_converged):
        assert len(pc.Result[result]) > 40
