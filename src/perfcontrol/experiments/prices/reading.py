"""The text of a table of prices as names, dates and numbers; everything that is not one is refused with its line."""

import csv
import datetime
import gzip
import io
import math
import re
import zlib
from typing import NamedTuple

from perfcontrol._checks import fail

MISSING = {"", "-", ".", "na", "n/a", "nan", "null", "none", "#n/a"}
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_DATE = re.compile(r"(\d{4})([-/]?)(\d{2})\2(\d{2})([T ].*)?")


class Row(NamedTuple):
    """One line of the file: its number, its date, its prices (nan where missing)."""

    line: int
    date: datetime.date
    prices: list[float]


def decoded(raw: bytes) -> str:
    """The text of a file, gzip or plain."""
    if raw[:2] == b"\x1f\x8b":
        try:
            raw = gzip.decompress(raw)
        except (OSError, EOFError, zlib.error) as error:
            raise fail(
                "prices", f"a gzip file that ends early or is damaged ({error})", "be whole", "Copy it anew."
            ) from error
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        got = f"bytes that are no UTF-8, at position {error.start}"
        raise fail(
            "prices", got, "be a text file", "Save the table as CSV in UTF-8; a spreadsheet is no CSV."
        ) from error
    if "\0" in text:
        raise fail("prices", "zero bytes", "be a text file", "Save the table as CSV in UTF-8.")
    return text


def parsed(text: str) -> tuple[list[str], list[Row]]:
    """Names of the stocks, and the rows."""
    first = next((line for line in text.splitlines() if line.strip()), None)
    if first is None:
        raise fail("prices", "an empty file", "have a header row and a row a day", "Save the table as CSV anew.")
    separator = max(",;\t", key=first.count)
    if separator not in first:
        raise fail(
            "prices",
            f"the header {first.strip()[:60]!r}",
            "separate columns by commas",
            "Separate them by , or ; or tabs.",
        )
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    header: list[str] | None = None
    rows: list[Row] = []
    at = 0
    try:
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            line = reader.line_num
            if header is None:
                header = [cell.strip() for cell in cells]
                at = _date_column(header)
                continue
            if len(cells) != len(header):
                got = f"{len(cells)} cells in line {line}"
                raise fail("prices", got, f"have {len(header)} cells a line, as the header has", "Correct that line.")
            prices = [_price(cell, header[i], line) for i, cell in enumerate(cells) if i != at]
            rows.append(Row(line, _date(cells[at], line), prices))
    except csv.Error as error:
        raise fail(
            "prices", f"line {reader.line_num} ({error})", "be a CSV table", "Close its quotes, or remove them."
        ) from error
    if header is None or not rows:
        raise fail("prices", "a header alone", "have a row a day", "Add the prices below the header, one row a day.")
    return header[:at] + header[at + 1 :], rows


def _date_column(header: list[str]) -> int:
    if any(_NUMBER.fullmatch(cell) or _DATE.fullmatch(cell) for cell in header):
        got = f"numbers in the first row, {', '.join(header)[:60]!r}"
        raise fail("prices", got, "begin with a header row", "Name the columns: Date, then one name a stock.")
    lower = [cell.lower() for cell in header]
    twice = sorted({cell for cell in header if lower.count(cell.lower()) > 1 or not cell})
    at = lower.index("date") if "date" in lower else 0
    names = [cell for index, cell in enumerate(header) if index != at]
    if not all(names) or len({name.lower() for name in names}) < len(names):
        got = f"columns called {', '.join(repr(name) for name in twice)}"
        raise fail("prices", got, "name every stock once", "Rename or remove those columns.")
    return at


def _date(cell: str, line: int) -> datetime.date:
    match = _DATE.fullmatch(cell.strip())
    try:
        if match is None:
            raise ValueError("not of the form YYYY-MM-DD")
        return datetime.date(int(match[1]), int(match[3]), int(match[4]))
    except ValueError as error:
        got = f"the date {cell.strip()!r} in line {line} ({error})"
        raise fail(
            "prices",
            got,
            "have dates as YYYY-MM-DD",
            "Write 2024-01-31 for the last of January: other orders are ambiguous.",
        ) from error


def _price(cell: str, column: str, line: int) -> float:
    cell = cell.strip()
    if cell.lower() in MISSING:
        return math.nan
    value = float(cell) if _NUMBER.fullmatch(cell) else math.nan
    if not math.isfinite(value):
        got = f"{cell[:40]!r} for {column} in line {line}"
        remedy = "Use a decimal point and no separators of thousands, and one column a stock."
        raise fail("prices", got, "be numbers", remedy)
    return value
