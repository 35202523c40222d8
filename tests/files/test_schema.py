"""The JSON schema, as an independent validator reads it, against what the package itself accepts."""

import json
import re
import tomllib
from pathlib import Path

import fastjsonschema
import pytest

import perfcontrol as pc
from perfcontrol.cli.new import TEMPLATES
from perfcontrol.files.schema import schema


@pytest.fixture(scope="module")
def valid():
    return fastjsonschema.compile(json.loads(json.dumps(schema())))


@pytest.mark.parametrize("name", TEMPLATES)
def test_templates_are_valid_and_load(name, valid):
    valid(tomllib.loads(TEMPLATES[name].read_text("utf-8")))
    assert isinstance(pc.load(TEMPLATES[name]), pc.PerformativeProblem)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("horizon = 50", 'horizon = "50"'),
        ("memory = 2", "memroy = 2"),
        ("memory = 2", "memory = 2.5"),
        ('type = "Uniform"', 'type = "Unifrom"'),
        ('type = "Uniform"', 'type = "Box"'),
        ("low = -1.0", ""),
        ("squared = true", 'squared = "yes"'),
        ("radius = 1.0", 'radius = "B.mat"'),
        ("radius = 1.0", "raduis = 1.0"),
        ("[noise]", "[nose]"),
        ('type = "StablePoint"', 'type = "StablePoint"\nsteps = 3'),
    ],
)
def test_what_the_package_refuses_by_shape_the_schema_refuses(old, new, valid, tmp_path):
    base = TEMPLATES["reacting"].read_text("utf-8")
    assert base.count(old + "\n") + base.count(old + " ") == 1
    (tmp_path / "wrong.toml").write_text(base.replace(old, new), "utf-8")
    with pytest.raises(pc.InputError):
        pc.load(tmp_path / "wrong.toml")
    with pytest.raises(fastjsonschema.JsonSchemaException):
        valid(tomllib.loads((tmp_path / "wrong.toml").read_text("utf-8")))


def test_short_forms_are_valid(valid):
    valid({"experiment": "stock_market", "solver": "StablePoint"})
    with pytest.raises(fastjsonschema.JsonSchemaException):
        valid({"experiment": "stock_market", "horizon": 3})


def test_files_of_the_documentation_are_valid_and_load(valid, tmp_path):
    pages = [path.read_text("utf-8") for path in sorted((Path(__file__).parents[2] / "docs").glob("*.md"))]
    blocks = [block for page in pages for block in re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)]
    assert blocks
    for block in blocks:
        valid(tomllib.loads(block))
        (tmp_path / "problem.toml").write_text(block, "utf-8")
        assert isinstance(pc.load(tmp_path / "problem.toml"), pc.PerformativeProblem)
