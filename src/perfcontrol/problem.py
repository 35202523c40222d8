"""The performative control problem: everything that the world is, checked together once."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import (
    as_array,
    check_instance,
    check_integer,
    check_shape,
    check_time_varying,
    fail,
    is_concrete,
    varies,
)
from perfcontrol._functions import call
from perfcontrol._linalg import Matrix, along_time
from perfcontrol._printing import Printed, Row, of_problem
from perfcontrol.costs import AbstractCost
from perfcontrol.perturbations import AbstractPerturbation, NoPerturbation, fitted_perturbation
from perfcontrol.policy_maps import AbstractPolicyMap, as_policy_map
from perfcontrol.random_vectors import AbstractRandomVector, Constant, Sequence, fitted_vector
from perfcontrol.sets import AbstractSet, AbstractStructure, FullStructure, LiftedSet, Unconstrained
from perfcontrol.systems import LinearSystem, warn_of_growth


class PerformativeProblem(Printed, eqx.Module):
    """A linear system whose perturbations react to the deployed disturbance-action policy.

    x_{t+1} = A_t x_t + B_t u_t + Δ_t z_t + w_t for t = 0..T-1, Δ_t ~ D_t(deployed policy), z = x (or [x; u]);

    u_t = -K_t x_t + Σ_{i=1..memory} M[i-1] w_{t-i};

    C_T(M; M') = E Σ_{t=0..T} c_t(x_t, u_t), or lim C_T(M; M') / T where the horizon is infinite.

    Args:
        system: A_t and B_t.
        horizon: T ≥ 1; stages t = 0..T are summed, the terminal one included. Or `math.inf`: nothing may vary in time,
            and costs are averages per stage in the long run, on which x_0 has no influence.
        noise: law of w_t, dimension n; or a policy map (a callable, `pc.Function`) from the lifted deployed policy to
            such a law.
        cost: the stage cost.
        memory: H, 1 ≤ H < T.
        gain: K, (m, n) or (T+1, m, n); 0 for none. Sign: u = -K x.
        perturbation: the law D_t(M).
        feasible_set: of the free policy parameters.
        initial_state: law of x_0, or a vector (n,), or 0.
        structure: linear map from free parameters to the full policy.

    Raises:
        InputError: anything that does not fit, before any work.

    A policy passed to the package's functions is the free parameters, shape `policy_shape`: (memory, m, n) unless
    structured. `lift` gives the full policy, which perturbations and policy maps receive.
    """

    system: LinearSystem
    noise: AbstractRandomVector | AbstractPolicyMap
    cost: AbstractCost
    gain: Array
    perturbation: AbstractPerturbation
    feasible_set: AbstractSet
    initial_state: AbstractRandomVector
    structure: AbstractStructure
    horizon: Any = eqx.field(static=True)  # an integer, or math.inf
    memory: int = eqx.field(static=True)
    has_gain: bool = eqx.field(static=True)  # False: K = 0 for certain, and no product with it is computed

    def __init__(
        self,
        *,
        system: LinearSystem,
        horizon: int | float,
        noise: AbstractRandomVector | Callable[[Array], AbstractRandomVector],
        cost: AbstractCost,
        memory: int = 1,
        gain: Any = 0,
        perturbation: AbstractPerturbation | None = None,
        feasible_set: AbstractSet | None = None,
        initial_state: Any = 0,
        structure: AbstractStructure | None = None,
    ):
        self.system = check_instance("system", system, LinearSystem, "pc.LinearSystem(A, B)")
        self.cost = check_instance("cost", cost, AbstractCost, "pc.QuadraticCost(Q, R)")
        self.perturbation = check_instance(
            "perturbation",
            NoPerturbation() if perturbation is None else perturbation,
            AbstractPerturbation,
            "pc.DirectionalPerturbation(directions, scale)",
        )
        self.feasible_set = check_instance(
            "feasible_set",
            Unconstrained() if feasible_set is None else feasible_set,
            AbstractSet,
            "pc.FrobeniusBall(1.0)",
        )
        self.structure = check_instance(
            "structure", FullStructure() if structure is None else structure, AbstractStructure, "pc.RepeatedBlock(2)"
        )
        n, m = system.state_size, system.input_size
        self.horizon = math.inf if horizon == math.inf else check_integer("horizon", horizon, 1)
        self.memory = check_integer("memory", memory, 1)
        if self.memory >= self.horizon:
            raise fail(
                "memory",
                str(self.memory),
                f"be below the horizon {self.horizon}",
                "Shorten the memory or lengthen the horizon.",
            )
        if not self.is_finite and system.horizon is not None:
            raise varies("system", f"matrices for {system.horizon} time steps")
        if system.horizon not in (None, self.horizon):
            raise fail(
                "horizon",
                str(self.horizon),
                f"match the {system.horizon} time steps of the system",
                f"Pass horizon={system.horizon}: A_t and B_t are given for t = 0..horizon-1.",
            )
        reacting_noise = callable(noise) and not isinstance(noise, AbstractRandomVector | type)
        self.noise = as_policy_map("noise", noise) if reacting_noise else fitted_vector("noise", noise, n, self.horizon)
        if isinstance(initial_state, Sequence):
            raise fail("initial_state", "a Sequence", "be one random vector", "Pass an array (n,) or another law.")
        if not isinstance(initial_state, AbstractRandomVector | type):
            initial_state = Constant(initial_state)
        self.initial_state = fitted_vector("initial_state", initial_state, n, self.horizon)
        if self.initial_state.mean.ndim == 2:
            raise fail("initial_state", "a law that varies in time", "be one random vector", "Pass one vector (n,).")
        self.has_gain = not (isinstance(gain, int | float) and gain == 0)
        gain_array = as_array("gain", gain)
        if gain_array.ndim == 0:
            gain_array = jnp.broadcast_to(gain_array, (m, n)) if m == n == 1 else _zero_gain(gain_array, m, n)
        check_time_varying("gain", gain_array, (m, n), ("m", "n"), self.horizon + 1, "T+1")
        self.gain = gain_array
        self.cost.check(n, m, self.horizon)
        self.perturbation = fitted_perturbation(self.perturbation, self.lifted_shape, self.horizon)
        self.feasible_set.check(self.policy_shape)
        if reacting_noise:
            self._check_reacting_noise()

    def _check_reacting_noise(self) -> None:
        """Build the noise law once at a feasible policy, where values are known, else look at shapes alone."""
        policy = jax.ShapeDtypeStruct(self.lifted_shape, self.dtype)

        def moments(M: Array) -> tuple[Array, Array]:
            law = fitted_vector("noise", call("noise", self.noise, M=M), self.state_size, self.horizon)  # type: ignore[arg-type]
            return law.mean, law.covariance

        jax.eval_shape(moments, policy)
        if is_concrete(self.system.A):
            moments(self.structure.lift(self.initial_policy()))

    def noise_under(self, deployed: Array) -> AbstractRandomVector:
        """The law of w_t in the world that reacts to the lifted policy `deployed`."""
        if isinstance(self.noise, AbstractRandomVector):
            return self.noise
        return call("noise", self.noise, M=deployed).resize(self.state_size)

    def described(self) -> tuple[str, list[Row]]:
        return of_problem(self)

    @property
    def noise_reacts(self) -> bool:
        """Whether the law of the noise depends on the deployed policy."""
        return not isinstance(self.noise, AbstractRandomVector)

    @property
    def is_finite(self) -> bool:
        """Whether the horizon is."""
        return self.horizon != math.inf

    @property
    def steps(self) -> int:
        """Time steps for which laws and gains are asked: T, or 1 where the horizon is infinite and all are alike."""
        return self.horizon if self.is_finite else 1

    def truncated(self, horizon: int) -> "PerformativeProblem":
        """The same problem over a finite horizon T, costs summed over its T+1 stages.

        Args:
            horizon: T > memory.

        Raises:
            InputError: an integer is needed; data that vary in time fit no other horizon than their own.
        """
        same = ("system", "noise", "cost", "memory", "perturbation", "feasible_set", "initial_state", "structure")
        parts: dict[str, Any] = {name: getattr(self, name) for name in same}
        horizon = check_integer("horizon", horizon, 1)
        return PerformativeProblem(horizon=horizon, gain=self.gain if self.has_gain else 0, **parts)

    @property
    def state_size(self) -> int:
        """n."""
        return self.system.state_size

    @property
    def input_size(self) -> int:
        """m."""
        return self.system.input_size

    @property
    def lifted_shape(self) -> tuple[int, int, int]:
        """Shape (memory, m, n) of the full policy."""
        return self.memory, self.input_size, self.state_size

    @property
    def policy_shape(self) -> tuple[int, int, int]:
        """Shape of the free parameters."""
        return self.structure.free_shape(self.lifted_shape)

    @property
    def dtype(self) -> Any:
        """The floating-point type of the computation."""
        types = {leaf.dtype for leaf in jax.tree.leaves(self) if eqx.is_inexact_array(leaf)}
        return types.pop() if len(types) == 1 else jnp.result_type(*types)

    def lift(self, M: Any) -> Array:
        """The full policy (memory, m, n) of free parameters M."""
        return self.structure.lift(self.check_policy("M", M))

    def check_policy(self, name: str, M: Any) -> Array:
        """M as an array of free parameters; raises InputError on a wrong shape or non-finite entries."""
        M = as_array(name, M)
        labels = ("memory", "input", "state")
        remedy = ""
        if M.shape == self.lifted_shape and M.shape != self.policy_shape:
            remedy = "This is the lifted policy: pass the free parameters of the structure."
        elif M.ndim == 2 and (1, *M.shape) == self.policy_shape:
            remedy = "Add the lag axis: M[None]."
        check_shape(name, M, self.policy_shape, labels, remedy)
        return M.astype(self.dtype)

    def initial_policy(self) -> Array:
        """The feasible policy nearest to zero: where solvers start when told nothing."""
        return self.feasible_set.project(jnp.zeros(self.policy_shape, self.dtype))

    def closed_loop(self, A: Matrix, B: Matrix) -> Matrix:
        """A - B K for t = 0..T-1, constant where all three are."""
        if not self.has_gain:
            return A
        gain = self.gain if self.gain.ndim == 2 else self.gain[:-1]
        return A + -(B @ gain)

    def feedback(self, x: Array) -> Array:
        """K_t x_t for t = 0..T, (T+1, m)."""
        return x @ self.gain.T if self.gain.ndim == 2 else jnp.einsum("tmn,tn->tm", self.gain, x)

    def feedback_adjoint(self, u: Array) -> Array:
        """K_tᵀ u_t for t = 0..T, (T+1, n)."""
        return u @ self.gain if self.gain.ndim == 2 else jnp.einsum("tmn,tm->tn", self.gain, u)

    def gains(self) -> Array:
        """K_t for t = 0..T, shape (T+1, m, n); T is `steps`."""
        return along_time(self.gain, 2, self.steps + 1)

    @property
    def lifted_set(self) -> LiftedSet:
        """The feasible set as perturbation laws see it."""
        return LiftedSet(self.feasible_set, self.structure, self.lifted_shape)

    def perturbation_bound(self) -> Array | None:
        """ξ_t, (T,): almost-sure bound of ‖Δ_t‖ over the feasible set; None if unknown. T is `steps`."""
        return self.perturbation.bound(self.lifted_set, self.steps)

    def sensitivity(self) -> Array | None:
        """ε_t, (T,), per unit of Frobenius norm of the free parameters; None if unknown. T is `steps`."""
        epsilon = self.perturbation.sensitivity(self.lifted_set, self.steps)
        return None if epsilon is None else self.structure.norm * epsilon


def _zero_gain(gain: Array, m: int, n: int) -> Array:
    if not isinstance(gain, jax.core.Tracer) and float(gain) != 0:
        raise fail("gain", f"the number {float(gain)}", f"have shape (m, n) = ({m}, {n})", "Pass a matrix; 0 is none.")
    return jnp.zeros((m, n), gain.dtype)


def check_problem(problem: Any) -> PerformativeProblem:
    """`problem` itself; raises InputError for anything else."""
    example = "pc.PerformativeProblem(system=..., horizon=..., noise=..., cost=...)"
    return check_instance("problem", problem, PerformativeProblem, example)


def warn_of_unstable_gain(problem: PerformativeProblem) -> None:
    """Say so, once, where a gain was given and the closed loop grows under it nevertheless."""
    if problem.has_gain:
        gain = problem.gain if problem.gain.ndim == 2 else problem.gain[:-1]
        warn_of_growth(problem.system.A, problem.system.B, gain)


def check_end(problem: Any) -> PerformativeProblem:
    """`problem` itself; raises InputError for anything else than a problem with a finite horizon."""
    if not check_problem(problem).is_finite:
        raise fail("problem", "an infinite horizon", "have a finite horizon here", "Pass problem.truncated(T).")
    return problem
