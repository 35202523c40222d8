"""In which line of a TOML text a key stands: the standard library's reader does not say."""

import re
from collections.abc import Iterator

Key = tuple[str | int, ...]

_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_STRING = re.compile(r'"""(?:[^\\]|\\.)*?"{3,5}|\'\'\'.*?\'{3,5}|"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'', re.DOTALL)
_BARE = re.compile(r"[^,\]}\n#]+")
_NAME = re.compile(r"[A-Za-z0-9_-]+")
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|U([0-9a-fA-F]{8})|(.))", re.DOTALL)
_ESCAPED = {"b": "\b", "t": "\t", "n": "\n", "f": "\f", "r": "\r", "e": "\x1b"}


def lines_of(text: str) -> dict[Key, int]:
    """The line, from 1, of every key and list element of a valid document; integers count elements of lists."""
    return dict(_Scanner(text).document())


class _Scanner:
    def __init__(self, text: str):
        self.text, self.position = text, 0
        self.line, self.counted = 1, 0  # the line of the character before which newlines have been counted

    def document(self) -> Iterator[tuple[Key, int]]:
        table: Key = ()
        lists: dict[Key, int] = {}  # tables in a list so far, [[key]]
        while self.blank():
            if self.text[self.position] != "[":
                yield from self.pair(table)
                continue
            double = self.text.startswith("[[", self.position)
            self.position += 1 + double
            line, names = self.here(), self.key()
            table = ()
            for i, name in enumerate(names):
                table += (name,)
                if double and i == len(names) - 1:
                    lists[table] = lists.get(table, -1) + 1
                yield table, line
                if table in lists:
                    table += (lists[table],)
            yield table, line
            self.position += 1 + double

    def pair(self, table: Key) -> Iterator[tuple[Key, int]]:
        line, names = self.here(), self.key()
        for end in range(1, len(names) + 1):
            yield table + names[:end], line
        self.position += 1  # the equals sign
        yield from self.value(table + names)

    def value(self, key: Key) -> Iterator[tuple[Key, int]]:
        self.blank()
        opening = self.text[self.position]
        if opening in "[{":
            self.position += 1
            index = 0
            while self.blank() and self.text[self.position] not in "]}":
                if opening == "{":
                    yield from self.pair(key)
                else:
                    yield (*key, index), self.here()
                    yield from self.value((*key, index))
                self.blank()
                self.position += self.text[self.position] == ","
                index += 1
            self.position += 1
            return
        match = _STRING.match(self.text, self.position) or _BARE.match(self.text, self.position)
        assert match is not None
        self.position = match.end()

    def key(self) -> tuple[str, ...]:
        names: list[str] = []
        while True:
            self.blank()
            quoted = self.text[self.position] in "\"'"
            match = (_STRING if quoted else _NAME).match(self.text, self.position)
            assert match is not None
            self.position = match.end()
            name = match[0]
            names.append(name if not quoted else _unescaped(name[1:-1]) if name[0] == '"' else name[1:-1])
            self.blank()
            if self.text[self.position] != ".":
                return tuple(names)
            self.position += 1

    def blank(self) -> bool:
        """Skip white space and comments; whether anything follows."""
        match = _BLANK.match(self.text, self.position)
        assert match is not None
        self.position = match.end()
        return self.position < len(self.text)

    def here(self) -> int:
        self.line += self.text.count("\n", self.counted, self.position)
        self.counted = self.position
        return self.line


def _unescaped(text: str) -> str:
    def plain(match: re.Match[str]) -> str:
        code = match[1] or match[2]
        return chr(int(code, 16)) if code else _ESCAPED.get(match[3], match[3])

    return _ESCAPE.sub(plain, text)
