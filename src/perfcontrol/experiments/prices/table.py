"""A file of daily prices: a header row, a column of dates, a column a stock."""

import datetime
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perfcontrol._checks import fail
from perfcontrol.experiments.prices.cleaning import check_prices, find_jumps, named
from perfcontrol.experiments.prices.reading import decoded, parsed

CARRIED = 5  # days in a row over which the last price may be carried on
PAUSE = 14  # calendar days between two rows above which they are no daily prices


@dataclass(frozen=True)
class PriceTable:
    """Daily prices that a law can be estimated from.

    Attributes:
        dates: of the rows, ascending.
        stocks: names of the columns.
        prices: (days, stocks), positive.
        notes: what was mended while reading, a sentence each.
    """

    dates: tuple[datetime.date, ...]
    stocks: tuple[str, ...]
    prices: np.ndarray
    notes: tuple[str, ...]


def read_prices(
    path: Any,
    stocks: Sequence[str] | None = None,
    start: datetime.date | None = None,
    end: datetime.date | None = None,
    last: int | None = None,
    splits: str = "refuse",
) -> PriceTable:
    """Read a file of daily prices, mend what can be mended without guessing, refuse the rest.

    The file is text (UTF-8; gzip too) with commas, semicolons or tabs: a header row, a column of dates (the one called
    Date, or the first) and a column a stock. Rows are sorted, repeated rows dropped, days without any price left out;
    up to five missing prices in a row become the price before. What was done is in the notes.

    Args:
        path: of the file.
        stocks: names of the columns to use; None for all.
        start: first date to use; None for the first of the file.
        end: last date to use; None for the last of the file.
        last: so many rows at the end of these, at most; None for all. What is not used may have gaps and jumps.
        splits: what to do where a price jumps as by a split: "refuse", "adjust" the earlier prices, "keep" the jump.

    Raises:
        InputError: anything else that is wrong, with the line and the column.
        OSError: the file cannot be read.
    """
    raw = Path(path).read_bytes()
    notes: list[str] = []
    names, rows = parsed(decoded(raw))
    columns = _chosen(names, stocks)
    dates = [row.date for row in rows]
    values = np.array([[row.prices[column] for column in columns] for row in rows], dtype=float)
    lines = [row.line for row in rows]
    names = [names[column] for column in columns]
    _check_positive(values, names, dates, lines)
    dates, values = _in_order(dates, values, notes)
    dates, values = _between(dates, values, start, end)
    dates, values = _without_empty_days(dates, values, notes)
    if last is not None:
        dates, values = dates[-last:], values[-last:]
    _check_daily(dates)
    values = _filled(values, names, dates, notes)
    checked = check_prices(values, names, dates, splits)
    if splits != "refuse":
        for jump in find_jumps(values):
            what = "an unexplained jump" if jump.split is None else f"a {named(jump.split)}"
            done = "adjusted" if splits == "adjust" else "kept"
            notes.append(f"{names[jump.stock]} on {dates[jump.day]}: {what} or a move to {jump.ratio:.4g}, {done}.")
    return PriceTable(tuple(dates), tuple(names), checked, tuple(notes))


def _chosen(names: list[str], stocks: Sequence[str] | None) -> list[int]:
    if stocks is None:
        return list(range(len(names)))
    position = {name.lower(): index for index, name in enumerate(names)}
    unknown = [stock for stock in stocks if stock.lower() not in position]
    if unknown:
        raise fail(
            "stocks", ", ".join(unknown), f"be among {', '.join(names)[:200]}", "Name stocks as the header row does."
        )
    chosen = [position[stock.lower()] for stock in stocks]
    if len(set(chosen)) < len(chosen):
        raise fail("stocks", ", ".join(stocks), "name every stock once", "Leave out the repeated one.")
    return chosen


def _check_positive(values: np.ndarray, names: list[str], dates: list[Any], lines: list[int]) -> None:
    bad = np.argwhere(values <= 0)
    if len(bad):
        row, column = bad[0]
        got = f"{values[row, column]:g} for {names[column]} on {dates[row]} (line {lines[row]})"
        more = f", one of {len(bad)} such prices" if len(bad) > 1 else ""
        raise fail("prices", got + more, "be positive", "Correct the price, leave the cell empty, or omit the stock.")


def _in_order(
    dates: list[datetime.date], values: np.ndarray, notes: list[str]
) -> tuple[list[datetime.date], np.ndarray]:
    order = sorted(range(len(dates)), key=dates.__getitem__)
    if order != list(range(len(dates))):
        notes.append("Rows were not in the order of their dates: sorted.")
    dates, values = [dates[index] for index in order], values[order]
    kept = [0]
    for row in range(1, len(dates)):
        if dates[row] != dates[kept[-1]]:
            kept.append(row)
            continue
        one, two = values[kept[-1]], values[row]
        both = ~(np.isnan(one) | np.isnan(two))
        if np.any(one[both] != two[both]):
            remedy = "Remove the wrong one of the two rows."
            raise fail("prices", f"two rows of different prices for {dates[row]}", "have one row a day", remedy)
        values[kept[-1]] = np.where(np.isnan(one), two, one)
    if len(kept) < len(dates):
        notes.append(f"{len(dates) - len(kept)} repeated rows: dropped.")
    return [dates[row] for row in kept], values[kept]


def _between(
    dates: list[datetime.date], values: np.ndarray, start: Any, end: Any
) -> tuple[list[datetime.date], np.ndarray]:
    kept = [row for row, date in enumerate(dates) if (start is None or date >= start) and (end is None or date <= end)]
    if not kept:
        span = f"{dates[0]} to {dates[-1]}"
        raise fail(
            "start", f"no day from {start or dates[0]} to {end or dates[-1]}", f"lie in {span}", "Pass dates within it."
        )
    return [dates[row] for row in kept], values[kept]


def _without_empty_days(
    dates: list[datetime.date], values: np.ndarray, notes: list[str]
) -> tuple[list[datetime.date], np.ndarray]:
    empty = np.array([bool(np.isnan(row).all()) for row in values])
    if empty.any():
        notes.append(f"{int(empty.sum())} days without any price: left out.")
    return [date for date, gone in zip(dates, empty, strict=True) if not gone], values[~empty]


def _check_daily(dates: list[datetime.date]) -> None:
    steps = [(later - earlier).days for earlier, later in itertools.pairwise(dates)]
    if steps and sorted(steps)[len(steps) // 2] > 4:
        got = f"rows {sorted(steps)[len(steps) // 2]} days apart"
        raise fail("prices", got, "be daily", "Pass daily prices: others say nothing of a day's growth.")
    if steps and max(steps) > PAUSE:
        row = steps.index(max(steps))
        got = f"no row between {dates[row]} and {dates[row + 1]}"
        raise fail(
            "prices", got, f"leave out at most {PAUSE} days in a row", "Use the days before or after (start, end)."
        )


def _filled(values: np.ndarray, names: list[str], dates: list[datetime.date], notes: list[str]) -> np.ndarray:
    values = values.copy()
    for column, name in enumerate(names):
        missing = np.isnan(values[:, column])
        if missing.all():
            raise fail("prices", f"no price of {name}", "have prices of every stock", "Leave out the stock.")
        known = np.flatnonzero(~missing)
        edge = f"prices of {name} from {dates[known[0]]} to {dates[known[-1]]} only"
        if known[0] > 0 or len(missing) - 1 - known[-1] > CARRIED:
            remedy = "Leave out the stock, or the days before and after (start, end)."
            raise fail("prices", edge, f"span {dates[0]} to {dates[-1]}", remedy)
        gaps = np.diff(np.append(known, len(missing))) - 1
        if gaps.max() > CARRIED:
            first = known[gaps.argmax()]
            got = f"{gaps.max()} missing prices of {name} after {dates[first]}"
            raise fail("prices", got, f"miss at most {CARRIED} in a row", "Leave out the stock, or those days.")
        if missing.any():
            notes.append(f"{name}: {int(missing.sum())} missing prices, each taken as the price before.")
            last = np.maximum.accumulate(np.where(missing, 0, np.arange(len(missing))))
            values[:, column] = values[last, column]
    return values
