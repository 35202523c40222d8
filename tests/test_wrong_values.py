"""Wrong values over all public names: each is refused in four parts, by the name of the argument that is wrong."""

import inspect

import jax
import numpy as np
import pytest

import perfcontrol as pc
from tests.tools import assert_refused

nan, inf = float("nan"), float("inf")
eye, M = np.eye(2), np.zeros((1, 2, 2))
key = jax.random.key(0)
system, law = pc.LinearSystem(0.5 * eye, eye), pc.Gaussian(np.zeros(2), eye)


def build(**changes):
    arguments = {"system": system, "horizon": 3, "noise": law, "cost": pc.QuadraticCost(eye, eye)}
    return pc.PerformativeProblem(**(arguments | changes))


def perturbed(perturbation):
    return build(perturbation=perturbation)


def drawn(key, M):
    return jax.numpy.zeros((3, 2, 2))


def controlled(gate=False, gradient=None, **changes):
    return pc.online.Controller(build(**changes), pc.RSGD(3, 0.1, gradient=gradient), gate=gate)


def observed(steps, jump=0.0):
    """The state after so many steps, one more observed a jump away from where they led."""
    state = begun
    for _ in range(steps):
        state = plant.observe(state, *3 * [np.zeros(2)])
    return plant.observe(state, np.full(2, jump), *2 * [np.zeros(2)]) if jump else state


problem = build()
solution = pc.Solution(jax.numpy.asarray(M), pc.Result.success, jax.numpy.asarray(0), None, {})
plant = controlled()
begun = plant.init()
DATA = np.zeros((2, 4, 2)), np.zeros((2, 4, 2)), np.zeros((2, 1, 2, 2))  # states, inputs, deployed policies

WRONG = {
    "system": {
        "not square": (lambda: pc.LinearSystem(np.ones((2, 3)), eye), "A", "(2, 3)"),
        "text": (lambda: pc.LinearSystem("A", eye), "A", "str"),
        "nothing": (lambda: pc.LinearSystem(None, eye), "A", "got None"),
        "complex": (lambda: pc.LinearSystem(1j * eye, eye), "A", "complex"),
        "ragged": (lambda: pc.LinearSystem([[1.0], [1.0, 2.0]], eye), "A", "rectangular"),
        "a number": (lambda: pc.LinearSystem(0.5, eye), "A", "[[a]]"),
        "rows of B": (lambda: pc.LinearSystem(eye, np.ones((3, 1))), "B", "2 rows"),
        "vector B": (lambda: pc.LinearSystem(eye, np.ones(2)), "B", "column"),
        "indefinite weight": (lambda: pc.design_gain(system, Q=-eye, R=eye), "Q", "semidefinite"),
        "weight of no input": (lambda: pc.design_gain(system, Q=eye, R=0 * eye), "R", "positive definite"),
        "gain for another system": (lambda: pc.strong_stability(system, np.zeros((2, 3))), "K", "(2, 3)"),
        "no equilibrium": (lambda: pc.linearise(lambda x, u: x + 1.0, [0.0], [0.0]), "state", "equilibrium"),
        "policy without lags": (lambda: pc.DisturbanceAction(np.zeros((2, 2)), np.zeros((2, 2))), "M", "(H, m, n)"),
    },
    "problem": {
        "no stage": (lambda: build(horizon=0), "horizon", "at least 1"),
        "half a stage": (lambda: build(horizon=3.5), "horizon", "integer"),
        "horizon as text": (lambda: build(horizon="3"), "horizon", "'3'"),
        "memory beyond the horizon": (lambda: build(memory=3), "memory", "below the horizon"),
        "memory as a truth value": (lambda: build(memory=True), "memory", "True"),
        "gain of another shape": (lambda: build(gain=np.ones((2, 3))), "gain", "(2, 3)"),
        "gain by name": (lambda: build(gain="lqr"), "gain", "str"),
        "noise of another size": (lambda: build(noise=pc.Constant(np.zeros(3))), "noise", "dimension 3"),
        "noise too long": (lambda: build(noise=pc.Sequence(np.zeros((4, 2)))), "noise", "horizon of 3"),
        "start of another size": (lambda: build(initial_state=np.ones(3)), "initial_state", "dimension 3"),
        "start by name": (lambda: build(initial_state="zero"), "value", "str"),
        "blocks that do not fit": (lambda: build(structure=pc.RepeatedBlock(3)), "structure", "3 equal blocks"),
    },
    "laws": {
        "negative covariance": (lambda: pc.Gaussian(np.zeros(2), -eye), "covariance", "semidefinite"),
        "asymmetric covariance": (lambda: pc.Gaussian(np.zeros(2), [[1, 1], [0, 1]]), "covariance", ".T) / 2"),
        "covariance of another size": (lambda: pc.Gaussian(np.zeros(2), np.eye(3)), "covariance", "(3, 3)"),
        "crossed bounds": (lambda: pc.Uniform(1.0, 0.0), "low", "Swap"),
        "bounds of two sizes": (lambda: pc.Uniform(np.zeros(2), np.ones(3)), "high", "(3,)"),
        "negative scale": (lambda: pc.Rademacher(-1.0), "scale", "absolute value"),
        "negative truncation": (lambda: pc.TruncatedGaussian(np.zeros(2), eye, -1.0), "bound", "positive"),
        "no truncation": (lambda: pc.TruncatedGaussian(np.zeros(2), eye, inf), "bound", "pc.Gaussian"),
        "two truncations": (lambda: pc.TruncatedGaussian(np.zeros(2), eye, [1, 2]), "bound", "one number"),
        "a matrix": (lambda: pc.Constant(eye), "value", "vector"),
        "one time": (lambda: pc.Sequence(np.zeros(2)), "values", "time step"),
        "no sample": (lambda: pc.Empirical(np.zeros((0, 2))), "samples", "at least one row"),
        "volatility of another size": (lambda: pc.LogNormal(np.zeros(2), np.eye(3)), "covariance", "(3, 3)"),
        "image of another law": (lambda: pc.Linear(law, np.ones((2, 3))), "matrix", "2 columns"),
    },
    "costs": {
        "negative weight": (lambda: pc.QuadraticCost(-eye, eye), "Q", "semidefinite"),
        "weight of another size": (lambda: build(cost=pc.QuadraticCost(eye, np.eye(3))), "R", "(3, 3)"),
        "weight as a number": (lambda: pc.QuadraticCost(1.0, eye), "Q", "[[q]]"),
        "growing discount": (lambda: pc.QuadraticCost(eye, eye, discount=1.5), "discount", "(0, 1]"),
        "target of another size": (
            lambda: build(cost=pc.QuadraticCost(eye, eye, state_target=np.ones(3))),
            "state_target",
            "(3,)",
        ),
        "no function": (lambda: pc.ConvexCost(None), "function", "callable"),
        "constants that contradict": (
            lambda: pc.ConvexCost(drawn, strong_convexity=2.0, smoothness=1.0),
            "strong_convexity",
            "smoothness 1.0",
        ),
        "vector cost": (lambda: build(cost=pc.ConvexCost(lambda t, x, u: x)), "function", "shape (2,)"),
        "negative threshold": (lambda: pc.Huber(-1.0), "threshold", "positive"),
        "no scale": (lambda: pc.LogCosh(0.0), "scale", "positive"),
        "risk not a number": (lambda: pc.LinearExponential(nan), "risk", "Pass a finite number"),
        "unknown side": (lambda: pc.OneSidedQuadratic("up"), "side", "below"),
    },
    "sets": {
        "negative ball": (lambda: pc.FrobeniusBall(-1.0), "radius", "≥ 0"),
        "two radii": (lambda: pc.FrobeniusBall([1.0, 2.0]), "radius", "one number"),
        "radius as text": (lambda: pc.SpectralBall("1"), "radius", "str"),
        "crossed box": (lambda: pc.Box(1.0, 0.0), "low", "empty"),
        "box of another shape": (lambda: build(feasible_set=pc.Box(np.zeros(3), 1.0)), "low", "(3,)"),
        "sums of another shape": (lambda: build(feasible_set=pc.RowSum(np.ones(3))), "total", "(3,)"),
        "negative simplex": (lambda: pc.RowSimplex(-1.0), "total", "empty"),
        "mask of numbers": (lambda: pc.Support([0, 2]), "mask", "True and False"),
        "no common point": (
            lambda: pc.Intersection([pc.RowSum(1), pc.RowSum(2)]).check((1, 2, 2)),
            "sets",
            "empty",
        ),
        "no block": (lambda: pc.RepeatedBlock(0), "count", "at least 1"),
    },
    "perturbations": {
        "slope without policy axes": (lambda: pc.Affine(0.0, np.ones(3)), "slope", "(H, m, n)"),
        "slope of another policy": (
            lambda: perturbed(pc.DensePerturbation(pc.Affine(1.0, np.ones((2, 2, 2))))),
            "scale",
            "(1, 2, 2)",
        ),
        "weights that do not fit": (lambda: pc.Norm(np.zeros(2), np.ones(3)), "weight", "broadcast"),
        "no function": (lambda: pc.Function(3.0), "f", "callable"),
        "parameters as text": (lambda: pc.Function(drawn, {"rate": "high"}), "params", "str"),
        "negative scale": (lambda: pc.DensePerturbation(-1.0), "scale", "absolute value"),
        "unknown law": (lambda: pc.DensePerturbation(1.0, law="cauchy"), "law", "'cauchy'"),
        "law as a matrix": (lambda: pc.DensePerturbation(1.0, law=eye), "law", "random vector"),
        "one direction": (lambda: pc.DirectionalPerturbation(eye, 1.0), "directions", "[D]"),
        "two scales": (lambda: perturbed(pc.DirectionalPerturbation(eye[None], np.ones(2))), "scale", "(2,)"),
        "sum above one": (
            lambda: perturbed(pc.FinitePerturbation(np.stack([eye, eye]), [0.5, 0.6])),
            "probabilities",
            "1.1",
        ),
        "no sampler": (lambda: pc.SampledPerturbation(1.0), "sampler", "callable"),
        "draws of another shape": (
            lambda: perturbed(pc.SampledPerturbation(lambda key, M: M)),
            "sampler",
            "(3, 2, 2)",
        ),
        "unknown volatility": (
            lambda: pc.StochasticVolatility(np.ones(2), 0.1, volatility="wild"),
            "volatility",
            "'wild'",
        ),
        "growth without a law": (lambda: pc.StockPerturbation(np.ones(2), 0.1), "growth", "pc.LogNormal"),
    },
    "solvers": {
        "no step": (lambda: pc.RSGD(0, 0.1), "steps", "at least 1"),
        "steps as a float": (lambda: pc.RSGD(1e3, 0.1), "steps", "1000.0"),
        "step backwards": (lambda: pc.RSGD(10, -0.1), "step_size", "pc.InverseStep"),
        "step by name": (lambda: pc.RSGD(10, "auto"), "step_size", "str"),
        "no path": (lambda: pc.RSGD(10, 0.1, batch=0), "batch", "at least 1"),
        "gradient by name": (lambda: pc.RSGD(10, 0.1, gradient="exact"), "gradient", "pc.Pathwise()"),
        "schedule as a number": (lambda: pc.RSGD(10, 0.1, schedule=2), "schedule", "pc.Greedy()"),
        "transform by name": (lambda: pc.RSGD(10, 0.1, transform="adam"), "transform", "optax"),
        "never deployed": (lambda: pc.Lazy(0), "steps", "at least 1"),
        "no delay": (lambda: pc.InverseStep(1.0, 0.0), "phi2", "positive"),
        "step that falls too fast": (lambda: pc.PowerStep(0.1, 1.5), "alpha", "pc.InverseStep"),
        "falls before it starts": (lambda: pc.PowerStep(0.1, delay=-1.0), "delay", "positive"),
        "all burnt in": (lambda: pc.Average(burn_in=1.0), "burn_in", "0.25"),
        "points that coincide": (lambda: pc.TwoPoint(0.0), "radius", "0.1"),
        "negative ridge": (lambda: pc.EstimatedDynamics(-1.0), "ridge", "1e-6"),
        "region without a run": (lambda: pc.confidence_region(M), "solution", "average=True"),
        "no start": (lambda: pc.PerformativeOptimum(starts=0), "starts", "at least 1"),
        "no inner step": (lambda: pc.RRM(inner_steps=0), "inner_steps", "at least 1"),
        "memory below none": (lambda: pc.RRM(anderson=-1), "anderson", "at least 0"),
        "negative tolerance": (lambda: pc.RRM(tolerance=-1), "tolerance", "got -1"),
        "tolerance by name": (lambda: pc.StablePoint(tolerance="small"), "tolerance", "'small'"),
        "tolerance below rounding": (lambda: pc.solve(problem, pc.RRM(tolerance=1e-30)), "tolerance", "can reach"),
        "no iteration": (lambda: pc.Continuation(max_steps=0), "max_steps", "at least 1"),
        "start without lags": (lambda: pc.solve(problem, pc.RRM(), np.zeros((2, 2))), "M0", "M[None]"),
        "start not a number": (lambda: pc.solve(problem, pc.RRM(), M * nan), "M0", "nan at index [0, 0, 0]"),
        "no key": (lambda: pc.solve(problem, pc.RSGD(3, 0.1)), "key", "jax.random.key(0)"),
        "seed": (lambda: pc.solve(problem, pc.RSGD(3, 0.1), key=7), "key", "jax.random.key(7)"),
        "key of floats": (lambda: pc.solve(problem, pc.RSGD(3, 0.1), key=jax.numpy.ones(2)), "key", "float"),
        "two keys": (lambda: pc.solve(problem, pc.RSGD(3, 0.1), key=jax.random.split(key)), "key", "jax.vmap"),
        "checkpoint as a switch": (lambda: pc.solve(problem, pc.RRM(), checkpoint=True), "checkpoint", "folder"),
        "no problems": (lambda: pc.solve_many([], pc.RRM()), "problems", "at least one"),
        "many runs by a number": (lambda: pc.solve_many(problem, pc.RSGD(3, 0.1), keys=5), "keys", "split"),
        "many runs, no key": (lambda: pc.solve_many(problem, pc.RSGD(3, 0.1)), "key", "jax.random.key(0)"),
        "record by name": (lambda: pc.solve(problem, pc.RRM(), record="M"), "record", "callable"),
        "progress as a switch": (lambda: pc.solve(problem, pc.RRM(), progress=True), "progress", "callable"),
        "never recorded": (lambda: pc.solve(problem, pc.RRM(), every=0), "every", "at least 1"),
        "sampled world": (
            lambda: pc.solve(perturbed(pc.SampledPerturbation(drawn)), pc.RRM()),
            "perturbation",
            "pc.estimate_cost",
        ),
    },
    "evaluation": {
        "policy of another memory": (lambda: pc.expected_cost(problem, np.zeros((2, 2, 2))), "M", "(2, 2, 2)"),
        "policy as a vector": (lambda: pc.state_moments(problem, np.zeros(4)), "M", "(4,)"),
        "moments of a list": (lambda: pc.expected_cost_by_moments(problem, [[1.0]]), "M", "(1, 1)"),
        "other policy deployed": (
            lambda: pc.residual(problem, M, deployed=np.zeros((1, 2, 3))),
            "deployed",
            "(1, 2, 3)",
        ),
        "number of samples alone": (lambda: pc.StablePoint(sampling=64), "sampling", "SampleAverage"),
        "no paths": (lambda: pc.SampleAverage(0), "samples", "at least 2"),
        "sampled response without key": (lambda: pc.estimate_response(problem, M), "key", "jax.random.key(0)"),
        "sampled response to nothing": (lambda: pc.estimate_response(problem, None, key=key), "deployed", "got None"),
        "response to nothing": (lambda: pc.best_response(problem, None), "deployed", "got None"),
        "two worlds at once": (
            lambda: pc.expected_gradient(problem, M, deployed=M, total=True),
            "deployed",
            "left out",
        ),
        "path without a key": (lambda: pc.simulate(problem, M), "key", "explicit"),
        "no error of one sample": (lambda: pc.estimate_cost(problem, M, key=key, samples=1), "samples", "at least 2"),
        "half a path": (lambda: pc.sample_gradient(problem, M, key=key, samples=2.5), "samples", "integer"),
        "policy for a path": (lambda: pc.path_gradient(problem, M), "path", "pc.simulate"),
        "inputs too short": (
            lambda: pc.recover_noise(problem, np.zeros((4, 2)), np.zeros((3, 2)), np.zeros((3, 2, 2))),
            "u",
            "(3, 2)",
        ),
        "noise of no problem": (
            lambda: pc.recover_noise(None, np.zeros((4, 2)), np.zeros((4, 2)), np.zeros((3, 2, 2))),
            "problem",
            "got None",
        ),
    },
    "theory": {
        "unknown kind": (lambda: pc.certify(problem, "sharpe"), "kind", "'sharpe'"),
        "negative bound": (lambda: pc.certify(problem, pc.Rigorous(noise_bound=-1.0)), "noise_bound", "non-negative"),
        "bound by name": (lambda: pc.certify(problem, pc.Paper(noise_bound="small")), "noise_bound", "str"),
        "range as a number": (
            lambda: pc.certify(
                perturbed(pc.DirectionalPerturbation(eye[None], lambda M: M[0, 0, :1])), pc.GlobalBound(scale_range=3.0)
            ),
            "scale_range",
            "(0.0, 1.0, 0.5)",
        ),
        "no path": (lambda: pc.certify(problem, pc.Sharp(batch=0)), "batch", "at least 1"),
        "step for no path": (lambda: pc.safe_step(problem, batch=0), "batch", "at least 1"),
        "safety above one": (lambda: pc.safe_step(problem, safety=2.0), "safety", "(0, 1]"),
        "unknown method": (lambda: pc.estimate_sensitivity(problem, method="magic"), "method", "'magic'"),
        "negative distance": (lambda: pc.rrm_error_bound(problem, -1.0, 5), "initial_error", "distance"),
        "half a step": (lambda: pc.rsgd_error_bound(problem, 0.1, 1.0, 2.5), "steps", "integer"),
        "no gap": (lambda: pc.optimality_bound(problem, gap=0.0), "gap", "gap=1e-3"),
        "no cells": (lambda: pc.optimality_bound(problem, max_cells=0), "max_cells", "at least 1"),
        "price from no start": (lambda: pc.price_of_stability(problem, starts=0), "starts", "at least 1"),
        "price with no gap left": (lambda: pc.price_of_stability(problem, gap=0.0), "gap", "1e-3"),
        "policy before of another shape": (
            lambda: pc.price_of_stability(problem, deployed_before=np.zeros((2, 2))),
            "deployed_before",
            "M[None]",
        ),
        "step of no kind": (lambda: pc.theorem_step_size(problem, kind="best"), "kind", "'best'"),
    },
    "plant": {
        "another method": (lambda: pc.online.Controller(problem, pc.StablePoint()), "solver", "init(M0=M)"),
        "a gradient of no plant": (lambda: controlled(gradient=pc.Exact()), "solver", "pc.Pathwise()"),
        "gate by name": (lambda: controlled("on"), "gate", "pc.online.Gate()"),
        "gate without parentheses": (lambda: controlled(pc.online.Gate), "gate", "pc.online.Gate()"),
        "no cost at all": (lambda: pc.online.Gate(cost=0.0), "cost", "positive"),
        "infinite radius": (lambda: pc.online.Gate(radius=inf), "radius", "None"),
        "radius as a switch": (lambda: pc.online.Gate(radius=True), "radius", "got True"),
        "step as a number": (lambda: pc.online.Gate(step=0.1), "step", "False"),
        "certificate by name": (lambda: pc.online.Gate(certificate="sharp"), "certificate", "'sharp'"),
        "start without lags": (lambda: plant.init(np.zeros((2, 2))), "M0", "M[None]"),
        "start outside": (lambda: controlled(feasible_set=pc.FrobeniusBall(1.0)).init(9 + M), "M0", "project"),
        "key as a seed": (lambda: plant.init(key=3), "key", "jax.random.key(3)"),
        "no state": (lambda: plant.act(None, np.zeros(2)), "state", "controller.init()"),
        "state of another size": (lambda: plant.act(begun, np.zeros(3)), "x", "(3,)"),
        "state not a number": (lambda: plant.act(begun, [nan, 0.0]), "x", "nan at index [0]"),
        "input of another size": (lambda: plant.observe(begun, M[0, 0], np.zeros(3), M[0, 0]), "u", "(3,)"),
        "infinite input": (lambda: plant.observe(begun, M[0, 0], [0.0, inf], M[0, 0]), "u", "inf"),
        "next state missing": (lambda: plant.observe(begun, M[0, 0], M[0, 0], None), "x_next", "got None"),
        "matrix as a vector": (lambda: plant.observe(begun, M[0, 0], M[0, 0], M[0, 0], M[0, 0]), "A", "(2, 2)"),
        "matrix not a number": (lambda: plant.observe(begun, *3 * [M[0, 0]], nan * eye), "A", "nan"),
        "step left out": (lambda: observed(1, 5.0), "x", "last x_next"),
        "step too many": (lambda: observed(4), "state", "end_episode"),
        "episode too short": (lambda: plant.end_episode(observed(2)), "state", "2 observed steps"),
        "state begun without a gate": (
            lambda: controlled(pc.online.Gate(step=False)).end_episode(observed(3)),
            "state",
            "this controller's init",
        ),
        "nothing expected": (
            lambda: controlled(False, perturbation=pc.SampledPerturbation(drawn)).observe(begun, *3 * [M[0, 0]]),
            "A",
            "SampledPerturbation",
        ),
    },
    "environments": {
        "no copy": (lambda: pc.environments.VectorPerformativeLDS(0), "num_envs", "at least 1"),
        "unknown actions": (lambda: pc.environments.PerformativeLDS(actions="forces"), "actions", "'forces'"),
        "no problem": (lambda: pc.environments.PerformativeLDS(3), "problem", "got int"),
        "no end": (
            lambda: pc.environments.PerformativeLDS(build(horizon=inf)),
            "problem",
            "problem.truncated(T)",
        ),
    },
    "data": {
        "numbers": (lambda: pc.Logs(1, 2, 3), "x", "(episode, time, state)"),
        "states not a number": (lambda: pc.Logs(DATA[0] * nan, *DATA[1:]), "x", "nan"),
        "no logs": (lambda: pc.fit(None), "logs", "pc.Logs(x, u, deployed)"),
        "no logs to test": (lambda: pc.test_reaction(None), "logs", "pc.Logs(x, u, deployed)"),
        "folder as a number": (lambda: pc.cache(3), "path", "folder"),
        "seed of a key as a fraction": (lambda: pc.fast_key(2.5), "seed", "integer"),
        "switch that is neither on nor off": (lambda: pc.use_kernel("on"), "on", "True or False"),
        "unknown order": (lambda: pc.experiments.stock_market("up"), "order", "'up'"),
        "unknown set": (lambda: pc.experiments.stock_market(feasible_set="box"), "feasible_set", "'box'"),
        "order of sensitivities": (lambda: pc.experiments.stock_sensitivities(3), "order", "got 3"),
    },
    "reports": {
        "solution without its problem": (lambda: pc.report(solution), "problem", "pc.report(problem, solution)"),
        "policy for a solution": (lambda: pc.report(problem, M), "solution", "pc.solve"),
        "one path": (lambda: pc.report(problem, samples=1), "samples", "at least 2"),
        "no time": (lambda: pc.report(problem, seconds=nan), "seconds", "nan"),
    },
    "files": {
        "nothing that is kept": (lambda: pc.save(eye, "a.npz"), "thing", "a problem, a solution, or a run"),
        "problem under another ending": (lambda: pc.save(problem, "a.npz"), "path", "a.toml"),
        "file that is not there": (lambda: pc.load("nowhere.toml"), "path", "does not exist"),
        "path as a number": (lambda: pc.load(3), "path", "int"),
        "run without a solution": (lambda: pc.Run(problem, None), "solution", "None"),
        "run of another problem": (lambda: pc.Run(build(memory=2), solution), "solution", "(2, 2, 2)"),
    },
}
ROWS = {f"{room}: {case}": row for room, cases in WRONG.items() for case, row in cases.items()}


@pytest.mark.float32
@pytest.mark.parametrize("case", ROWS)
def test_wrong_value_is_refused_by_the_name_of_its_argument_with_a_remedy(case):
    assert_refused(*ROWS[case])


# What the package gives back, and what takes no value that could be wrong.
GIVEN_BACK = {
    "Certificate",
    "ConfidenceRegion",
    "Estimate",
    "Fit",
    "Linearisation",
    "LinearisationError",
    "OptimalityBound",
    "PriceOfStability",
    "Decision",
    "ReactionTest",
    "Report",
    "Solution",
    "StateMoments",
    "Trajectories",
}


def test_every_public_name_that_takes_values_has_a_row():
    assert len(ROWS) >= 70
    used = {name for call, *_ in ROWS.values() for name in call.__code__.co_names}
    public = {name: getattr(pc, name) for name in pc.__all__ if name not in GIVEN_BACK}
    taking = {
        name
        for name, value in public.items()
        if (inspect.isfunction(value) or (inspect.isclass(value) and not issubclass(value, Exception | pc.Result)))
        and not inspect.isabstract(value)
        and inspect.signature(value).parameters
    }
    assert taking - {"PerformativeProblem"} <= used  # which `build` makes
