"""The reference: every public name has its entry, and every docstring names the arguments that there are."""

import importlib.util
import inspect
import re
from pathlib import Path
from types import SimpleNamespace

import griffe
import pytest

import perfcontrol as pc

DOCS = Path(__file__).parents[1] / "docs"


def load_hooks():
    spec = importlib.util.spec_from_file_location("docs_hooks", DOCS / "hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


hooks = load_hooks()
ENTRIES = [
    (match["name"], match["members"].split())
    for page in sorted((DOCS / "reference").glob("*.md"))
    for match in hooks.REFERENCE.finditer(page.read_text(encoding="utf-8"))
]


def resolve(name):
    value = pc
    for part in name.split("."):
        value = getattr(value, part)
    return value


def test_reference_has_one_entry_for_every_public_name():
    listed = [name for name, _ in ENTRIES]
    assert len(listed) == len(set(listed)), "listed twice"
    modules = {name for name in pc.__all__ if inspect.ismodule(getattr(pc, name))}
    inside = {f"{module}.{name}" for module in modules for name in getattr(pc, module).__all__}
    # A name that lacks one: add the line `::: pc.NAME` to a page of docs/reference.
    assert set(listed) == set(pc.__all__) - modules | inside


@pytest.mark.parametrize(("name", "members"), [entry for entry in ENTRIES if entry[1]], ids=lambda value: str(value))
def test_members_shown_exist_and_are_described(name, members):
    for member in members:
        value = getattr(resolve(name), member)
        docstring = inspect.getdoc(value)
        assert docstring, f"{name}.{member}"
        if "Args:" in docstring:
            assert sections(docstring)[0] == [name for name in inspect.signature(value).parameters if name != "self"]


def sections(docstring):
    """Names under Args and Attributes."""
    parsed = griffe.Docstring(inspect.cleandoc(docstring)).parse("google", warnings=False)
    kinds = {"parameters": [], "attributes": []}
    for section in parsed:
        if section.kind.value in kinds:
            kinds[section.kind.value] += [item.name.lstrip("*") for item in section.value]
    return kinds["parameters"], kinds["attributes"]


MACHINERY = {"Fit": ("logs", "data", "gain", "estimated")}  # fields that are none of the user's business


def called_by_users(value):
    """Whether users call this name: not abstract classes, results, enumerations and exceptions."""
    is_result = inspect.isclass(value) and "Attributes:" in (value.__doc__ or "")
    return not (inspect.isabstract(value) or is_result or isinstance(value, type(pc.Result))) and not (
        inspect.isclass(value) and issubclass(value, Exception)
    )


@pytest.mark.parametrize("name", [name for name, _ in ENTRIES])
def test_documented_arguments_are_those_of_the_signature(name):
    value = resolve(name)
    arguments, attributes = sections(value.__doc__)
    if called_by_users(value):
        parameters = inspect.signature(value).parameters.values()
        named_only = all(parameter.kind is parameter.KEYWORD_ONLY for parameter in parameters)
        names = [parameter.name for parameter in parameters]
        assert arguments == names or (named_only and sorted(arguments) == sorted(names))
    elif "__dataclass_fields__" in vars(value) and not inspect.isabstract(value):
        fields = [field for field in value.__dataclass_fields__ if field not in MACHINERY.get(name, ())]
        assert attributes == fields or isinstance(value, type(pc.Result))


def test_entries_of_the_reference_are_spelt_out_for_mkdocstrings():
    text = hooks.on_page_markdown("# Title\n\n::: pc.solve\n\n::: pc.Certificate margin  \n")
    assert re.search(r"^::: perfcontrol\.solve\n    options:\n      heading: \"pc\.solve\"", text, re.MULTILINE)
    assert 'members: ["margin"]' in text and text.count("members: false") == 1


def draw(content, name="theory.md"):
    page = SimpleNamespace(file=SimpleNamespace(src_uri=name))
    return hooks.on_page_content(content, page=page)


def test_reference_shows_functions_and_classes_not_the_modules_that_hold_them():
    extensions = griffe.load_extensions(str(DOCS / "inspection.py") + ":Names")
    package = griffe.load("perfcontrol", search_paths=[str(DOCS.parent / "src")], extensions=extensions)
    kinds = {name: package[name].kind.value for name, _ in ENTRIES if package[name].kind.value == "module"}
    assert kinds == {}


def test_equations_are_drawn_aligned_and_the_source_is_gone():
    latex = r"\[ \begin{aligned} a' &amp;= \sum_{i=1}^{n} b_i \\ c &amp;= d \end{aligned} \]".replace("\\[ ", "\\[")
    drawn = draw(f'<div class="arithmatex">{latex}</div> and <span class="arithmatex">\\(x_t\\)</span>')
    assert drawn.count('class="katex"') == 2 and "arithmatex" not in drawn and "col-align-r" in drawn
    assert 'class="equation-block"' in drawn and 'class="equation-inline"' in drawn


def test_equation_that_is_not_understood_is_a_warning_so_that_a_strict_build_fails(caplog):
    content = '<span class="arithmatex">\\(\\nonsense{x}\\)</span>'
    assert draw(content) == content
    assert [record.levelname for record in caplog.records] == ["WARNING"] and "nonsense" in caplog.text


def test_scripts_of_plain_docstrings_are_set_outside_of_code_and_equations():
    text = "x_{t+1} and M^PS of <code>x_t</code>, ‖M‖_F, state_size, _private"
    assert draw(text, "reference/problems.md") == (
        "x<sub>t+1</sub> and M<sup>PS</sup> of <code>x_t</code>, ‖M‖<sub>F</sub>, state_size, _private"
    )
    assert draw(text) == text
    assert draw('<span class="arithmatex">\\(x_t\\)</span>', "reference/a.md").count("<annotation") == 1


def test_what_the_pages_need_is_in_the_site():
    style = (DOCS / "assets/katex/katex.min.css").read_text()
    fonts = set(re.findall(r"fonts/[\w-]+\.woff2", style))
    assert fonts and all((DOCS / "assets/katex" / font).is_file() for font in fonts)
