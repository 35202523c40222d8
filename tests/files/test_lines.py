"""Lines of keys, against texts in which every value says its own line."""

import tomllib

import hypothesis.strategies as st
from hypothesis import given, settings

from perfcontrol.files.lines import lines_of

TEXT = '''\
a = 1
"b c".d = 2  # [not] = "a table"
e = [
  3,  # ]
  [4,
   5],
  "x # no comment ] \\" }",
]

[f]
g = """seven lines
[h]
i = 3
"""
j = { k = 15, "l\\u0041" = [15, { m = 15 }], }

[f.n]
o = \'\'\'it's
[p]\'\'\'
q = 1979-05-27 07:32:00
[[r]]
s = 22
[[r]]
s = 24
[r.t]
u = 26
[[r.v]]
w = 28
[[r.v]]
w = 30
'''.replace(", }", " }")


def walk(value, key=()):
    """Keys and values of tables and lists."""
    for name, item in value.items() if isinstance(value, dict) else enumerate(value):
        yield (*key, name), item
        if isinstance(item, dict | list):
            yield from walk(item, (*key, name))


def test_every_key_is_found_where_it_stands():
    lines = lines_of(TEXT)
    for key, value in walk(tomllib.loads(TEXT)):
        assert key in lines, key
        if isinstance(value, int) and value > 5:
            assert lines[key] == value, key
    for key, line in {("a",): 1, ("b c", "d"): 2, ("e",): 3, ("e", 0): 4, ("e", 1, 1): 6, ("f", "g"): 11}.items():
        assert lines[key] == line
    for key, line in {("f", "n", "o"): 18, ("f", "n", "q"): 20, ("r", 1, "t"): 25, ("r", 1, "v", 1): 29}.items():
        assert lines[key] == line


names = st.text("abc-_1", min_size=1, max_size=3)
scalars = st.one_of(st.integers(), st.booleans(), st.floats(allow_nan=False), st.text('ab"#[]{}=,\\', max_size=6))
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3))


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(names, values, max_size=5))
def test_every_key_of_any_document_has_the_line_where_its_name_stands(tables):
    from perfcontrol.files.writing import toml_text

    text = toml_text(tables, "x", {})
    assert tomllib.loads(text) == tables
    rows, lines = text.split("\n"), lines_of(text)
    for key, _ in walk(tables):
        if isinstance(key[-1], str) and not any(isinstance(part, int) for part in key[:-1]):
            assert key[-1] in rows[lines[key] - 1]
