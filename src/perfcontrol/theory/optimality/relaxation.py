"""The least value of a convex quadratic on a feasible set, and on the part of it that one cell of the search covers.

Every bound is a dual one: for whatever multipliers the search ends with, what is returned lies below the least value.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from perfcontrol._programs import program
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response.projected import Projected
from perfcontrol.response.quadratic import Quadratic
from perfcontrol.sets import AbstractSet
from perfcontrol.theory.certificates.quadratic_form import Expansion
from perfcontrol.theory.derivatives import tangent_basis
from perfcontrol.theory.facts import nearest_to_zero

ROUNDING = 1e-12  # eigenvalues below it, relative to the largest, count as zero
ROUNDS = 60  # of bisection, and of the ascent in several multipliers


class Least(NamedTuple):
    """A lower bound, and the policy (p,) at which the relaxation takes it."""

    value: float
    M: np.ndarray


class OnAffine:
    """q(M) = cost + <gradient, M - base> + <M - base, hessian (M - base)>/2 on an affine set, along its directions."""

    def __init__(self, base: np.ndarray, basis: np.ndarray, form: Expansion):
        self.base, self.basis, self.cost = base, basis, float(form.cost)
        self.gradient = basis.T @ form.gradient
        self.hessian = basis.T @ ((form.hessian + form.hessian.T) / 2) @ basis
        values, self.vectors = np.linalg.eigh(self.hessian)
        self.values = np.maximum(values, 0)
        self.floor = ROUNDING * float(self.values.max(initial=np.finfo(float).tiny))

    @property
    def curvature(self) -> tuple[float, float]:
        """The smallest and the largest eigenvalue of the Hessian along the set."""
        return (float(self.values.min()), float(self.values.max())) if self.values.size else (0.0, 0.0)

    def least(self, slope: Any = 0.0, ridge: float = 0.0, center: Any = None) -> Least:
        """The least value of q(M) + <slope, M - base> + ridge ‖M - center‖²."""
        linear, constant = self.gradient + self.basis.T @ np.broadcast_to(slope, self.base.shape), self.cost
        if ridge:
            apart = self.base - center
            linear, constant = linear + 2 * ridge * self.basis.T @ apart, constant + ridge * float(apart @ apart)
        weights, along = self.values + 2 * ridge, self.vectors.T @ linear
        kept = weights > self.floor
        # Where the curvature vanishes so must the slope, since costs are bounded below; what is left of it is rounding.
        moved = -np.where(kept, along / np.where(kept, weights, 1), 0)
        value = constant + float(along @ moved) / 2
        return Least(value, self.base + self.basis @ (self.vectors @ moved))

    def on_box(self, rows: np.ndarray, low: np.ndarray, high: np.ndarray, enough: float) -> Least:
        """The least value where low ≤ rows (M - base) ≤ high, rows (d, p) orthonormal along the set: all directions
        but these are minimised over in closed form, and the faces of the box tried one by one."""
        along = rows @ self.basis
        d = len(along)
        across = np.linalg.svd(along)[2][d:]
        g, h = across @ self.gradient, across @ self.hessian @ across.T
        coupling = across @ self.hessian @ along.T
        inverse = np.linalg.pinv(h, rcond=ROUNDING, hermitian=True) if len(h) else h
        linear = along @ self.gradient - coupling.T @ inverse @ g
        matrix = along @ self.hessian @ along.T - coupling.T @ inverse @ coupling
        constant = self.cost - float(g @ inverse @ g) / 2
        s = _least_on_box((matrix + matrix.T) / 2, linear, low, high, self.floor)
        y = along.T @ s - across.T @ (inverse @ (g + coupling @ s))
        return Least(constant + float(linear @ s + s @ matrix @ s / 2), self.base + self.basis @ y)

    def on_halfspaces(self, normals: np.ndarray, offsets: np.ndarray, enough: float) -> Least:
        """A lower bound where normals (M - base) ≤ offsets, normals (c, p): a least distance problem in the metric of
        the Hessian, whose multipliers are nonnegative least squares (Lawson and Hanson)."""
        best = self.least()
        along = normals @ self.basis @ self.vectors
        roots = np.sqrt(np.maximum(self.values, 1e3 * self.floor))
        center = self.vectors.T @ self.gradient / roots  # x = roots * (vectorsᵀ y) + center has ‖x‖² / 2 = q + constant
        rows = -along / roots
        right = rows @ center - offsets
        from scipy.optimize import nnls  # inside: its import takes 0.2 s

        weights, _ = nnls(np.concatenate([rows.T, right[None]]), np.append(np.zeros(len(center)), 1.0))
        slack = 1 - float(right @ weights)
        # The multipliers; where no policy satisfies all (no slack is left), a ray along which the bound grows.
        for mu in [weights / slack] if slack > 1e-9 else [weights * 10.0**power for power in range(13)]:
            found = self.least(slope=normals.T @ mu)
            value = found.value - float(mu @ offsets)
            if value > best.value:
                best = Least(value, found.M)
            if best.value >= enough:
                break
        return best


def _least_on_box(matrix: np.ndarray, linear: np.ndarray, low: np.ndarray, high: np.ndarray, floor: float) -> Any:
    """The minimiser of a small convex quadratic on a box: the best among those of its faces."""
    best, found = np.inf, np.clip(np.zeros_like(low), low, high)
    for face in np.ndindex(*(3,) * len(low)):
        kind = np.asarray(face)
        s = np.where(kind == 1, low, np.where(kind == 2, high, 0.0))
        if not np.all(np.isfinite(s)):
            continue
        free = kind == 0
        if free.any():
            inner, right = matrix[np.ix_(free, free)], linear[free] + matrix[np.ix_(free, ~free)] @ s[~free]
            values, vectors = np.linalg.eigh(inner)
            kept = values > floor
            moved = -np.where(kept, vectors.T @ right / np.where(kept, values, 1), 0)
            s[free] = np.clip(vectors @ moved, low[free], high[free])
        value = float(linear @ s + s @ matrix @ s / 2)
        if value < best:
            best, found = value, s
    return found


class OnSet:
    """The same quadratic on any convex set, by projections."""

    def __init__(self, feasible_set: AbstractSet, shape: tuple[int, ...], base: np.ndarray, form: Expansion):
        self.feasible_set, self.shape, self.base = feasible_set, shape, base
        self.cost, self.gradient = float(form.cost), np.asarray(form.gradient)
        self.hessian = (form.hessian + form.hessian.T) / 2
        self.start = base
        values = np.linalg.eigvalsh(self.hessian)
        self.curvature = max(float(values[0]), 0.0), max(float(values[-1]), np.finfo(float).tiny)

    def least(self, slope: Any = 0.0, ridge: float = 0.0, center: Any = None) -> Least:
        """The least value of q(M) + <slope, M - base> + ridge ‖M - center‖², less what is left to prove."""
        hessian, linear, constant = self.hessian, self.gradient + slope, self.cost
        if ridge:
            apart = self.base - center
            hessian = hessian + 2 * ridge * np.eye(len(hessian))
            linear, constant = linear + 2 * ridge * apart, constant + ridge * float(apart @ apart)
        step = 1 / (self.curvature[1] + 2 * max(ridge, 0.0))
        at_zero = (linear - hessian @ self.base).reshape(self.shape)
        form = Quadratic(at_zero, np.asarray(step), hessian)
        M, _ = Projected(self.feasible_set, form).minimise(self.start.reshape(self.shape))
        M = np.asarray(M, dtype=float).reshape(-1)
        self.start, moved = M, M - self.base
        slope_there = linear + hessian @ moved
        value = constant + float(linear @ moved + moved @ hessian @ moved / 2)
        reach = support(self.feasible_set, -slope_there.reshape(self.shape))
        # q(M') ≥ q(M) + <∇q(M), M' - M>: on a set whose support is known, inexact minimisers still prove a bound.
        unproved = 0.0 if reach is None else max(float(reach) + float(slope_there @ M), 0.0)
        return Least(value - unproved, M)

    def on_box(self, rows: np.ndarray, low: np.ndarray, high: np.ndarray, enough: float) -> Least:
        """A lower bound where low ≤ rows (M - base) ≤ high."""
        sides = np.concatenate([rows, -rows]), np.concatenate([high, -low])
        finite = np.isfinite(sides[1])
        return self.on_halfspaces(sides[0][finite], sides[1][finite], enough)

    def on_halfspaces(self, normals: np.ndarray, offsets: np.ndarray, enough: float) -> Least:
        """A lower bound where normals (M - base) ≤ offsets, normals (c, p): the best dual value that an ascent in the
        multipliers meets, or the first above `enough`."""
        from scipy.optimize import minimize  # inside: its import takes 0.2 s

        best = self.least()
        excess = normals @ (best.M - self.base) - offsets
        if best.value >= enough or np.all(excess <= 0):
            return best
        # The curvature turns lengths into slopes: multipliers in such units are of order one.
        unit = max(self.curvature[1], np.finfo(float).tiny) * max(float(np.max(np.abs(excess))), 1e-300)

        class _Enough(Exception):
            pass

        def dual(multipliers: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal best
            mu = np.maximum(multipliers, 0) * unit
            found = self.least(slope=normals.T @ mu)
            value = found.value - float(mu @ offsets)
            if value > best.value:
                best = Least(value, found.M)
                if value >= enough:
                    raise _Enough
            slope = (normals @ (found.M - self.base) - offsets) * unit
            return -value, -slope

        try:
            bounds = [(0.0, None)] * len(offsets)
            options = {"maxiter": ROUNDS, "ftol": 1e-13, "gtol": 1e-12}
            minimize(dual, np.zeros(len(offsets)), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        except _Enough:
            pass
        return best


@program
def support(feasible_set: AbstractSet, directions: Any) -> Any:
    """sup <direction, M> over the set for each direction, or None."""
    return feasible_set.support(directions)


Relaxation = OnAffine | OnSet


def relaxation_of(problem: PerformativeProblem) -> Callable[[Expansion], Relaxation]:
    """How convex quadratics about the policy nearest to zero are minimised on the feasible set."""
    base = np.asarray(nearest_to_zero(problem), dtype=float).reshape(-1)
    if problem.feasible_set.affine:
        basis = tangent_basis(problem)
        return lambda form: OnAffine(base, basis, form)
    return lambda form: OnSet(problem.feasible_set, problem.policy_shape, base, form)


def on_shell(relaxation: Relaxation, center: np.ndarray, near: float, far: float) -> Least:
    """A lower bound where near ≤ ‖M - center‖ ≤ far, though that is not convex: with one quadratic side, weights of
    either sign that keep the sum convex prove one."""
    best = relaxation.least()
    radius = float(np.linalg.norm(best.M - center))
    if near <= radius <= far:
        return best
    limit = far if radius > far else near
    smallest, largest = relaxation.curvature

    def dual(ridge: float) -> float:
        """The bound of this weight joins; whether the radius is still above the limit is returned as its excess."""
        nonlocal best
        found = relaxation.least(ridge=ridge, center=center)
        value = found.value - ridge * limit**2
        if value > best.value:
            best = Least(value, found.M)
        return float(np.linalg.norm(found.M - center)) - limit

    if radius > far:
        low, high = 0.0, 1e-3 * largest
        while dual(high) > 0 and high < 1e12 * largest:
            low, high = high, 10 * high
    else:
        low, high = -smallest / 2 * (1 - 1e-9), 0.0
        if smallest <= 1e-9 * largest or dual(low) < 0:  # the weight can do no more
            return best
    for _ in range(ROUNDS):
        middle = (low + high) / 2
        excess = dual(middle)
        low, high = (middle, high) if excess > 0 else (low, middle)
        if abs(excess) <= 1e-9 * limit:
            break
    return best
