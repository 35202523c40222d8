"""Plants from python-control and SciPy, policies as their controllers, Optax's transformations as steps."""

import control
import jax
import numpy as np
import optax
import pytest
import scipy.signal

import perfcontrol as pc
from tests.tools import assert_close, assert_refused, normal, tolerance

A = np.array([[0.9, 0.2], [0.0, 0.8]])
B = np.array([[1.0], [0.5]])
K = np.array([[0.1, 0.2]])


def plant(dt=0.1):
    return control.ss(A, B, [[1.0, 0.0]], 0, dt, states=["level", "flow"], inputs=["valve"], outputs=["gauge"])


def problem(**changes):
    parts = {
        "system": pc.interop.from_control(plant()),
        "horizon": 12,
        "noise": pc.Gaussian([0.3, -0.1], np.eye(2)),
        "cost": pc.QuadraticCost(np.eye(2), np.eye(1)),
        "memory": 3,
        "gain": K,
        "initial_state": [1.0, 2.0],
    }
    return pc.PerformativeProblem(**(parts | changes))


def simulated(problem, M):
    paths = pc.simulate(problem, M, key=jax.random.key(0))
    x, u, w = (np.asarray(array[0], dtype=float) for array in (paths.x, paths.u, paths.w))
    return x, u, np.vstack([w, np.zeros(w.shape[1])])


@pytest.mark.float32
def test_plant_of_python_control_keeps_matrices_and_names():
    system = pc.interop.from_control(plant())
    assert_close(system.A, A, 0, 1e-7)
    assert_close(system.B, B, 0, 1e-7)
    assert system.state_names == ("level", "flow") and system.input_names == ("valve",)
    assert problem().system.state_names == ("level", "flow")


@pytest.mark.parametrize("form", ["ss", "tf", "zpk", "control"])
def test_plant_in_any_form_has_the_same_response(form):
    """Markov parameters C A^k B against the impulse response of the package that the plant comes from."""
    numerator, denominator = [1.0, 0.5], [1.0, -1.2, 0.35]
    given = scipy.signal.dlti(numerator, denominator, dt=0.5)
    system = {"ss": given.to_ss(), "tf": given, "zpk": given.to_zpk()}.get(
        form, control.tf(numerator, denominator, 0.5)
    )
    linear = pc.interop.from_control(system)
    response = np.squeeze(scipy.signal.dimpulse(given, n=8)[1])
    readout = np.asarray(control.ss(system).C if form == "control" else system.to_ss().C)
    powers = [np.linalg.matrix_power(np.asarray(linear.A), k) for k in range(7)]
    assert_close([(readout @ power @ np.asarray(linear.B)).item() for power in powers], response[1:], 1e-9)


@pytest.mark.float32
@pytest.mark.parametrize("memory", [1, 3])
@pytest.mark.parametrize("gain", [0, K])
def test_controller_given_the_noise_reproduces_simulate_to_rounding(memory, gain):
    reacting = pc.DirectionalPerturbation([np.eye(2)], pc.Norm([0.2], [0.1]))
    case, M = problem(memory=memory, gain=gain, perturbation=reacting), normal(1, memory, 1, 2)
    x, u, w = simulated(case, M)
    policy = pc.interop.to_control(case, M)
    assert policy.input_labels == ["level", "flow", "w:level", "w:flow"] and policy.output_labels == ["valve"]
    answer = control.forced_response(policy, np.arange(13), np.hstack([x, w]).T, squeeze=False)
    assert np.abs(answer.outputs - u.T).max() <= tolerance(1e-14, 1e-5) * np.abs(u).max()


def moving_mean(M):
    return np.array([[0.1, 0.0, 0.2], [0.0, -0.2, 0.1]]) * (1 + M[0, 0, 0])


@pytest.mark.parametrize("memory", [1, 2, 3])
@pytest.mark.parametrize("mean", [None, moving_mean])
def test_closed_loop_of_recovered_noise_is_the_simulated_one(memory, mean):
    """Plant and controller connected by python-control, from the state alone; the mean of a reaction is known to it."""
    still = pc.DirectionalPerturbation(np.zeros((1, 2, 3)), [0.0], mean=mean)
    case, M = problem(memory=memory, perturbation=still), normal(2, memory, 1, 2)
    x, u, w = simulated(case, M)
    policy = pc.interop.to_control(case, M, noise="recovered")
    assert policy.input_labels == ["level", "flow"] and policy.nstates == 2 * memory
    shift = np.zeros((2, 3)) if mean is None else np.asarray(mean(np.asarray(M)))
    inputs = ["valve", "w:level", "w:flow"]
    world = control.ss(
        A + shift[:, :2], np.hstack([B + shift[:, 2:], np.eye(2)]), np.eye(2), np.zeros((2, 3)), True,
        inputs=inputs, outputs=["level", "flow"], name="world",
    )  # fmt: skip
    loop = control.interconnect([world, policy], inputs=inputs[1:], outputs=["level", "flow", "valve"])
    start = np.concatenate([x[0], x[0], np.zeros(2 * memory - 2)])
    answer = control.forced_response(loop, np.arange(13), w.T, start, squeeze=False)
    scale = max(np.abs(x).max(), np.abs(u).max())
    assert np.abs(answer.outputs - np.hstack([x, u]).T).max() <= 1e-12 * scale


def test_controller_of_a_system_without_names_has_names_all_the_same():
    case = problem(system=pc.LinearSystem(A, B))
    policy = pc.interop.to_control(case, normal(1, 3, 1, 2), dt=0.5)
    assert policy.input_labels == ["x[0]", "x[1]", "w:x[0]", "w:x[1]"] and policy.output_labels == ["u[0]"]
    assert policy.dt == 0.5


@pytest.mark.parametrize(
    ("transform", "by_hand"),
    [
        (optax.clip_by_global_norm(0.01), lambda g, state: (g * min(1, 0.01 / np.linalg.norm(g)), state)),
        (optax.trace(0.9), lambda g, state: (g + 0.9 * state,) * 2),
        (optax.chain(optax.scale(2.0), optax.scale(0.25)), lambda g, state: (0.5 * g, state)),
    ],
    ids=["clip", "momentum", "chain"],
)
def test_optax_transformation_is_a_step_of_rsgd(transform, by_hand):
    case, steps, size = problem(memory=1), 5, 1e-3
    solution = pc.solve(case, pc.RSGD(steps, size, transform=transform), key=jax.random.key(1))
    M, state = np.asarray(case.initial_policy()), 0.0
    for step in range(steps):
        moved, state = by_hand(_gradient(case, M, step, size), state)
        M = M - size * moved
    assert_close(solution.M, M, 1e-9)


def _gradient(case, M, step, size):
    """The gradient of iteration `step` at M: a run that moves in it alone, for RSGD draws by the iteration's number."""
    key = jax.random.key(1)
    hold = optax.GradientTransformation(
        lambda params: np.zeros((), int), lambda g, n, params=None: (jax.numpy.where(n == step, g, 0 * g), n + 1)
    )
    end = pc.solve(case, pc.RSGD(step + 1, size, transform=hold), M, key=key).M
    return (M - np.asarray(end)) / size


def test_adam_of_optax_converges_to_the_stable_policy():
    case = problem(memory=1)
    stable = pc.solve(case, pc.StablePoint()).M
    solver = pc.RSGD(1500, pc.InverseStep(1.0, 20.0), batch=8, transform=optax.scale_by_adam())
    found = pc.solve(case, solver, key=jax.random.key(3)).M
    assert np.linalg.norm(found - stable) < 0.1 * np.linalg.norm(stable)


class Odd:
    pass


varying = np.broadcast_to(K, (13, 1, 2))
REFUSED = {
    "continuous": (lambda: pc.interop.from_control(control.ss(A, B, np.eye(2), 0)), "sys", "c2d"),
    "continuous of SciPy": (lambda: pc.interop.from_control(scipy.signal.lti([1.0], [1.0, 2.0])), "sys", "to_discrete"),
    "no sampling time": (lambda: pc.interop.from_control(control.ss(A, B, np.eye(2), 0, None)), "sys", "dt=True"),
    "static": (lambda: pc.interop.from_control(control.ss([], [], [], [[2.0]], True)), "sys", "at least one state"),
    "something else": (lambda: pc.interop.from_control(Odd()), "sys", "Odd", "scipy.signal.dlti"),
    "nothing": (lambda: pc.interop.from_control(None), "sys", "got None"),
    "noise": (lambda: pc.interop.to_control(problem(), np.zeros((3, 1, 2)), noise="seen"), "noise", "'seen'"),
    "policy": (lambda: pc.interop.to_control(problem(), np.zeros((2, 1, 2))), "M", "(2, 1, 2)"),
    "no problem": (lambda: pc.interop.to_control(plant(), np.zeros((3, 1, 2))), "problem", "StateSpace"),
    "varying gain": (lambda: pc.interop.to_control(problem(gain=varying), np.zeros((3, 1, 2))), "problem", "gain"),
    "varying plant": (
        lambda: pc.interop.to_control(
            problem(system=pc.LinearSystem(np.stack([A] * 12), B)), np.zeros((3, 1, 2)), noise="recovered"
        ),
        "problem",
        'noise="given"',
    ),
    "unknown mean": (
        lambda: pc.interop.to_control(
            problem(perturbation=pc.SampledPerturbation(lambda key, M: jax.numpy.zeros((12, 2, 2)))),
            np.zeros((3, 1, 2)),
            noise="recovered",
        ),
        "problem",
        "mean",
    ),
    "names": (lambda: pc.LinearSystem(A, B, state_names=["a", "a"]), "state_names", "different"),
    "too few names": (lambda: pc.LinearSystem(A, B, input_names=["a", "b"]), "input_names", "1 different"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_interop_is_refused_with_a_four_part_error(case):
    assert_refused(*case)


def test_feedback_with_a_positive_sign_closes_the_loop():
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
    names = {"states": ["level", "flow"], "outputs": ["level", "flow"], "inputs": ["valve"]}
    plant = control.ss(A, B, np.eye(2), np.zeros((2, 1)), 0.1, **names)
    system, x0 = pc.interop.from_control(plant), np.array([1.0, 0.0])
    problem = pc.PerformativeProblem(
        system=system, horizon=30, memory=2, gain=pc.design_gain(system, Q=np.eye(2), R=np.eye(1)),
        cost=pc.QuadraticCost(np.eye(2), np.eye(1)), initial_state=pc.Constant(x0), noise=pc.Constant(np.zeros(2)),
    )  # fmt: skip
    M = 0.1 * np.ones((2, 1, 2))
    loop = control.feedback(plant, pc.interop.to_control(problem, M, noise="recovered"), sign=1)
    start = np.zeros(loop.nstates)
    start[:2] = start[2:4] = x0
    response = control.forced_response(loop, 0.1 * np.arange(31), np.zeros((1, 31)), start)
    assert_close(response.outputs.T, pc.simulate(problem, M, key=jax.random.key(0)).x[0], 1e-12)
