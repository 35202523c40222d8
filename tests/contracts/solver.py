"""What every solver must do, whatever its method."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.solvers.problems import drifting
from tests.tools import assert_close, assert_refused


class SolverContract:
    """Inherit and define `solver`; it must end within its own max_steps on the problems below."""

    close = (1e-11, 2e-4)  # relative, of runs compiled differently: in float64, in float32

    def solver(self) -> pc.AbstractSolver:
        """The solver under test."""
        raise NotImplementedError

    def problem(self, seed: int) -> pc.PerformativeProblem:
        """Problems of equal shape."""
        return drifting(seed)

    def key(self, seed: int) -> jax.Array | None:
        return jax.random.key(seed)

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def _shared(cls):
        """The problems and their single solutions, shared by the class."""
        suite = cls()
        cls.problems = [suite.problem(seed) for seed in (0, 10, 20)]
        cls.singles = [pc.solve(problem, suite.solver(), key=suite.key(i)) for i, problem in enumerate(cls.problems)]

    @pytest.mark.float32
    def test_solution_is_complete_and_finite(self):
        for problem, solution in zip(self.problems, self.singles, strict=True):
            assert solution.result == pc.Result.success
            assert solution.M.shape == problem.policy_shape and solution.M.dtype == problem.dtype
            assert 0 < int(solution.steps) <= self.solver().max_steps
            assert solution.history.shape == (self.solver().max_steps + 1, *problem.policy_shape)
            assert bool(jnp.all(jnp.isfinite(solution.history)))
            np.testing.assert_array_equal(solution.history[0], problem.initial_policy())
            np.testing.assert_array_equal(solution.history[-1], solution.M)

    @pytest.mark.float32
    def test_solution_repeats_bit_for_bit_under_the_same_key(self):
        again = pc.solve(self.problems[0], self.solver(), key=self.key(0))
        for value, reference in zip(jax.tree.leaves(again), jax.tree.leaves(self.singles[0]), strict=True):
            np.testing.assert_array_equal(value, reference)

    def test_solve_compiles_nothing_for_other_problems_starts_and_keys_of_the_same_shapes(self):
        compiled = []
        jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compiled.append(event))
        start = self.problems[1].feasible_set.project(self.singles[0].M)
        for i in range(2):  # the second time around, nothing of the test's own is new either
            compiled.clear()
            pc.solve(self.problems[1 + i], self.solver(), start, key=self.key(5 + i))
        assert not [event for event in compiled if "backend_compile" in event]

    def test_history_keeps_the_record_of_every_other_step(self):
        def record(M):
            return {"policy": M, "norm": jnp.linalg.norm(M)}

        first = pc.solve(self.problems[0], self.solver(), key=self.key(0), record=record, every=2)
        expected = self.singles[0].history[: 2 * (self.solver().max_steps // 2) + 1 : 2]
        assert first.history["norm"].shape == (self.solver().max_steps // 2 + 1,)
        assert_close(first.history["policy"], expected, *self.close)
        assert_close(first.history["norm"], jnp.sqrt(jnp.sum(expected**2, axis=(1, 2, 3))), *self.close)
        assert_close(first.M, self.singles[0].M, *self.close)

    @pytest.mark.float32
    def test_solutions_of_stacked_problems_and_keys_equal_single_runs(self):
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *self.problems)
        keys = jnp.stack([self.key(i) for i in range(3)])
        together = jax.jit(jax.vmap(lambda problem, key: pc.solve(problem, self.solver(), key=key)))(stacked, keys)
        for i, single in enumerate(self.singles):
            self.assert_same(jax.tree.map(lambda leaf, i=i: leaf[i], together), single)

    result_when_stopped = pc.Result.running

    def test_solution_is_the_start_when_no_step_is_allowed(self):
        start = self.singles[1].M
        solution = pc.solve(self.problems[0], self.solver(), start, key=self.key(0), max_steps=0, throw=False)
        assert solution.result == self.result_when_stopped
        assert int(solution.steps) == 0 and solution.history.shape[0] == 1
        np.testing.assert_array_equal(solution.M, start)

    def test_solver_refuses_what_does_not_fit(self):
        problem, solver, key = self.problems[0], self.solver(), self.key(0)
        assert_refused(lambda: pc.solve(problem, solver, jnp.zeros((2, 3, 2)), key=key), "M0", "(2, 2, 3)", "swapped")
        assert_refused(lambda: pc.solve(problem, solver, jnp.full((2, 2, 3), jnp.nan), key=key), "M0", "finite")
        assert_refused(lambda: pc.solve(problem, solver, key=key, every=0), "every", "at least 1")
        assert_refused(lambda: pc.solve(problem, solver, key=key, max_steps=1.5), "max_steps", "integer")
        assert_refused(lambda: pc.solve(problem, solver, key=3), "key", "jax.random.key(3)")
        assert_refused(lambda: pc.solve(solver, problem, key=key), "problem", "PerformativeProblem")
        assert_refused(lambda: pc.solve(problem, type(solver), key=key), "solver", "be a solver")

    def test_solver_refuses_an_infeasible_start(self):
        problem = drifting(0, pc.FrobeniusBall(1.0))
        start = jnp.zeros((2, 2, 3)).at[0, 0, 0].set(3.0)
        assert_refused(lambda: pc.solve(problem, self.solver(), start, key=self.key(0)), "M0", "2 away", "feasible")

    def assert_same(self, solution: pc.Solution, reference: pc.Solution) -> None:
        assert solution.result == reference.result
        assert int(solution.steps) == int(reference.steps)
        assert_close(solution.M, reference.M, *self.close)
        assert_close(solution.history, reference.history, *self.close)
        assert solution.stats.keys() == reference.stats.keys()
