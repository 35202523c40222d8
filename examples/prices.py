"""Prices to an allocation: writes a small file of made-up prices, and decides what to hold.

The file is examples/prices.csv, random walks of five stocks that share a market; it is made here and is no real market.

Run: python examples/prices.py [--quick]
"""

import datetime
import sys
from pathlib import Path

import jax
import numpy as np

import perfcontrol as pc

jax.config.update("jax_enable_x64", True)
FILE = Path(__file__).with_suffix(".csv")
STOCKS = ("ASH", "BIRCH", "CEDAR", "ELM", "FIR")


def made_up(days=400):
    """Text of a table of prices."""
    rng = np.random.default_rng(7)
    market = 0.008 * rng.standard_t(5, size=(days, 1))
    own = np.array([0.004, 0.006, 0.009, 0.013, 0.018]) * rng.normal(size=(days, 5))
    prices = np.array([40.0, 55.0, 21.0, 90.0, 12.0]) * np.exp(np.cumsum(0.0003 + market + own, axis=0))
    start = datetime.date(2021, 1, 4)
    weekdays = [day for day in (start + datetime.timedelta(days=n) for n in range(2 * days)) if day.weekday() < 5]
    rows = [",".join(("Date", *STOCKS))]
    rows += [f"{day}," + ",".join(f"{price:.2f}" for price in row) for day, row in zip(weekdays, prices, strict=False)]
    return "\n".join(rows) + "\n"


def main(quick):
    FILE.write_text(made_up())
    table = pc.experiments.read_prices(FILE)
    for capital in (15.0, 150.0) if quick else (5.0, 15.0, 50.0, 150.0, 500.0):
        problem = pc.experiments.market(table.prices, horizon=20, capital=capital, feasible_set="simplex")
        price = pc.price_of_stability(problem, starts=1)
        print(f"capital {capital:g}: the stable allocation costs {price.ratio:.4f} times the optimal one")
        for name, M in (("stable", price.stable), ("optimal", price.optimal)):
            weights = (M[0] * (24 - 6.5) / 6.5).mean(axis=0)
            print(
                f"  {name:8}"
                + "".join(f"{stock} {weight:.3f}  " for stock, weight in zip(STOCKS, weights, strict=True))
            )


if __name__ == "__main__":
    main("--quick" in sys.argv)
