"""Whatever a file holds: a problem, or one InputError."""

import copy
import tomllib

import hypothesis.strategies as st
import numpy as np
from hypothesis import HealthCheck, given, settings

import perfcontrol as pc
from perfcontrol.cli.new import TEMPLATES
from perfcontrol.files.registry import ROWS
from perfcontrol.files.writing import toml_text

BASES = [path.read_text() for path in TEMPLATES.values()]
LITTLE = {"max_examples": 50, "deadline": None, "suppress_health_check": [HealthCheck.function_scoped_fixture]}

numbers = st.one_of(
    st.integers(-3, 5),
    st.floats(),
    st.sampled_from([0, -1, 1e308, 2**63, 10**30, float("inf"), float("nan")]),
)
texts = st.one_of(st.sampled_from([*ROWS, "Function", "a.csv", "../a.npy", "rademacher", ""]), st.text(max_size=5))
arrays = st.builds(
    lambda shape, value: np.full(shape, value).tolist(), st.lists(st.integers(0, 3), max_size=4), st.floats(-2, 2)
)
leaves = st.one_of(numbers, texts, st.booleans(), arrays)
keys = st.sampled_from(sorted({"type", "x", *(name for row in ROWS.values() for name in row.arguments)}))
values = st.recursive(
    leaves, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=4), max_leaves=6
)


def opened(path):
    """A problem, or the error that a user sees; anything else is a fault of ours."""
    try:
        return pc.load(path)
    except pc.InputError as error:
        assert path.name in str(error)
        return error


@settings(**LITTLE)
@given(st.binary(max_size=60))
def test_any_bytes_are_refused_in_words(tmp_path, content):
    path = tmp_path / "fuzz.toml"
    path.write_bytes(content)
    assert isinstance(opened(path), pc.InputError)
    path = tmp_path / "fuzz.npz"
    path.write_bytes(content)
    assert isinstance(opened(path), pc.InputError)
    array = tmp_path / "a.npy"
    array.write_bytes(b"\x93NUMPY\x01\x00" + content)
    path = tmp_path / "array.toml"
    path.write_text(BASES[0].replace("radius = 1.0", 'radius = "a.npy"'))
    opened(path)


@settings(**LITTLE)
@given(st.sampled_from(BASES), st.integers(0, 10**4), st.integers(0, 40), st.text(max_size=6))
def test_files_with_a_slip_of_the_pen_open_or_are_refused_in_words(tmp_path, base, at, count, inserted):
    at %= len(base)
    path = tmp_path / "fuzz.toml"
    path.write_text(base[:at] + inserted + base[at + count :], encoding="utf-8", errors="replace")
    opened(path)


@settings(**LITTLE)
@given(st.data())
def test_files_with_other_values_anywhere_open_or_are_refused_in_words(tmp_path, data):
    tables = copy.deepcopy(tomllib.loads(data.draw(st.sampled_from(BASES))))
    for _ in range(data.draw(st.integers(1, 3))):
        inside = tables
        while True:
            name = data.draw(st.one_of(st.sampled_from(sorted(inside)), keys) if inside else keys)
            if not isinstance(inside.get(name), dict) or data.draw(st.booleans()):
                break
            inside = inside[name]
        if name in inside and data.draw(st.booleans()):
            del inside[name]
        else:
            inside[name] = data.draw(values)
    path = tmp_path / "fuzz.toml"
    path.write_text(toml_text(tables, "fuzz", {}), encoding="utf-8", errors="replace")
    opened(path)
