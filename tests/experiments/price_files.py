"""Files of prices, made here: a good one, ways to spoil it, and what each must be refused with."""

import datetime
import gzip

import numpy as np

NAMES = ("Ant", "Bee", "Cow")
DAYS = 70


def weekdays(count, first=datetime.date(2021, 1, 4)):
    days = (first + datetime.timedelta(days=step) for step in range(2 * count))
    return [day for day in days if day.weekday() < 5][:count]


def prices(seed=0, days=DAYS, stocks=3):
    """Correlated random walks, rounded to cents as prices are."""
    rng = np.random.default_rng(seed)
    shared = rng.normal(size=(days, 1))
    steps = 0.0004 + 0.01 * shared + 0.008 * (1 + np.arange(stocks)) * rng.normal(size=(days, stocks))
    return np.round(np.exp(np.log(50.0 + 30 * np.arange(stocks)) + np.cumsum(steps, axis=0)), 2)


def lines(values=None, names=NAMES, dates=None):
    values = prices() if values is None else values
    dates = weekdays(len(values)) if dates is None else dates
    body = [f"{date}," + ",".join(f"{value:.2f}" for value in row) for date, row in zip(dates, values, strict=True)]
    return [",".join(("Date", *names)), *body]


def cell(row, column, text):
    """The good file with one cell replaced (row 0 is the header)."""
    table = [line.split(",") for line in lines()]
    table[row][column] = text
    return "\n".join(",".join(line) for line in table)


def with_rows(edit):
    table = lines()
    edit(table)
    return "\n".join(table)


def jump(ratio):
    values = prices()
    values[40:, 1] = np.round(values[40:, 1] * ratio, 2)
    return "\n".join(lines(values))


def gap(first, last, column=3):
    table = [line.split(",") for line in lines()]
    for row in range(first, last):
        table[row][column] = ""
    return "\n".join(",".join(line) for line in table)


def same_twice():
    values = prices()
    return "\n".join(lines(np.column_stack([values, values[:, 0] * 2]), (*NAMES, "Ant2")))


def constant():
    values = prices()
    values[:, 2] = 7.0
    return "\n".join(lines(values))


GOOD = "\n".join(lines())

# Content of a file -> words of the one message that it is refused with.
MALFORMED = {
    "empty": ("", "empty file"),
    "blank lines": ("\n\n  \n", "empty file"),
    "a header alone": ("Date,Ant,Bee\n", "a header alone"),
    "one column": ("\n".join(line.split(",")[0] for line in lines()), "separate columns"),
    "no header": ("\n".join(lines()[1:]), "begin with a header row"),
    "binary": (bytes(range(256)) * 40, "UTF-8"),
    "zero bytes": (GOOD.encode() + b"\0\0", "zero bytes"),
    "another encoding": (GOOD.replace("Ant", "Ameise\u00e4").encode("latin-1"), "UTF-8"),
    "half a gzip file": (gzip.compress(GOOD.encode())[:-40], "gzip"),
    "an open quote": (GOOD.replace("2021-02-01", '"2021-02-01'), "CSV table"),
    "a stock twice": (GOOD.replace("Bee", "ant"), "name every stock once"),
    "a column without name": (GOOD.replace("Bee", ""), "name every stock once"),
    "a short row": (with_rows(lambda table: table.insert(9, "2021-01-14,1.0")), "2 cells in line 10"),
    "day before month": (cell(5, 0, "08/01/2021"), "line 6", "YYYY-MM-DD"),
    "no such day": (cell(5, 0, "2021-02-30"), "line 6", "2021-02-30"),
    "words for a price": (cell(5, 2, "n.v."), "'n.v.' for Bee in line 6"),
    "separators of thousands": (cell(5, 2, '"1 234.50"'), "separators of thousands"),
    "decimal commas": (GOOD.replace(",", ";").replace(".", ","), "decimal point"),
    "an infinite price": (cell(5, 2, "inf"), "'inf' for Bee"),
    "too large a price": (cell(5, 2, "1e999"), "'1e999' for Bee"),
    "zero": (cell(5, 2, "0"), "0 for Bee on 2021-01-08 (line 6)"),
    "negative": (cell(5, 3, "-80.1"), "-80.1 for Cow on 2021-01-08"),
    "two prices for one day": (
        with_rows(lambda table: table.insert(9, table[9].replace(table[9].split(",")[1], "1.00"))),
        "two rows of different prices for 2021-01-14",
    ),
    "a long gap of one stock": (gap(20, 26), "6 missing prices of Cow after 2021-01-28"),
    "a stock listed late": (gap(1, 9), "prices of Cow from 2021-01-14"),
    "a stock that ended": (gap(60, 71), "prices of Cow from 2021-01-04 to 2021-03-25 only"),
    "a stock without prices": (gap(1, 71), "no price of Cow"),
    "a missing month": (with_rows(lambda table: table.__delitem__(slice(20, 45))), "no row between"),
    "weekly prices": (
        "\n".join(lines(dates=[datetime.date(2020, 1, 6) + datetime.timedelta(days=7 * k) for k in range(DAYS)])),
        "rows 7 days apart",
    ),
    "too few days": ("\n".join(lines()[:25]), "24 days"),
    "one stock": ("\n".join(",".join(line.split(",")[:2]) for line in lines()), "two stocks or more"),
    "the same stock under two names": (same_twice(), "Ant and Ant2"),
    "a price that never moves": (constant(), "constant price of Cow"),
    "a split of two for one": (jump(0.5), "Bee", "2-for-1 split", "on 2021-03-01", "--splits adjust"),
    "a split of three for two": (jump(2 / 3), "Bee", "3-for-2 split"),
    "a reverse split": (jump(10.0), "Bee", "1-for-10 split"),
    "a crash beyond belief": (jump(0.0035), "Bee", "no split that is known"),
}

# Content of a file -> words of the note that says how it was mended.
MENDED = {
    "rows in reverse": ("\n".join([lines()[0], *lines()[:0:-1]]), "sorted"),
    "a repeated row": (with_rows(lambda table: table.insert(9, table[9])), "1 repeated rows"),
    "an empty day": (with_rows(lambda table: table.insert(11, "2021-01-17,,,")), "1 days without any price"),
}
