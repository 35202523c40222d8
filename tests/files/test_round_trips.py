"""What is saved comes back bit for bit: every public class that can stand in a file, solutions, runs."""

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import perfcontrol as pc
from perfcontrol._fingerprint import fingerprint
from perfcontrol.files.building import Plan, read_plan
from perfcontrol.files.registry import IN_PYTHON_ONLY, ROWS
from perfcontrol.files.writing import write_plan
from perfcontrol.solvers.result import MEMBERS

RANDOM = np.random.default_rng(5)
n, m, H, T = 2, 1, 2, 4
SHAPE = (H, m, n)


def draw(*shape):
    return RANDOM.normal(size=shape)


def psd(size, *lead):
    root = RANDOM.normal(size=(*lead, size, size))
    return root @ np.swapaxes(root, -1, -2)


def problem(**given):
    parts = {
        "system": pc.LinearSystem(draw(n, n) / 3, draw(n, m)),
        "horizon": T,
        "noise": pc.Uniform(-1.0, 1.0),
        "cost": pc.QuadraticCost(np.eye(n), np.eye(m)),
        "memory": H,
    }
    return pc.PerformativeProblem(**{**parts, **given})


def noise(law):
    return lambda: problem(noise=law)


def perturbation(law, **given):
    return lambda: problem(perturbation=law, **given)


def cost(function):
    return lambda: problem(cost=pc.ConvexCost(function))


def inside(feasible_set):
    return lambda: problem(feasible_set=feasible_set)


affine = pc.Affine(draw(1), draw(1, *SHAPE))
stocks = pc.StochasticVolatility(RANDOM.uniform(0.1, 0.2, T), 0.05)
market = {"system": pc.LinearSystem(np.eye(2), np.eye(2)), "cost": pc.QuadraticCost(np.eye(2), np.eye(2))}

# One or more problems for every class that is part of a problem.
PROBLEMS = {
    "PerformativeProblem": [
        problem,
        lambda: problem(gain=draw(m, n), initial_state=draw(n)),
        lambda: problem(gain=draw(T + 1, m, n), initial_state=pc.Gaussian(draw(n), psd(n))),
        lambda: problem(horizon=math.inf, cost=pc.QuadraticCost(psd(n), psd(m)), gain=0 * draw(m, n)),
    ],
    "LinearSystem": [
        lambda: problem(system=pc.LinearSystem(draw(T, n, n), draw(n, m), ["a", 'b "quoted" \x7f é'], ["u"])),
        lambda: problem(system=pc.LinearSystem(draw(n, n), draw(T, n, m))),
    ],
    "LinearSystem.diagonal": [
        lambda: problem(system=pc.LinearSystem.diagonal(draw(n), draw(T, n)), cost=pc.QuadraticCost(psd(n), psd(n)))
    ],
    "Constant": [noise(pc.Constant(draw(n))), noise(pc.Constant(0.1))],
    "Empirical": [noise(pc.Empirical(draw(7, n))), noise(pc.Empirical(draw(500, n)))],
    "Gaussian": [noise(pc.Gaussian(draw(n), psd(n)))],
    "Linear": [noise(pc.Linear(pc.Rademacher(draw(3) ** 2), draw(n, 3), draw(n)))],
    "LogNormal": [noise(pc.LogNormal(draw(n), psd(n))), noise(pc.LogNormal(draw(T, n), psd(n)))],
    "Rademacher": [noise(pc.Rademacher(draw(n) ** 2, 0.3))],
    "Sequence": [noise(pc.Sequence(draw(T, n)))],
    "StochasticVolatility": [perturbation(pc.StockPerturbation(stocks, 0.3), **market)],
    "TruncatedGaussian": [noise(pc.TruncatedGaussian(draw(n), psd(n), 2.5))],
    "Uniform": [noise(pc.Uniform(-(draw(n) ** 2), 1.0))],
    "Affine": [perturbation(pc.DirectionalPerturbation([draw(n, n)], affine))],
    "Norm": [
        perturbation(pc.DirectionalPerturbation(draw(2, n, n), pc.Norm(draw(2), 0.5, draw(*SHAPE), squared=True))),
        perturbation(pc.DirectionalPerturbation(draw(2, n, n), pc.Norm([0.1, 0.2], draw(2)))),
    ],
    "NoPerturbation": [perturbation(pc.NoPerturbation())],
    "DirectionalPerturbation": [
        perturbation(pc.DirectionalPerturbation([draw(n, n + m)], [0.3], mean=draw(n, n + m), law="uniform")),
        perturbation(
            pc.DirectionalPerturbation([draw(n, n)], draw(T, 1) ** 2, pc.Affine(draw(n, n), draw(n, n, *SHAPE)))
        ),
    ],
    "DensePerturbation": [
        perturbation(pc.DensePerturbation(0.3, law="sphere", on_input=True)),
        perturbation(pc.DensePerturbation(pc.Norm(0.1, 0.2), draw(n, n), pc.Gaussian(draw(n * n), psd(n * n)))),
    ],
    "FinitePerturbation": [
        perturbation(pc.FinitePerturbation(draw(2, n, n), [0.25, 0.75])),
        perturbation(pc.FinitePerturbation(draw(T, 2, n, n), pc.Affine([0.5, 0.5], np.zeros((2, *SHAPE))))),
    ],
    "StockPerturbation": [perturbation(pc.StockPerturbation(pc.Empirical(draw(9, 1)), 0.4), **market)],
    "QuadraticCost": [
        lambda: problem(
            cost=pc.QuadraticCost(psd(n, T + 1), psd(m) + np.eye(m), 1e-3 * draw(n, m), draw(T + 1, n), draw(m), 0.9)
        )
    ],
    "ConvexCost": [lambda: problem(cost=pc.ConvexCost(pc.Huber(0.5), 0.0, 3.0, 4.0, discount=0.8))],
    "Huber": [cost(pc.Huber(1.5, draw(n) ** 2, 0.2, draw(n), draw(m)))],
    "LogCosh": [cost(pc.LogCosh(0.7, state_target=0.1))],
    "OneSidedQuadratic": [cost(pc.OneSidedQuadratic()), cost(pc.OneSidedQuadratic("below", input_weight=draw(m) ** 2))],
    "LinearExponential": [cost(pc.LinearExponential(draw(n)))],
    "Unconstrained": [inside(pc.Unconstrained())],
    "FrobeniusBall": [inside(pc.FrobeniusBall(0.1))],
    "SpectralBall": [inside(pc.SpectralBall(1 / 3))],
    "RowSum": [inside(pc.RowSum(draw(H, m)))],
    "RowSimplex": [inside(pc.RowSimplex(0.3))],
    "Box": [inside(pc.Box(-np.inf, draw(*SHAPE) ** 2))],
    "Support": [inside(pc.Support([[True, False]]))],
    "Intersection": [inside(pc.Intersection([pc.RowSimplex(1.0), pc.Box(0.0, 0.9), pc.FrobeniusBall(5.0)]))],
    "FullStructure": [lambda: problem(structure=pc.FullStructure())],
    "RepeatedBlock": [lambda: problem(structure=pc.RepeatedBlock(2), **market)],
    "stock_market": [lambda: pc.experiments.stock_market("random", 0.96, feasible_set="simplex")],
    "market": [lambda: pc.experiments.market(100 * np.exp(np.cumsum(0.01 * draw(40, 3), axis=0)), horizon=5)],
}

SOLVERS = {
    "RSGD": [
        pc.RSGD(7, 0.1),
        pc.RSGD(200, pc.InverseStep(1, 2), 3, pc.TwoPoint(0.1), pc.Lazy(2), average=pc.Average(0.5)),
        pc.RSGD(9, 0.1, truncation=5),  # for infinite horizons alone
    ],
    "RRM": [pc.RRM(1e-4, 9, pc.SampleAverage(64, 128), inner_steps=3, anderson=2)],
    "StablePoint": [pc.StablePoint(), pc.StablePoint(1e-4, 3, rescue=False)],
    "PerformativeOptimum": [pc.PerformativeOptimum(3, 1e-4, 8)],
    "Continuation": [pc.Continuation(max_steps=17)],
    "SampleAverage": [pc.StablePoint(sampling=pc.SampleAverage(4))],
    "Average": [pc.RSGD(100, 0.1, average=pc.Average(0.1, "batch means"))],
    "InverseStep": [pc.RSGD(9, pc.InverseStep(1 / 3, 7.0))],
    "PowerStep": [pc.RSGD(9, pc.PowerStep(0.1, 0.7, 3.0))],
    "Pathwise": [pc.RSGD(9, 0.1, gradient=pc.Pathwise())],
    "Exact": [pc.RSGD(9, 0.1, gradient=pc.Exact())],
    "EstimatedDynamics": [pc.RSGD(9, 0.1, gradient=pc.EstimatedDynamics(1e-3))],
    "TwoPoint": [pc.RSGD(9, 0.1, gradient=pc.TwoPoint(0.2))],
    "Greedy": [pc.RSGD(9, 0.1, schedule=pc.Greedy())],
    "Lazy": [pc.RSGD(9, 0.1, schedule=pc.Lazy(4))],
}

ELSEWHERE = {
    "results that pc.save keeps itself": {"Run", "Solution"},
    "what comes out of a problem and is computed anew": {
        "Report",
        "Certificate", "ConfidenceRegion", "Estimate", "Linearisation", "OptimalityBound", "PriceOfStability", "Result",
        "StateMoments", "Trajectories",
    },
    "chosen by their names on the command line": {"GlobalBound", "Paper", "Rigorous", "Sharp"},
    "data, with files of their own": {"Decision", "Fit", "Logs", "ReactionTest"},
    "errors and warnings": {"InputError", "LinearisationError", "SolveError", "UnstableGainWarning"},
    "a law that problems make themselves": {"DisturbanceAction"},
}  # fmt: skip


def test_every_public_class_is_in_a_file_or_in_a_list_of_reasons():
    classes = {name for name in pc.__all__ if inspect.isclass(getattr(pc, name))}
    classes -= {name for name in classes if name.startswith("Abstract")}
    reasons = set.union(*ELSEWHERE.values(), IN_PYTHON_ONLY)
    rows = {name for name in ROWS if name in classes}
    assert rows | reasons == classes and not rows & reasons
    assert set(ROWS) - {"design_gain"} == set(PROBLEMS) | set(SOLVERS)  # a gain comes back as a matrix
    assert set(ROWS) - rows == {"LinearSystem.diagonal", "design_gain", "stock_market", "market"}


DESIGNED = """
horizon = 5
gain = { type = "design_gain", Q = [[1.0, 0.0], [0.0, 2.0]], R = [[0.1]] }
system = { A = [[1.2, 0.1], [0.0, 0.5]], B = [[1.0], [0.5]] }
noise = { type = "Uniform", low = -1.0, high = 1.0 }
cost = { type = "QuadraticCost", Q = [[1.0, 0.0], [0.0, 1.0]], R = [[1.0]] }
"""


def test_gain_that_a_file_designs_is_that_of_scipy(tmp_path):
    path = tmp_path / "problem.toml"
    path.write_text(DESIGNED, "utf-8")
    A, B, Q, R = np.array([[1.2, 0.1], [0.0, 0.5]]), np.array([[1.0], [0.5]]), np.diag([1.0, 2.0]), np.array([[0.1]])
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    np.testing.assert_allclose(pc.load(path).gain, np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), rtol=1e-10)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("R = [[0.1]]", "R = [[0.1, 1.0]]", "`gain.R` must have shape"),
        (", R = [[0.1]]", "", "needs the key `R`"),
        ("design_gain", "design", "Did you mean 'design_gain'?"),
    ],
)
def test_gain_that_cannot_be_designed_is_refused_with_its_line(old, new, words, tmp_path):
    path = tmp_path / "problem.toml"
    path.write_text(DESIGNED.replace(old, new, 1), "utf-8")
    with pytest.raises(pc.InputError) as caught:
        pc.load(path)
    assert "line 3" in str(caught.value) and words in str(caught.value)


@pytest.mark.parametrize("build", [pytest.param(b, id=name) for name, each in PROBLEMS.items() for b in each])
def test_problem_comes_back_bit_for_bit(build, tmp_path):
    made = build()
    pc.save(made, tmp_path / "problem.toml")
    assert fingerprint(pc.load(tmp_path / "problem.toml")) == fingerprint(made)


@pytest.mark.float32
@pytest.mark.parametrize("solver", [pytest.param(s, id=name) for name, each in SOLVERS.items() for s in each])
def test_plan_comes_back_bit_for_bit(solver, tmp_path):
    horizon = T if getattr(solver, "truncation", None) is None else math.inf
    plan = Plan(problem(horizon=horizon), solver, draw(*SHAPE), 2**31)
    write_plan(plan, tmp_path / "plan.toml")
    back = read_plan(tmp_path / "plan.toml")
    assert fingerprint((back.problem, back.solver)) == fingerprint((plan.problem, plan.solver))
    np.testing.assert_array_equal(back.M0, jnp.asarray(plan.M0))
    assert back.seed == plan.seed


def test_large_arrays_stand_beside_the_file_and_small_ones_inside(tmp_path):
    pc.save(problem(noise=pc.Empirical(draw(500, n))), tmp_path / "problem.toml")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == 2 and names[0].startswith("problem.noise.samples.") and names[0].endswith(".npy")


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (
            lambda: problem(perturbation=pc.DirectionalPerturbation([np.eye(n)], lambda M: jnp.sum(M**2)[None])),
            ("`perturbation.scale`", "pc.Affine(offset, slope) or pc.Norm(offset, weight)"),
        ),
        (lambda: problem(noise=lambda M: pc.Uniform(-jnp.ones(n), jnp.ones(n))), ("`noise`", "pc.Norm")),
        (lambda: problem(cost=pc.ConvexCost(lambda t, x, u: x @ x + u @ u)), ("`cost.function`", "pc.Huber")),
        (
            lambda: problem(perturbation=pc.SampledPerturbation(lambda key, M: jnp.zeros((T, n, n)))),
            ("`perturbation`", "SampledPerturbation"),
        ),
    ],
)
def test_functions_are_refused_with_a_way_out(made, words, tmp_path):
    with pytest.raises(pc.InputError) as caught:
        pc.save(made(), tmp_path / "problem.toml")
    for word in words:
        assert word in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def equal(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_array_equal(a, b)


def test_solutions_come_back_bit_for_bit_with_any_history(tmp_path):
    made = problem()

    def record(M):
        return {"norm": jnp.sum(M**2), "all": (M, [M[0] > 0])}

    solution = pc.solve(made, pc.RSGD(5, 0.01), key=jax.random.key(0), record=record)
    for number, each in enumerate([solution, pc.solve(made, pc.StablePoint())]):
        pc.save(each, tmp_path / f"{number}.npz")
        equal(pc.load(tmp_path / f"{number}.npz"), each)


def test_batches_of_solutions_come_back(tmp_path):
    made = problem()
    keys = jax.random.split(jax.random.key(0), 3)
    several = jax.vmap(lambda key: pc.solve(made, pc.RSGD(4, 0.01), key=key, throw=False))(keys)
    pc.save(several, tmp_path / "several.npz")
    back = pc.load(tmp_path / "several.npz")
    equal(back, several)
    assert str(back) == str(several)


def test_every_result_comes_back(tmp_path):
    for result in MEMBERS.values():
        pc.save(pc.Solution(jnp.zeros(SHAPE), result, jnp.asarray(3), None, {}), tmp_path / "s.npz")
        assert pc.load(tmp_path / "s.npz").result == result


def test_file_that_unpacks_to_more_than_it_is_is_refused(tmp_path):
    np.savez_compressed(tmp_path / "bomb.npz", M=np.zeros(10**6))
    with pytest.raises(pc.InputError, match="be a solution that"):
        pc.load(tmp_path / "bomb.npz")


@pytest.mark.float32
def test_run_comes_back_with_labelled_history(tmp_path):
    names = ["level", "flow"]
    made = problem(system=pc.LinearSystem(draw(n, n) / 3, draw(n, m), names, ["u"]))
    solver = pc.RSGD(6, 0.01)
    solution = pc.solve(made, solver, key=jax.random.key(4), every=2)
    run = pc.Run(made, solution, solver, seed=4, every=2)
    pc.save(run, tmp_path / "run")
    back = pc.load(tmp_path / "run")
    equal(back.solution, solution)
    assert fingerprint((back.problem, back.solver)) == fingerprint((made, solver))
    assert (back.seed, back.every, back.versions) == (4, 2, run.versions)
    assert back.history.dims == ("step", "lag", "input", "state")
    assert back.history.step.values.tolist() == [0, 2, 4, 6] and back.history.state.values.tolist() == names
    np.testing.assert_array_equal(back.history, solution.history)
    from perfcontrol.results import load_dataset

    assert load_dataset(tmp_path / "run" / "results.nc").policy.equals(back.dataset.policy)
    with pytest.raises(pc.InputError, match="be a new folder"):
        pc.save(run, tmp_path / "run")


def test_other_things_are_refused(tmp_path):
    for thing, path, words in (
        (np.zeros(3), tmp_path / "a.npz", "be a problem, a solution"),
        (problem(), tmp_path / "a.json", "end in .toml"),
        (problem(), 3, "be the path of a file"),
    ):
        with pytest.raises(pc.InputError, match=words):
            pc.save(thing, path)
    for path in (tmp_path / "none.toml", tmp_path / "none.npz", tmp_path / "none.txt", tmp_path):
        with pytest.raises(pc.InputError, match="`path` must"):
            pc.load(path)
