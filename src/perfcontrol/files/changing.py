"""A document with some keys changed, as `key=value` says it on a command line."""

import copy
import tomllib
from dataclasses import replace
from typing import Any

from perfcontrol._checks import InputError, fail
from perfcontrol.files.document import Document, parsed


def changed(document: Document, settings: list[str]) -> Document:
    """The document with keys set, each given as `key=value`; values as in TOML, texts also without quotation marks."""
    values: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or not key.strip():
            raise fail("--set", repr(setting), "be key=value", "Write for example --set cost.discount=0.9.")
        values[key.strip()] = value_of(text.strip())
    return changed_at(document, values)


def changed_at(document: Document, values: dict[str, Any]) -> Document:
    """The document with dotted keys set."""
    tables: dict[str, Any] = copy.deepcopy(dict(document.tables))
    for key, value in values.items():
        put(tables, key, value)
    return replace(document, tables=tables)


def value_of(text: str) -> Any:
    """A value of TOML, or a text without quotation marks."""
    try:
        tables = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        tables = {}
    if list(tables) == ["value"]:
        return tables["value"]
    parsed(f'value = "{text}"', "--set")  # what cannot even be a text is refused
    return text


def put(tables: dict[str, Any], key: str, value: Any) -> None:
    """Set a dotted key, whole numbers counting elements of lists; a text on the way is a type without arguments."""
    *way, last = key.split(".")
    inside: Any = tables
    for i, part in enumerate(way):
        try:
            if isinstance(inside, list):
                inside = inside[int(part)]
            else:
                if isinstance(inside.get(part), str):
                    inside[part] = {"type": inside[part]}
                inside = inside.setdefault(part, {})
        except (ValueError, IndexError):
            inside = None
        if not isinstance(inside, dict | list):
            raise _no_such(key, ".".join(way[: i + 1]))
    try:
        index: Any = int(last) if isinstance(inside, list) else last
        inside[index] = value
    except (ValueError, IndexError):
        raise _no_such(key, key) from None


def _no_such(key: str, part: str) -> InputError:
    return fail(
        "--set",
        f"{key}, where {part} is neither a table nor an element of a list",
        "name a key",
        "Write for example --set cost.discount=0.9.",
    )
