"""The kernel in C++ against the package's own loops on the same keys, and what is said where there is no compiler."""

import ctypes
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import perfcontrol as pc
from perfcontrol.evaluate.adjoint import mean_path_gradient
from perfcontrol.evaluate.paths import lanes
from perfcontrol.kernel import library
from perfcontrol.perturbations import redrawn
from tests.tools import assert_close, assert_refused, normal, random_psd

pytestmark = [
    pytest.mark.float32,
    pytest.mark.skipif(not any(map(shutil.which, library.COMPILERS)), reason="there is no C++ compiler"),
]
LAWS = ("rademacher", "uniform", "truncated_gaussian", "gaussian", "sphere")
N, INPUTS, T = 5, 3, 9


def plain_problem(law="uniform", **changes):
    scale = lambda M: 0.1 * jnp.sqrt(1 + jnp.sum(M**2))  # noqa: E731
    parts = {
        "system": pc.LinearSystem(0.3 * normal(0, N, N), normal(1, N, INPUTS)),
        "horizon": T,
        "memory": 2,
        "gain": 0.1 * normal(2, INPUTS, N),
        "noise": pc.Gaussian(0.1 * normal(3, N), np.eye(N)),
        "cost": pc.QuadraticCost(random_psd(4, N), random_psd(5, INPUTS)),
        "perturbation": pc.DensePerturbation(scale, law=law),
        "initial_state": pc.Gaussian(np.ones(N), np.eye(N)),
    }
    return pc.PerformativeProblem(**(parts | changes))


def everything_varies():
    joint = random_psd(6, N + INPUTS, T + 1)
    return plain_problem(
        system=pc.LinearSystem(0.3 * normal(7, T, N, N), normal(8, T, N, INPUTS)),
        gain=0.1 * normal(9, T + 1, INPUTS, N),
        cost=pc.QuadraticCost(
            joint[:, :N, :N],
            joint[:, N:, N:],
            cross=joint[:, :N, N:],
            state_target=normal(10, T + 1, N),
            input_target=normal(11, INPUTS),
            discount=0.9,
        ),
        perturbation=pc.DensePerturbation(
            lambda M: 0.1 * jnp.arange(1.0, T + 1) * (1 + jnp.sum(M**2)), mean=0.1 * normal(12, T, N, N)
        ),
    )


def spheres_from_rest():
    """From x_0 = 0, where the direction of x is none, about a mean."""
    dense = pc.DensePerturbation(0.2, mean=0.1 * normal(13, N, N), law="sphere")
    return plain_problem(perturbation=dense, initial_state=pc.Constant(np.zeros(N)), noise=pc.Rademacher(np.ones(N)))


def spheres_through_rest():
    """A state that comes to rest and goes on: what a matrix makes of it in the pass back has no direction."""
    policy = np.asarray(0.2 * normal(20, 1, 2, 2))[0]  # that of `policies`
    noise = np.array([[1.0, 0.0], [0.0, 0.0], [0.3, 0.4], [0.1, -0.2]])
    noise[1] = -policy[:, 0]  # without rounding
    return pc.PerformativeProblem(
        system=pc.LinearSystem(np.zeros((2, 2)), np.eye(2)),
        horizon=4,
        noise=pc.Sequence(noise),
        cost=pc.QuadraticCost(np.eye(2), np.eye(2)),
        perturbation=pc.DensePerturbation([0.3, 0.0, 0.3, 0.3], law="sphere"),
    )


CASES = {
    **{law: (lambda law=law: plain_problem(law)) for law in LAWS},
    "everything varies": everything_varies,
    "spheres from rest": spheres_from_rest,
    "spheres through rest": spheres_through_rest,
    "no perturbation, noise that reacts": lambda: plain_problem(
        perturbation=pc.NoPerturbation(),
        noise=lambda M: pc.Uniform(-1 - jnp.sum(M**2) * jnp.arange(N), np.arange(N)),
    ),
    "diagonal": lambda: plain_problem(
        system=pc.LinearSystem.diagonal(0.5 * np.ones(N), np.ones(N)),
        gain=0,
        cost=pc.QuadraticCost(np.eye(N), np.eye(N)),
        structure=pc.RepeatedBlock(N),
    ),
    "one state": lambda: pc.PerformativeProblem(
        system=pc.LinearSystem(np.full((1, 1), 0.5), np.ones((1, 1))),
        horizon=2,
        noise=pc.Rademacher(np.ones(1)),
        cost=pc.QuadraticCost(np.eye(1), np.eye(1)),
        perturbation=pc.DensePerturbation(0.3, law="uniform"),
    ),
    "more registers than one": lambda: pc.PerformativeProblem(
        system=pc.LinearSystem(0.1 * normal(14, 37, 37), normal(15, 37, 2)),
        horizon=4,
        noise=pc.Rademacher(np.ones(37)),
        cost=pc.QuadraticCost(np.eye(37), np.eye(2)),
        perturbation=pc.DensePerturbation(0.02, law="uniform"),
    ),
}
DEFAULT = ("gaussian",)  # with JAX's default keys, too
WITH_COST = ("everything varies",)
COMPARED = [*CASES, *(f"{name}, default key" for name in DEFAULT), *(f"{name}, cost" for name in WITH_COST)]


class LouderDense(pc.DensePerturbation):
    def sample(self, key, M, horizon):
        return jax.tree.map(lambda leaf: 2 * leaf, super().sample(key, M, horizon))


class DoubledCost(pc.QuadraticCost):
    def path_cost(self, x, u):
        return 2 * super().path_cost(x, u)


UNSERVED = {
    "a subclass that draws otherwise": lambda: plain_problem(perturbation=LouderDense(0.1)),
    "a subclass that costs otherwise": lambda: plain_problem(cost=DoubledCost(np.eye(N), np.eye(INPUTS))),
    "another cost": lambda: plain_problem(cost=pc.ConvexCost(lambda t, x, u: x @ x + u @ u)),
    "on the input": lambda: plain_problem(perturbation=pc.DensePerturbation(0.1, on_input=True)),
    "directions": lambda: plain_problem(perturbation=pc.DirectionalPerturbation(0.1 * normal(16, 2, N, N), np.ones(2))),
}


@pytest.fixture(scope="module")
def kernel(tmp_path_factory):
    """Switches the kernel on and off, compiled into a folder of the tests."""
    before = os.environ.get("PERFCONTROL_CACHE")
    os.environ["PERFCONTROL_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    yield pc.use_kernel
    pc.use_kernel(False)
    os.environ.pop("PERFCONTROL_CACHE")
    if before is not None:
        os.environ["PERFCONTROL_CACHE"] = before


def policies(problem):
    return 0.2 * normal(20, *problem.policy_shape), 0.3 * normal(21, *problem.policy_shape)


def sampled(problem, key):
    """A gradient by 17 paths: some registers and one path more."""
    M, deployed = policies(problem)
    return pc.sample_gradient(problem, M, deployed=deployed, key=key, samples=17)


def cost(problem):
    """Of 6 paths, where a register is not full."""
    M, deployed = policies(problem)
    return pc.estimate_cost(problem, M, deployed=deployed, key=pc.fast_key(9), samples=6)


@pytest.fixture(scope="module")
def answers(kernel):
    """What the cases and the other users say without the kernel and with it: one switch for all."""
    problems = {name: build() for name, build in CASES.items()}

    def everything():
        said = {name: sampled(problem, pc.fast_key(1)) for name, problem in problems.items()}
        said |= {f"{name}, default key": sampled(problems[name], jax.random.key(1)) for name in DEFAULT}
        said |= {f"{name}, cost": cost(problems[name]) for name in WITH_COST}
        return said | {"users": users(problems["uniform"]), "nested": nested(problems["everything varies"])}

    without = everything()
    kernel(True)
    used = str(jax.make_jaxpr(lambda M, key: mean_path_gradient(problems["uniform"], M, M, key, 2))(
        policies(problems["uniform"])[0], pc.fast_key(1)
    ))  # fmt: skip
    return without, everything(), used


def users(problem):
    """RSGD alone, many runs of it, and a derivative through a gradient."""
    M, deployed = policies(problem)
    solver = pc.RSGD(20, 0.001)
    one = pc.solve(problem, solver, key=pc.fast_key(2))
    many = pc.solve_many(problem, solver, keys=jax.random.split(pc.fast_key(3), 5))
    norm = lambda M: jnp.sum(pc.sample_gradient(problem, M, deployed=deployed, key=pc.fast_key(4), samples=3) ** 2)  # noqa: E731
    return [one.M, many.M, jax.grad(norm)(M)]


def nested(problem):
    """Policies, keys and a coefficient of the problem, each along an axis of its own."""
    M, deployed = policies(problem)
    keys = jax.random.split(pc.fast_key(5), 3)

    def gradient(factor, M, key):
        system = pc.LinearSystem(factor * problem.system.A, problem.system.B)
        return mean_path_gradient(plain_like(problem, system), M, deployed, key, 1)

    over_keys = jax.vmap(gradient, in_axes=(None, None, 0))
    over_policies = jax.vmap(over_keys, in_axes=(None, 0, None))
    return jax.jit(jax.vmap(over_policies, in_axes=(0, None, None)))(
        jnp.array([0.5, 1.0]), jnp.stack([M, 2 * M, 3 * M]), keys
    )


def plain_like(problem, system):
    names = ("horizon", "memory", "gain", "noise", "cost", "perturbation", "initial_state", "structure")
    return pc.PerformativeProblem(system=system, **{name: getattr(problem, name) for name in names})


@pytest.mark.parametrize("name", COMPARED)
def test_kernel_gives_the_numbers_of_the_packages_own_loops(name, answers):
    without, by_kernel, _ = answers
    for one, other in zip(*map(jax.tree.leaves, (without[name], by_kernel[name])), strict=True):
        assert np.all(np.isfinite(one))
        assert_close(other, one, 1e-12, 1e-4)


def test_kernel_is_used_where_it_is_switched_on(answers):
    without, by_kernel, used = answers
    assert library.TARGET in used
    pairs = zip(*map(jax.tree.leaves, (without, by_kernel)), strict=True)
    assert any(np.any(np.asarray(one) != np.asarray(other)) for one, other in pairs)  # they differ in rounding


@pytest.mark.parametrize("number", [0, 1, 2])
def test_methods_and_derivatives_are_the_same_with_the_kernel(number, answers):
    without, by_kernel, _ = answers
    assert_close(by_kernel["users"][number], without["users"][number], 1e-10, 1e-3)


def test_kernel_works_under_any_nesting_of_vmap(answers):
    without, by_kernel, _ = answers
    assert by_kernel["nested"].shape == (2, 3, 3, 2, INPUTS, N)
    assert_close(by_kernel["nested"], without["nested"], 1e-11, 1e-4)


@pytest.mark.parametrize("law", ["uniform", "rademacher"])
def test_matrices_too_many_to_hold_are_those_that_are_drawn_again(law, kernel, monkeypatch):
    monkeypatch.setattr(redrawn, "HELD", 1)
    problem = plain_problem(law)
    M, deployed = policies(problem)
    key = pc.fast_key(6)
    both = []
    for on in (False, True):
        kernel(on)
        both.append(np.asarray(pc.sample_gradient(problem, M, deployed=deployed, key=key, samples=17)))
    monkeypatch.undo()
    jax.clear_caches()
    assert_close(both[1], both[0], 1e-12, 1e-4)
    assert np.any(both[1] != np.asarray(pc.sample_gradient(problem, M, deployed=deployed, key=key, samples=17)))


def test_matrices_too_many_to_hold_that_the_kernel_does_not_draw_are_left_to_the_package(kernel, monkeypatch):
    monkeypatch.setattr(redrawn, "HELD", 1)
    kernel(True)
    problem = plain_problem("truncated_gaussian")
    M, deployed = policies(problem)
    traced = jax.make_jaxpr(lambda M: mean_path_gradient(problem, M, deployed, pc.fast_key(7), 2))(M)
    assert library.TARGET not in str(traced)


@pytest.mark.float32
def test_kernel_is_given_few_paths_where_they_are_long(kernel):
    kernel(True)
    register = 64 // jnp.zeros(()).dtype.itemsize
    assert lanes(plain_problem(), along=True) == 4 * register
    assert lanes(plain_problem().truncated(50_000), along=True) == register
    assert lanes(plain_problem().truncated(1_000_000), along=True) == 1


@pytest.mark.parametrize("name", UNSERVED)
def test_other_problems_are_left_to_the_package(name, kernel):
    kernel(True)
    problem = UNSERVED[name]()
    M, deployed = policies(problem)
    traced = jax.make_jaxpr(lambda M: mean_path_gradient(problem, M, deployed, pc.fast_key(7), 2))(M)
    assert library.TARGET not in str(traced)


def test_what_is_not_finite_stays_so(kernel):
    kernel(True)
    problem = plain_problem(system=pc.LinearSystem(1e30 * np.eye(N), normal(1, N, INPUTS)), horizon=40, gain=0)
    M, _ = policies(problem)
    assert not np.any(np.isfinite(pc.sample_gradient(problem, M, key=pc.fast_key(8), samples=4)))
    ended = pc.solve(problem, pc.RSGD(3, 0.1), key=pc.fast_key(8), throw=False)
    assert ended.result == pc.Result.nonfinite
    assert np.all(np.isfinite(ended.M))


def test_run_begun_without_the_kernel_does_not_go_on_with_it(kernel, tmp_path):
    problem, solver = plain_problem(), pc.RSGD(4, 0.001)

    class StoppedError(Exception):
        pass

    def stop(done, total):
        raise StoppedError

    def begin(progress=None):
        return pc.solve(problem, solver, key=pc.fast_key(9), checkpoint=tmp_path / "run", progress=progress)

    kernel(False)
    with pytest.raises(StoppedError):
        begin(stop)
    kernel(True)
    assert_refused(begin, "checkpoint", "kernel in use")


def test_every_normal_number_is_that_of_jax_to_rounding(tmp_path):
    """All 2²³ of them, in single precision."""
    source, probe = tmp_path / "probe.cc", tmp_path / "probe.so"
    source.write_text("""
#include "random.h"
extern "C" void all(float* out) {
  for (uint32_t digits = 0; digits < (1u << 23); ++digits) out[digits] = perfcontrol::NormalOf(digits << 9);
}
""")
    compiler = next(filter(shutil.which, library.COMPILERS))
    flags = ["-std=c++17", "-O2", "-shared", "-fPIC", f"-I{library.SOURCES}"]
    subprocess.run([compiler, *flags, str(source), "-o", str(probe)], check=True)
    ours = np.empty(2**23, np.float32)
    ctypes.CDLL(str(probe)).all(ours.ctypes.data_as(ctypes.c_void_p))
    digits = np.arange(2**23, dtype=np.float32) * np.float32(2.0**-23)
    lowest = np.nextafter(np.float32(-1), np.float32(0))
    number = np.maximum(lowest, digits * np.float32(2) + lowest)
    theirs = np.sqrt(np.float32(2)) * np.asarray(jax.scipy.special.erfinv(number))
    assert np.max(np.abs(ours - theirs)) < 3e-5  # of which JAX's own error is the larger part
    exact = np.sqrt(2) * scipy.special.erfinv(number.astype(float))
    assert np.max(np.abs(ours - exact)) < 2e-6


# --- the compiler ----------------------------------------------------------------------------------------------------


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """A machine where nothing was compiled yet."""
    monkeypatch.setenv("PERFCONTROL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(library._Switch, "loaded", False)
    monkeypatch.setattr(library._Switch, "on", False)
    return tmp_path


def script(folder: Path, body: str) -> str:
    path = folder / "compiler"
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return str(path)


def test_machine_without_compiler_is_told_so(fresh, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(fresh))
    assert_refused(pc.use_kernel, "CXX", "none of c++", "Install one, such as g++")
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert_refused(pc.use_kernel, "CXX", "no-such-compiler")
    assert not library.in_use()


def test_compiler_that_fails_is_quoted_and_leaves_nothing(fresh, monkeypatch):
    monkeypatch.setenv("CXX", script(fresh, "echo 'paths.cc:1: error: no such header' >&2; exit 1"))
    assert_refused(pc.use_kernel, "CXX", "error: no such header", "only slower")
    assert not list((fresh / "cache").rglob("*.so"))
    assert not library.in_use()


def test_library_that_does_not_load_is_compiled_again_and_then_told(fresh, monkeypatch):
    last = 'for last; do :; done; echo called >> "$(dirname "$0")/calls"; echo library > "$last"'
    monkeypatch.setenv("CXX", script(fresh, last))
    assert_refused(pc.use_kernel, "PERFCONTROL_CACHE", "library that loads", ".so")
    assert (fresh / "calls").read_text().count("called") == 2


def test_library_that_others_could_have_written_is_not_loaded(fresh, monkeypatch):
    last = 'for last; do :; done; echo called >> "$(dirname "$0")/calls"; echo library > "$last"'
    monkeypatch.setenv("CXX", f"{script(fresh, last)} --with option")
    library.compiled().chmod(0o666)
    assert library.compiled().stat().st_mode & 0o022 == 0
    assert (fresh / "calls").read_text().count("called") == 2


def test_folder_that_cannot_be_written_is_told(fresh, monkeypatch):
    (fresh / "cache").write_text("a file")
    assert_refused(pc.use_kernel, "PERFCONTROL_CACHE", "can be written to")


def test_library_is_compiled_once_and_again_for_another_source(fresh, monkeypatch):
    last = 'for last; do :; done; echo called >> "$(dirname "$0")/calls"; echo library > "$last"'
    monkeypatch.setenv("CXX", script(fresh, last))
    first = library.compiled()
    assert library.compiled() == first
    sources = shutil.copytree(library.SOURCES, fresh / "source")
    (sources / "random.h").write_text("// another")
    monkeypatch.setattr(library, "SOURCES", sources)
    assert library.compiled() != first
    assert (fresh / "calls").read_text().count("called") == 2


def test_processor_that_the_compiler_does_not_know_gets_the_common_code(fresh, monkeypatch):
    refuse = 'case "$*" in *native*) echo "error: unknown processor" >&2; exit 1;; esac'
    body = f'{refuse}; for last; do :; done; echo > "$last"'
    monkeypatch.setenv("CXX", script(fresh, body))
    assert library.compiled().exists()


def test_command_line_switches_the_kernel_on_by_a_variable(kernel):
    kernel(True)  # compiled by now
    code = "from perfcontrol.cli.app import *; configure_jax(); from perfcontrol.kernel import *; print(in_use())"
    for value, said in (("1", "True"), ("0", "False")):
        environment = os.environ | {"PERFCONTROL_KERNEL": value}
        run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        assert run.stdout.strip() == said
