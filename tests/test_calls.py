"""Wrong calls of public names: what is said, and that nothing else about the names changes."""

import inspect
import pickle

import jax
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol._calls import EXAMPLES, SYNONYMS, explain_call, explain_calls, wrong_call
from tests.tools import assert_refused, normal

CALLABLE = [
    name
    for name in pc.__all__
    if callable(getattr(pc, name))
    and not inspect.isabstract(getattr(pc, name))
    and not (inspect.isclass(getattr(pc, name)) and issubclass(getattr(pc, name), Exception))
    and getattr(pc, name) is not pc.Result
]


def parameters(name):
    return list(inspect.signature(getattr(pc, name)).parameters.values())


@pytest.mark.parametrize("name", CALLABLE)
def test_every_public_name_refuses_an_unknown_keyword_and_a_missing_argument_in_four_parts(name):
    value = getattr(pc, name)
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters(name)):
        assert_refused(lambda: value(nonsense=1), "nonsense", f"pc.{name}")
    required = [p.name for p in parameters(name) if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    if required:
        assert_refused(value, required[0], f"pc.{name}", "nothing", f"{required[0]}=", *required[1:])


@pytest.mark.parametrize(
    "name", [name for name in CALLABLE if name not in ("Decision", "Fit", "ReactionTest")]
)  # which `pc.fit` and `pc.test_reaction` build
def test_missing_argument_is_shown_by_an_example_or_by_its_description(name):
    value = getattr(pc, name)
    for parameter in parameters(name):
        if parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD:
            error = wrong_call(f"pc.{name}", [parameter], (), {}, value.__doc__)
            assert not str(error).endswith("=..."), parameter.name


def test_examples_and_synonyms_speak_of_arguments_that_there_are():
    known = {parameter.name for name in CALLABLE for parameter in parameters(name)}
    assert set(EXAMPLES) <= known and set(SYNONYMS.values()) <= known


def test_misspelt_keyword_names_the_nearest_one():
    assert_refused(lambda: pc.PerformativeProblem(horizn=3), "horizn", "did you mean `horizon`?")
    assert_refused(lambda: pc.RSGD(step=0.1), "step", "`steps` or `step_size`", "`transform`")
    assert_refused(lambda: pc.RSGD(100, step=0.1), "step", "did you mean `step_size`?")
    assert_refused(lambda: pc.solve(None, None, start=1), "start", "did you mean `M0`?")
    assert_refused(lambda: pc.certify(None, "rigorous", noise_bond=1.0), "noise_bond", "did you mean `noise_bound`?")
    assert_refused(lambda: pc.experiments.stock_market(grwth=1.0), "grwth", "pc.experiments.stock_market", "`growth`")


def test_missing_argument_is_named_with_an_example_and_the_others_that_lack():
    build = {"system": pc.LinearSystem(np.eye(2), np.eye(2)), "horizon": 3}
    assert_refused(lambda: pc.PerformativeProblem(**build), "noise", "pc.Gaussian(", "`cost`")
    assert_refused(lambda: pc.FinitePerturbation(np.ones((1, 2, 2))), "probabilities", "for every feasible policy")


def test_arguments_by_position_that_belong_by_name_or_are_too_many_are_told():
    assert_refused(lambda: pc.expected_cost(None, None, None), "deployed", "by name", "deployed=")
    assert_refused(lambda: pc.PerformativeProblem(None), "system", "by name", "none may stand")
    assert_refused(lambda: pc.FrobeniusBall(1.0, 2.0), "FrobeniusBall", "at most 1 argument", "`radius`")
    assert_refused(lambda: pc.RSGD(3, steps=4), "steps", "once", "Position 1")


def test_wrong_call_is_the_type_error_of_python_as_well():
    with pytest.raises(TypeError) as caught:
        pc.StablePoint(tol=1e-3)
    assert isinstance(caught.value, pc.InputError) and caught.value.__cause__ is None


def test_type_error_from_inside_a_call_that_fits_passes_as_it_is():
    def function(a, *, b=1):
        raise TypeError("from inside")

    namespace = {"function": function}
    explain_calls("tests.module", namespace, ["function"])
    with pytest.raises(TypeError, match="from inside") as caught:
        namespace["function"](1, b=2)
    assert type(caught.value) is TypeError
    assert_refused(lambda: namespace["function"](1, c=2), "c", "tests.module.function")


def test_name_asked_for_twice_is_wrapped_once():
    initialise = pc.FrobeniusBall.__init__
    assert explain_call("perfcontrol", "solve", pc.solve) is pc.solve
    assert explain_call("perfcontrol", "FrobeniusBall", pc.FrobeniusBall).__init__ is initialise


def test_names_keep_signature_docstring_pickling_and_types():
    assert list(inspect.signature(pc.solve).parameters)[:3] == ["problem", "solver", "M0"]
    assert pc.solve.__doc__.startswith("Run a solver") and pc.solve.__name__ == "solve"
    assert pickle.loads(pickle.dumps(pc.solve)) is pc.solve
    assert list(inspect.signature(pc.RSGD).parameters)[:2] == ["steps", "step_size"]
    solver = pc.RSGD(3, 0.1)
    again = pickle.loads(pickle.dumps(solver))
    assert type(again) is type(solver) is pc.RSGD and isinstance(again, pc.AbstractSolver)
    assert jax.tree.structure(again) == jax.tree.structure(solver)


def test_names_work_under_jit_and_vmap():
    def build(radius):
        return pc.FrobeniusBall(radius=radius).project(normal(1, 1, 2, 2))

    radii = np.array([0.5, 1.0])
    assert jax.vmap(jax.jit(build))(radii).shape == (2, 1, 2, 2)


def test_subclass_of_a_public_class_may_have_arguments_of_its_own():
    class Mine(pc.FrobeniusBall):
        def __init__(self, diameter):
            super().__init__(diameter / 2)

    assert jax.tree.leaves(Mine(diameter=3.0)) == [1.5]
    with pytest.raises(TypeError, match="unexpected keyword"):
        Mine(radius=1.0)
