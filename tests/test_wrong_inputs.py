"""What the public names say about wrong inputs: the argument, what is required, what was got, what to do about it."""

import jax
import numpy as np
import pytest

import perfcontrol as pc
from tests.tools import assert_refused

nan, inf = float("nan"), float("inf")
eye = np.eye(2)


def build(**changes):
    arguments = {
        "system": pc.LinearSystem(0.5 * eye, eye),
        "horizon": 3,
        "noise": pc.Gaussian(np.zeros(2), eye),
        "cost": pc.QuadraticCost(eye, eye),
    }
    return pc.PerformativeProblem(**(arguments | changes))


KINDS = {  # argument: a value of the wrong kind, words of what is required, and of the remedy
    "system": (np.eye(2), "be a linear system, such as `pc.LinearSystem(A, B)`", "Build one."),
    "cost": (lambda x, u: 0.0, "be a cost, such as `pc.QuadraticCost(Q, R)`", "subclass `pc.AbstractCost`"),
    "noise": (0.1 * eye, "be a random vector, such as `pc.Gaussian(", "subclass `pc.AbstractRandomVector`"),
    "perturbation": (eye, "be a perturbation, such as `pc.Directional", "subclass `pc.AbstractPerturbation`"),
    "feasible_set": (1.0, "be a set, such as `pc.FrobeniusBall(1.0)`", "subclass `pc.AbstractSet`"),
    "structure": (2, "be a structure, such as `pc.RepeatedBlock(2)`", "subclass `pc.AbstractStructure`"),
}


@pytest.mark.parametrize("name", KINDS)
def test_wrong_kind_of_part_is_told_what_it_is_to_be_by_an_example(name):
    value, *words = KINDS[name]
    assert_refused(lambda: build(**{name: value}), name, type(value).__name__, *words)


def test_wrong_problem_or_solver_is_told_what_it_is_to_be_by_an_example():
    assert_refused(lambda: pc.solve(build(), "RSGD"), "solver", "be a solver, such as `pc.StablePoint()`", "got str")
    for use in (
        lambda: pc.solve(None, pc.StablePoint()),
        lambda: pc.certify(None),
        lambda: pc.expected_cost(None, np.zeros((1, 2, 2))),
        lambda: pc.best_response(None, np.zeros((1, 2, 2))),
        lambda: pc.simulate(None, np.zeros((1, 2, 2)), key=jax.random.key(0)),
        lambda: pc.safe_step(None),
    ):
        assert_refused(use, "problem", "be a performative problem, such as `pc.PerformativeProblem(", "got None")


CLASSES = {  # a class where an object is meant: the argument, and the parentheses that lack
    "solver": (lambda: pc.solve(build(), pc.StablePoint), "solver", "Add parentheses: pc.StablePoint()."),
    "solver with arguments": (lambda: pc.solve(build(), pc.RSGD), "solver", "Add parentheses: pc.RSGD(...)."),
    "set": (lambda: build(feasible_set=pc.Unconstrained), "feasible_set", "pc.Unconstrained()"),
    "noise": (lambda: build(noise=pc.Gaussian), "noise", "pc.Gaussian(...)"),
    "initial state": (lambda: build(initial_state=pc.Uniform), "initial_state", "pc.Uniform(...)"),
    "perturbation": (lambda: build(perturbation=pc.NoPerturbation), "perturbation", "pc.NoPerturbation()"),
    "structure": (lambda: build(structure=pc.FullStructure), "structure", "pc.FullStructure()"),
    "certificate": (lambda: pc.certify(build(), pc.Sharp), "kind", "pc.Sharp()"),
    "gradient": (lambda: pc.RSGD(3, 0.1, gradient=pc.Exact), "gradient", "pc.Exact()"),
    "schedule": (lambda: pc.RSGD(3, 0.1, schedule=pc.Lazy), "schedule", "pc.Lazy(...)"),
    "step": (lambda: pc.RSGD(3, pc.InverseStep), "step_size", "pc.InverseStep(...)"),
    "law": (lambda: pc.DensePerturbation(0.1, law=pc.Rademacher), "law", "pc.Rademacher(...)"),
    "law of a linear image": (lambda: pc.Linear(pc.Gaussian, eye), "law", "pc.Gaussian(...)"),
    "member": (lambda: pc.Intersection([pc.Box(0, 1), pc.Unconstrained]), "sets[1]", "pc.Unconstrained()"),
}


@pytest.mark.parametrize("case", CLASSES)
def test_class_in_place_of_an_object_is_told_to_add_parentheses(case):
    call, name, parentheses = CLASSES[case]
    assert_refused(call, name, "the class", "Add parentheses", parentheses)


def test_class_of_another_kind_is_not_told_to_add_parentheses():
    assert_refused(lambda: build(system=pc.Box), "system", "the class Box", "Build one.")
    assert_refused(lambda: build(cost=pc.AbstractCost), "cost", "the class AbstractCost", "Build one")


NUMBERS = {  # what is not finite, and the remedy that fits
    "radius missing": (lambda: pc.FrobeniusBall(nan), "radius", "got nan", "Pass a finite number."),
    "radius infinite": (lambda: pc.FrobeniusBall(inf), "radius", "got inf", "pc.Unconstrained()"),
    "spectral radius infinite": (lambda: pc.SpectralBall(np.float64(inf)), "radius", "got inf", "pc.Unconstrained()"),
    "step missing": (lambda: pc.RSGD(10, nan), "step_size", "got nan", "Pass a finite number."),
    "phi infinite": (lambda: pc.InverseStep(inf, 1.0), "phi1", "got inf", "Pass a finite number."),
    "matrix": (
        lambda: pc.LinearSystem([[nan]], [[1.0]]),
        "A",
        "nan at index [0, 0]",
        "Replace what is infinite or mis",
    ),
    "samples": (lambda: pc.Empirical([[0.0], [nan]]), "samples", "nan at index [1, 0]", "Leave out the rows"),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_number_that_is_not_finite_meets_a_remedy_that_fits(case):
    call, name, *words = NUMBERS[case]
    assert_refused(call, name, *words)


def broken(*arguments):
    raise KeyError("prices")


def branching(M):
    return 1.0 if M.sum() > 0 else 2.0


SHAPE = "M of shape (1, 2, 2)"
MAPS = {  # what fails inside a user's own function: the argument it was passed as, and what it was given
    "scale": (lambda: build(perturbation=pc.DensePerturbation(broken)), "scale", SHAPE, "lifted policy"),
    "mean": (lambda: build(perturbation=pc.DensePerturbation(1.0, mean=broken)), "mean", SHAPE),
    "direction": (lambda: build(perturbation=pc.DirectionalPerturbation(eye[None], broken)), "scale", SHAPE),
    "probabilities": (
        lambda: build(perturbation=pc.FinitePerturbation(eye[None], broken)),
        "probabilities",
        SHAPE,
    ),
    "noise": (lambda: build(noise=broken), "noise", SHAPE),
    "parameters": (lambda: build(noise=pc.Function(broken, 1.0)), "noise", SHAPE),
    "sampler": (lambda: build(perturbation=pc.SampledPerturbation(broken)), "sampler", "a key", SHAPE),
    "cost": (lambda: build(cost=pc.ConvexCost(broken)), "function", "t, x of shape (2,), u of shape (2,)"),
    "record": (
        lambda: pc.solve(build(), pc.StablePoint(), record=broken),
        "record",
        "free_parameters of shape (1, 2, 2)",
    ),
    "step": (lambda: pc.solve(build(), pc.RSGD(3, broken, gradient=pc.Exact())), "step_size", "accept n"),
}


@pytest.mark.parametrize("case", MAPS)
def test_error_inside_a_function_of_the_user_says_which_one_with_what_it_was_given_and_its_cause(case):
    call, name, *words = MAPS[case]
    assert_refused(call, name, "KeyError from it", "'prices'", "its own error stands above", *words)
    with pytest.raises(pc.InputError) as caught:
        call()
    assert isinstance(caught.value.__cause__, KeyError)


def test_function_that_looks_at_numbers_while_it_is_compiled_is_told_how_to_be_written():
    assert_refused(
        lambda: build(perturbation=pc.DensePerturbation(branching)), "scale", "TracerBool", "jnp.where instead of if"
    )
    assert_refused(lambda: build(noise=lambda M: pc.Rademacher(float(M[0, 0, 0]))), "noise", "jax.numpy")


def test_error_of_the_package_inside_a_function_of_the_user_keeps_its_argument_and_notes_the_function():
    with pytest.raises(pc.InputError, match="`value` must be a vector") as caught:
        build(noise=lambda M: pc.Constant(M))
    assert "Raised inside `noise`, which was given M of shape (1, 2, 2)." in caught.value.__notes__


def test_value_of_a_users_function_that_is_no_array_or_no_number_is_refused():
    assert_refused(lambda: build(perturbation=pc.DensePerturbation(lambda M: "high")), "scale", "TypeError")
    steps = pc.RSGD(3, lambda n: np.ones(2), gradient=pc.Exact())
    assert_refused(lambda: pc.solve(build(), steps), "step_size", "values of shape (2,)")
    assert_refused(lambda: pc.solve(build(), pc.StablePoint(), record=lambda M: "M"), "record", "TypeError")


def test_interruption_inside_a_function_of_the_user_passes():
    def interrupted(M):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(noise=interrupted)
