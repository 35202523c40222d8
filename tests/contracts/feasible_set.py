"""What every feasible set must do; CVXPY is the independent judge of projections and support functions."""

import functools

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tools import assert_close, normal, tolerance

SCALES = (0.1, 1.0, 10.0)  # of the points projected: inside, around and far outside the set


class SetContract:
    """Inherit, define `feasible_set`, and `constraints` in CVXPY."""

    shape = (2, 2, 3)  # (memory, input, state)
    projection_tolerance = 1e-11  # of feasibility and of the variational inequality, relative, in float64
    support_tolerance = 1e-13  # relative: rounding where the support function is a formula
    sharp = True  # whether support function and radius are the suprema, not upper bounds of them
    measured = True  # whether the farthest point and the distance are exact, not bounds
    differentiable = True  # whether the derivative of the projection is the true one at generic points

    def feasible_set(self):
        """The set under test, fit for policies of `shape`."""
        raise NotImplementedError

    def constraints(self, M: list) -> list:
        """The set as CVXPY constraints on the lags, a list of `memory` variables (input, state)."""
        raise NotImplementedError

    def close(self) -> float:
        return tolerance(self.projection_tolerance, max(1e-5, self.projection_tolerance))

    @classmethod
    @functools.cache
    def projection(cls):
        """The compiled projection of a batch of points."""
        feasible_set = cls().feasible_set()
        return jax.jit(jax.vmap(lambda M: feasible_set.project(M)))

    @classmethod
    @functools.cache
    def projected(cls) -> tuple[np.ndarray, np.ndarray]:
        """Points to project, (9, *shape), a third of them at each scale, and their projections."""
        points = jnp.concatenate([scale * normal(11 + i, 3, *cls.shape) for i, scale in enumerate(SCALES)])
        return np.asarray(points), np.asarray(cls.projection()(points))

    def cvxpy_solve(self, objective) -> tuple[float, np.ndarray, str]:
        """Value, minimiser and status of an objective of the lags over the set."""
        M = [cp.Variable(self.shape[1:]) for _ in range(self.shape[0])]
        problem = cp.Problem(objective(M), self.constraints(M))
        problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
        values = [np.full(self.shape[1:], np.nan) if lag.value is None else lag.value for lag in M]
        return problem.value, np.stack(values), problem.status

    @pytest.mark.float32
    def test_projection_is_feasible_and_idempotent(self):
        feasible_set = self.feasible_set()
        feasible_set.check(self.shape)
        _, projected = self.projected()
        assert_close(self.projection()(projected), projected, self.close(), self.close())
        assert bool(feasible_set.contains(jnp.asarray(projected[4]), max(1e-8, 10 * self.close())))

    @pytest.mark.float32
    def test_projection_satisfies_the_variational_inequality(self):
        """<M - P(M), Z - P(M)> ≤ 0 for every Z of the set."""
        points, projected = self.projected()
        for M, P in zip(points, projected, strict=True):
            gaps = np.einsum("himn,imn->h", projected - P, M - P)
            size = 1 + np.abs(M).max() * max(np.abs(M).max(), np.abs(projected - P).max()) * M.size
            assert gaps.max() <= self.close() * size

    @pytest.mark.float32
    def test_projection_is_nonexpansive(self):
        points, projected = self.projected()
        for i in range(len(points)):
            moved = np.linalg.norm((projected - projected[i]).reshape(len(points), -1), axis=1)
            apart = np.linalg.norm((points - points[i]).reshape(len(points), -1), axis=1)
            assert np.all(moved <= apart * (1 + self.close()) + self.close())

    @pytest.mark.parametrize("index", [0, 3, 6])
    def test_projection_matches_cvxpy(self, index):
        points, projected = self.projected()
        target = points[index]

        def objective(M):
            return cp.Minimize(sum(cp.sum_squares(lag - target[i]) for i, lag in enumerate(M)))

        _, nearest, status = self.cvxpy_solve(objective)
        assert status in {cp.OPTIMAL, cp.OPTIMAL_INACCURATE}
        np.testing.assert_allclose(projected[index], nearest, atol=2e-6 * max(1.0, np.abs(target).max()))

    def test_support_matches_cvxpy(self):
        feasible_set = self.feasible_set()
        direction = np.asarray(normal(21, *self.shape))
        support = feasible_set.support(jnp.asarray(direction))

        def objective(M):
            return cp.Maximize(sum(cp.sum(cp.multiply(direction[i], lag)) for i, lag in enumerate(M)))

        value, _, status = self.cvxpy_solve(objective)
        if support is None:
            assert status not in {cp.OPTIMAL, cp.OPTIMAL_INACCURATE}, "a finite support function is left out"
        elif not self.sharp:
            assert float(support) >= value * (1 - 1e-6) - 1e-6
        else:
            assert float(support) == pytest.approx(value, rel=1e-6, abs=1e-6)

    def test_support_is_never_exceeded_and_takes_leading_axes(self):
        feasible_set = self.feasible_set()
        directions = normal(22, 4, 2, *self.shape)
        support = feasible_set.support(directions)
        if support is None:
            pytest.skip("unbounded set")
        assert support.shape == (4, 2)
        assert_close(support[1, 1], feasible_set.support(directions[1, 1]), self.support_tolerance)
        _, projected = self.projected()
        values = np.einsum("abimn,himn->abh", np.asarray(directions), projected)
        assert np.all(values.max(axis=-1) <= np.asarray(support) + 1e2 * self.close() * np.abs(values).max())

    def test_radius_is_never_exceeded(self):
        radius = self.feasible_set().radius(self.shape)
        if radius is None:
            pytest.skip("radius unknown")
        _, projected = self.projected()
        norms = np.linalg.norm(projected.reshape(len(projected), -1), axis=1)
        assert norms.max() <= float(radius) * (1 + self.close()) + self.close()

    def test_bounded_sets_know_support_radius_and_farthest_point(self):
        feasible_set = self.feasible_set()
        unbounded = feasible_set.support(normal(21, *self.shape)) is None
        assert unbounded == (feasible_set.radius(self.shape) is None)
        assert unbounded == (feasible_set.farthest(normal(21, *self.shape)) is None)
        if not unbounded:
            assert_close(feasible_set.farthest(jnp.zeros(self.shape)), feasible_set.radius(self.shape))

    @pytest.mark.parametrize("scale", SCALES)
    def test_farthest_and_distance_bound_what_is_found_and_are_reached_where_they_are_sharp(self, scale):
        """Far steps away from the center, from zero or the middle of the set, end in its farthest points."""
        feasible_set, center = self.feasible_set(), scale * np.asarray(normal(24, *self.shape))
        points, projected = self.projected()
        corners = [np.asarray(self.projection()(sign * 1e4 * points)) for sign in (1.0, -1.0)]
        starts = np.concatenate([projected[:7], 0 * projected[:1], np.mean(corners, axis=(0, 1))[None]])
        far = [np.asarray(self.projection()(center + 1e4 * (starts - center)))]
        far.append(np.asarray(self.projection()(center + 1e4 * (far[0] - center))))
        found = np.concatenate([*corners, projected, *far, self.projection()(np.repeat(center[None], 9, axis=0))])
        lengths = np.linalg.norm((found - center).reshape(len(found), -1), axis=1)
        farthest, distance = (getattr(feasible_set, name)(jnp.asarray(center)) for name in ("farthest", "distance"))
        slack = 10 * self.close() * (1 + lengths.min())
        assert float(distance) <= lengths.min() + slack
        assert not self.measured or float(distance) >= lengths.min() - slack
        if farthest is not None:
            assert lengths.max() <= float(farthest) + slack
            assert not self.measured or lengths.max() >= float(farthest) * (1 - 1e-6)

    def test_projection_is_affine_where_the_set_is_said_to_be(self):
        points, projected = self.projected()
        if not self.feasible_set().affine:
            pytest.skip("not said to be affine")
        outside = self.projection()(3 * points - 2 * points[::-1])
        assert_close(outside, 3 * projected - 2 * projected[::-1], self.close())

    def test_row_totals_and_signs_hold_where_claimed(self):
        feasible_set = self.feasible_set()
        _, projected = self.projected()
        if feasible_set.row_total is not None:
            sums = projected.sum(axis=-1)
            size = 1 + np.abs(projected).max()
            np.testing.assert_allclose(sums, np.broadcast_to(feasible_set.row_total, sums.shape), atol=1e-12 * size)
        if feasible_set.nonnegative:
            assert projected.min() >= 0

    def test_contains_refuses_points_that_projection_moves(self):
        feasible_set = self.feasible_set()
        M, P = (some[8] for some in self.projected())
        if np.linalg.norm(M - P) > 1e-3 * max(1.0, np.linalg.norm(M)):
            assert not bool(feasible_set.contains(jnp.asarray(M)))

    def test_projection_derivative_matches_central_differences(self):
        if not self.differentiable:
            pytest.skip("no derivative promised")
        feasible_set = self.feasible_set()
        points, step = np.append(self.projected()[0], np.zeros((1, *self.shape)), axis=0), 1e-6
        V = np.asarray(normal(23, *self.shape))
        derivative = jax.jit(jax.vmap(lambda M: jax.jvp(lambda M: feasible_set.project(M), (M,), (jnp.asarray(V),))[1]))
        slopes = derivative(points)
        assert np.all(np.isfinite(slopes))
        ahead, behind = (np.asarray(self.projection()((points + h * V)[:9])) for h in (step, -step))
        np.testing.assert_allclose(slopes[:9], (ahead - behind) / (2 * step), atol=1e-6)
