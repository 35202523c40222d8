"""The whole interface over drawn shapes and data: what is refused, and what every way of calling agrees on."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import perfcontrol as pc
from tests.tools import assert_close, assert_refused

quick = settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
few = settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))

sizes = st.tuples(st.integers(1, 3), st.integers(1, 3), st.integers(1, 2), st.integers(3, 5))  # n, m, H, T
seeds = st.integers(0, 2**32 - 1)


def scale(M, strength):
    return 0.3 + strength * jnp.sum(M**2)[None]


def data(seed: int, n: int, m: int, H: int, T: int) -> dict:
    rng = np.random.default_rng(seed)

    def psd(size):
        root = rng.normal(size=(size, size))
        return root @ root.T + 0.1 * np.eye(size)

    return {
        "A": 0.4 * rng.normal(size=(n, n)),
        "B": rng.normal(size=(n, m)),
        "K": 0.1 * rng.normal(size=(m, n)),
        "Q": psd(n),
        "R": psd(m),
        "mean": 0.3 * rng.normal(size=n),
        "covariance": psd(n),
        "directions": 0.2 * rng.normal(size=(1, n, n + m)),
        "strength": rng.uniform(0.0, 0.2),
        "start": rng.normal(size=n),
        "M": 0.3 * rng.normal(size=(H, m, n)),
        "deployed": 0.3 * rng.normal(size=(H, m, n)),
    }


def build(d: dict, T: int) -> pc.PerformativeProblem:
    return pc.PerformativeProblem(
        system=pc.LinearSystem(d["A"], d["B"]),
        horizon=T,
        memory=d["M"].shape[0],
        gain=d["K"],
        noise=pc.Gaussian(d["mean"], d["covariance"]),
        cost=pc.QuadraticCost(d["Q"], d["R"]),
        perturbation=pc.DirectionalPerturbation(d["directions"], pc.Function(scale, d["strength"])),
        initial_state=d["start"],
    )


# --- shapes: cheap, as nothing is compiled ---------------------------------------------------------------------------


@quick
@given(sizes, sizes, seeds)
def test_policy_of_another_shape_is_refused_by_every_function(size, other, seed):
    n, m, H, T = size
    wrong = np.zeros((other[2], other[1], other[0]))
    assume(wrong.shape != (H, m, n))
    problem, key = build(data(seed, *size), T), jax.random.key(0)
    right = np.zeros((H, m, n))
    expected = str((H, m, n))
    assert_refused(lambda: pc.expected_cost(problem, wrong), "M", expected)
    assert_refused(lambda: pc.expected_gradient(problem, wrong), "M", expected)
    assert_refused(lambda: pc.sample_gradient(problem, wrong, key=key), "M", expected)
    assert_refused(lambda: pc.simulate(problem, right, deployed=wrong, key=key), "deployed", expected)
    assert_refused(lambda: pc.best_response(problem, wrong), "deployed", expected)
    assert_refused(lambda: pc.solve(problem, pc.StablePoint(), wrong), "M0", expected)


@quick
@given(sizes, seeds, st.sampled_from(["B", "K", "Q", "R", "mean", "directions", "start"]), st.integers(0, 1))
def test_an_array_that_does_not_fit_is_refused_by_name(size, seed, name, axis):
    d = data(seed, *size)
    axis = axis if d[name].ndim > 1 else 0
    if name == "directions":
        axis = 1
    grown = np.concatenate([d[name], d[name].take([0], axis=axis)], axis=axis)
    if name in ("Q", "R"):
        grown = np.eye(len(d[name]) + 1)
    if name == "B" and axis == 1:  # one more input: K, R and the directions no longer fit
        assert_refused(lambda: build({**d, "B": grown}, size[3]), "gain")
        return
    if name == "mean":
        assert_refused(lambda: build({**d, "mean": grown}, size[3]), "covariance")
        return
    argument = {"K": "gain", "start": "initial_state"}.get(name, name)
    assert_refused(lambda: build({**d, name: grown}, size[3]), argument)


@quick
@given(sizes, seeds, st.sampled_from(["A", "B", "K", "Q", "R", "mean", "covariance", "directions", "start", "M"]))
def test_a_missing_value_is_refused_with_its_place(size, seed, name):
    d = data(seed, *size)
    index = tuple(np.random.default_rng(seed).integers(0, d[name].shape))
    d[name] = d[name].copy()
    d[name][index] = np.nan
    argument = {"K": "gain", "start": "value"}.get(name, name)
    place = str([int(i) for i in index])
    assert_refused(lambda: pc.expected_cost(build(d, size[3]), d["M"]), argument, "finite", place)


# --- data: one shape, compiled once ----------------------------------------------------------------------------------

SHAPE = (2, 2, 2, 4)


def several(problem, M, deployed, key):
    """What the interface answers about one problem."""
    return {
        "cost": pc.expected_cost(problem, M, deployed=deployed),
        "gradient": pc.expected_gradient(problem, M, deployed=deployed),
        "response": pc.best_response(problem, deployed),
        "moments": pc.state_moments(problem, M, deployed=deployed).second,
        "sampled": pc.sample_gradient(problem, M, deployed=deployed, key=key, samples=2),
        "estimate": pc.estimate_cost(problem, M, deployed=deployed, key=key, samples=4).mean,
    }


stacked = eqx.filter_jit(eqx.filter_vmap(several))


def assert_same(value, reference, double=1e-10, single=1e-3):
    for name in reference:
        assert_close(value[name], reference[name], double, single)


@few
@given(st.lists(seeds, min_size=3, max_size=3, unique=True))
def test_compiled_vmap_over_stacked_problems_equals_single_calls(drawn):
    drawn = [data(seed, *SHAPE) for seed in drawn]
    problems = [build(d, SHAPE[3]) for d in drawn]
    keys = jax.random.split(jax.random.key(1), 3)
    singles = [
        several(p, jnp.asarray(d["M"]), jnp.asarray(d["deployed"]), key)
        for p, d, key in zip(problems, drawn, keys, strict=True)
    ]
    pair = [jnp.asarray(np.stack([d[name] for d in drawn])) for name in ("M", "deployed")]
    batch = stacked(jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems), *pair, keys)
    for i, single in enumerate(singles):
        assert_same({name: value[i] for name, value in batch.items()}, single)


def test_compiled_cost_equals_the_one_run_operation_by_operation():
    d = data(3, *SHAPE)
    problem = build(d, SHAPE[3])
    compiled = pc.expected_cost(problem, d["M"]), pc.expected_gradient(problem, d["M"])
    with jax.disable_jit():
        eager = pc.expected_cost(problem, d["M"]), pc.expected_gradient(problem, d["M"])
    assert_close(compiled[0], eager[0])
    assert_close(compiled[1], eager[1])


@quick
@given(seeds, st.floats(0.1, 10.0))
def test_cost_is_quadratic_in_the_size_of_noise_and_initial_state(seed, size):
    d = data(seed, *SHAPE)
    grown = {**d, **{name: size * d[name] for name in ("mean", "start")}, "covariance": size**2 * d["covariance"]}
    one, two = (pc.expected_cost(build(x, SHAPE[3]), d["M"], deployed=d["deployed"]) for x in (d, grown))
    assert_close(two, size**2 * one)
    assert_close(
        pc.best_response(build(grown, SHAPE[3]), d["deployed"]),
        pc.best_response(build(d, SHAPE[3]), d["deployed"]),
        1e-9,
    )


@quick
@given(seeds)
def test_cost_is_quadratic_and_convex_in_the_evaluated_policy(seed):
    """Three points on a line fix it; a fourth and the gradient agree; the best response lies below all."""
    d = data(seed, *SHAPE)
    problem, V = build(d, SHAPE[3]), np.random.default_rng(seed + 1).normal(size=d["M"].shape)
    cost = functools.partial(pc.expected_cost, problem, deployed=d["deployed"])
    values = [float(cost(d["M"] + t * V)) for t in (-1.0, 0.0, 1.0, 2.0)]
    second = values[0] - 2 * values[1] + values[2]
    scale = max(map(abs, values))
    assert second >= -1e-9 * scale
    assert abs(values[3] - (values[1] + (values[2] - values[0]) + 2 * second)) <= 1e-9 * scale
    slope = np.sum(np.asarray(pc.expected_gradient(problem, d["M"], deployed=d["deployed"])) * V)
    assert abs(slope - (values[2] - values[0]) / 2) <= 1e-9 * scale
    assert float(cost(pc.best_response(problem, d["deployed"]))) <= min(values) * (1 + 1e-9)


@quick
@given(seeds)
def test_cost_does_not_depend_on_the_coordinates(seed):
    """x = S y and u = U v: the same control problem in other coordinates."""
    d = data(seed, *SHAPE)
    rng = np.random.default_rng(seed + 2)
    S, U = (np.linalg.qr(rng.normal(size=(2, 2)))[0] for _ in range(2))
    D = d["directions"][0]
    moved = {
        "A": S.T @ d["A"] @ S,
        "B": S.T @ d["B"] @ U,
        "K": U.T @ d["K"] @ S,
        "Q": S.T @ d["Q"] @ S,
        "R": U.T @ d["R"] @ U,
        "mean": S.T @ d["mean"],
        "covariance": S.T @ d["covariance"] @ S,
        "directions": np.concatenate([S.T @ D[:, :2] @ S, S.T @ D[:, 2:] @ U], axis=1)[None],
        "strength": d["strength"],
        "start": S.T @ d["start"],
        "M": U.T @ d["M"] @ S,
        "deployed": U.T @ d["deployed"] @ S,
    }
    moved["Q"], moved["R"], moved["covariance"] = ((X + X.T) / 2 for X in (moved["Q"], moved["R"], moved["covariance"]))
    one, two = (pc.expected_cost(build(x, SHAPE[3]), x["M"], deployed=x["deployed"]) for x in (d, moved))
    assert_close(two, one, 1e-11)
    responses = [pc.best_response(build(x, SHAPE[3]), x["deployed"]) for x in (d, moved)]
    assert_close(U @ responses[1] @ S.T, responses[0], 1e-9)


def test_single_precision_answers_like_double_precision():
    """The same data in float32 arrays, all the way through."""
    d = data(4, *SHAPE)
    double = build(d, SHAPE[3])
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), double)
    M, deployed = (jnp.asarray(d[name], jnp.float32) for name in ("M", "deployed"))
    assert single.dtype == jnp.float32
    rough = several(single, M, deployed, jax.random.key(1))
    exact = several(double, jnp.asarray(d["M"]), jnp.asarray(d["deployed"]), jax.random.key(1))
    for name in ("cost", "gradient", "response", "moments"):
        assert rough[name].dtype == jnp.float32
        assert_close(rough[name], exact[name], 1e-4)
    assert pc.solve(single, pc.StablePoint()).result == pc.Result.success


def test_twenty_problems_with_swept_parameters_are_traced_once():
    """Data, parameters of a Function, sets' sizes and steps are leaves: nothing recompiles."""
    traces = []

    def counting(M, strength):
        traces.append(None)
        return scale(M, strength)

    def sweep(i):
        d = data(i, *SHAPE)
        problem = build(d, SHAPE[3])
        return eqx.tree_at(
            lambda p: (p.perturbation, p.feasible_set),
            problem,
            (
                pc.DirectionalPerturbation(d["directions"], pc.Function(counting, 0.01 * i)),
                pc.FrobeniusBall(1.0 + 0.1 * i),
            ),
        )

    # Number 17 alone takes a Newton step: at the head of the line, it leaves no program for the others to compile.
    problems, after = [sweep(i) for i in (17, *range(17), 18, 19)], []
    for i, problem in enumerate(problems):
        pc.expected_cost(problem, jnp.full((2, 2, 2), 0.1))
        pc.solve(problem, pc.StablePoint())
        pc.solve(problem, pc.RSGD(5, pc.InverseStep(0.1, 10.0 + i)), key=jax.random.key(i))
        after.append(len(traces))
    assert set(np.diff(after)) == {0}, f"traces after each problem: {after}"
