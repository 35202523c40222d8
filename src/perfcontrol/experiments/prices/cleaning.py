"""What prices must be before a law is estimated from them, and jumps that look like splits."""

import datetime
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from perfcontrol._checks import as_array, fail

TREATMENTS = ("refuse", "adjust", "keep")
SPLITS = (1.5, *map(float, range(2, 11)), 12.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 100.0)  # new shares for an old one
NEAR, DEVIATIONS = 0.03, 2.5  # how far the day's own move may take a jump from a split's ratio: the larger of both
BEYOND = 2.5  # no day's move is larger than this factor without a split, or a wrong price
FEWEST = 30  # days below which no covariance is worth estimating


class Jump(NamedTuple):
    """A price that went to `ratio` of the day before, from row day-1 to row day; `split` where one fits: shares held
    for every one before."""

    day: int
    stock: int
    ratio: float
    split: float | None


def check_prices(
    prices: Any,
    names: Sequence[str] | None = None,
    dates: Sequence[datetime.date] | None = None,
    splits: str = "refuse",
) -> np.ndarray:
    """Prices (days, stocks) as float64, splits treated as asked for.

    Raises:
        InputError: anything from which no law should be estimated; names and dates tell where.
    """
    if splits not in TREATMENTS:
        raise fail("splits", repr(splits), f"be one of {TREATMENTS}", "Pass one of these names.")
    as_array("prices", prices, "Fill gaps, or leave out the stock or the days; pc.experiments.read_prices does.")
    values = np.array(prices, dtype=float)
    if values.ndim != 2 or values.shape[1] < 2:
        raise fail(
            "prices",
            f"{values.shape}",
            "have shape (days, stocks) with two stocks or more",
            "Pass one row a day, one column a stock.",
        )
    labels = list(names) if names is not None else [f"stock {index}" for index in range(values.shape[1])]
    when = list(dates) if dates is not None else [f"row {index}" for index in range(values.shape[0])]
    needed = max(FEWEST, 2 * values.shape[1]) + 1
    if len(values) < needed:
        required = f"cover at least {needed} days for {values.shape[1]} stocks"
        raise fail("prices", f"{len(values)} days", required, "Pass more days, or fewer stocks.")
    if np.any(values <= 0):
        day, stock = np.argwhere(values <= 0)[0]
        got = f"{values[day, stock]:g} for {labels[stock]} on {when[day]}"
        raise fail("prices", got, "be positive", "Correct the price, or leave out the stock or the days.")
    _check_columns(values, labels)
    jumps = find_jumps(values)
    if jumps and splits == "refuse":
        raise fail("prices", _describe(jumps, labels, when), "not jump as by a split", _remedy(jumps))
    return adjusted(values, jumps) if splits == "adjust" else values


def _check_columns(values: np.ndarray, labels: list[str]) -> None:
    returns = np.diff(np.log(values), axis=0)
    still = np.flatnonzero(np.ptp(values, axis=0) == 0)
    if len(still):
        raise fail("prices", f"a constant price of {labels[still[0]]}", "move", "Leave out the stock.")
    for second in range(values.shape[1]):
        same = [first for first in range(second) if np.allclose(returns[:, first], returns[:, second], 1e-9, 1e-12)]
        if same:
            got = f"the same returns for {labels[same[0]]} and {labels[second]}"
            raise fail("prices", got, "differ from stock to stock", "Leave out one of the two.")


def find_jumps(values: np.ndarray) -> list[Jump]:
    """Moves from one row to the next that a split would explain, or that nothing else would."""
    ratios = values[1:] / values[:-1]
    usual = 1.4826 * np.median(np.abs(np.log(ratios)), axis=0)  # standard deviation of a day without jumps
    near = np.maximum(NEAR, DEVIATIONS * usual)
    jumps = []
    for day, stock in np.argwhere((ratios < 0.75) | (ratios > 1.75)):
        ratio = float(ratios[day, stock])
        known = [*SPLITS, *(1 / new for new in SPLITS if new >= 2)]  # more shares, each worth less; and the reverse
        split = min(known, key=lambda shares: abs(np.log(ratio * shares)))
        fits = abs(np.log(ratio * split)) < near[stock]
        if fits or not 1 / BEYOND <= ratio <= BEYOND:
            jumps.append(Jump(int(day) + 1, int(stock), ratio, split if fits else None))
    return jumps


def adjusted(values: np.ndarray, jumps: list[Jump]) -> np.ndarray:
    """The prices before each jump divided by its split, and where none fits by what leaves no jump."""
    values = values.copy()
    for jump in jumps:
        values[: jump.day, jump.stock] *= jump.ratio if jump.split is None else 1 / jump.split
    return values


def named(split: float) -> str:
    """A split in words."""
    old, new = (2, 3) if split == 1.5 else (1, round(split)) if split > 1 else (round(1 / split), 1)
    return f"{new}-for-{old} split"


def _describe(jumps: list[Jump], labels: list[str], when: list[Any]) -> str:
    def one(jump: Jump) -> str:
        like = "no split that is known" if jump.split is None else f"a {named(jump.split)}"
        return f"{labels[jump.stock]} at {jump.ratio:.4g} of its price on {when[jump.day]} (like {like})"

    rest = f" and {len(jumps) - 3} more" if len(jumps) > 3 else ""
    return ", ".join(one(jump) for jump in jumps[:3]) + rest


def _remedy(jumps: list[Jump]) -> str:
    those, real = ("it is one", "it was a true move") if len(jumps) == 1 else ("they are", "they were true moves")
    return f'Pass adjusted prices, or splits="adjust" (--splits adjust) if {those}, splits="keep" if {real}.'
