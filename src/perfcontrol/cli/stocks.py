"""`perfcontrol stocks`."""

import datetime
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.table import Table

from perfcontrol.cli.app import app, configure_jax, console, in_words, refuse, shown
from perfcontrol.cli.progress import stages

if TYPE_CHECKING:
    from perfcontrol.experiments.prices.study import Study


@app.command()
def stocks(
    prices: Annotated[
        Path, typer.Argument(help="CSV file: header row, a date column, one column of daily prices a stock.")
    ],
    horizon: Annotated[int, typer.Option(help="Trading days over which costs are summed.", min=2)] = 60,
    names: Annotated[str | None, typer.Option("--stocks", help="Columns to use, A,B,C (all).")] = None,
    start: Annotated[str | None, typer.Option("--from", help="First date to use, YYYY-MM-DD.")] = None,
    end: Annotated[str | None, typer.Option("--to", help="Last date to use, YYYY-MM-DD.")] = None,
    window: Annotated[
        int | None, typer.Option(help="Days that laws are estimated from (504, or half of the record).", min=30)
    ] = None,
    windows: Annotated[int, typer.Option(help="Rolling windows judged out of sample, the latest.", min=1)] = 12,
    capital: Annotated[float, typer.Option(help="Money in each stock's account; the risk is that of 100.")] = 150.0,
    rate: Annotated[float, typer.Option(help="Riskless rate a year.")] = 0.05,
    trading_hours: Annotated[float, typer.Option(help="Trading hours a day.")] = 6.5,
    feasible_set: Annotated[
        Literal["rows", "simplex"], typer.Option(help="Weights of sum one, or nonnegative as well.")
    ] = "rows",
    splits: Annotated[
        Literal["refuse", "adjust", "keep"], typer.Option(help="Jumps that look like splits.")
    ] = "refuse",
    sweep: Annotated[bool, typer.Option(help="Also vary the capital.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for the data (JSON), a table and figures.")] = None,
) -> None:
    """Stable, naive and optimal allocation for stocks whose daily prices you have, judged out of sample.

    Beside them stand equal weights and minimum variance. The laws of growth and risk are estimated from the prices.
    """
    configure_jax()
    from perfcontrol.experiments.prices.study import study
    from perfcontrol.experiments.prices.table import read_prices

    if out is not None:
        from perfcontrol import results

        with in_words(f"write to {out}"):
            results.check_writable(out)
    with in_words(f"read {prices}"):
        chosen = None if names is None else [name.strip() for name in names.split(",")]
        used = (504 if window is None else window) + windows * horizon + 1
        table = read_prices(prices, chosen, _date("--from", start), _date("--to", end), used, splits)
    with stages(transient=True) as show:
        found = study(
            table,
            horizon=horizon,
            window=window,
            windows=windows,
            capital=capital,
            rate=rate,
            trading_hours=trading_hours,
            feasible_set=feasible_set,
            sweep=sweep,
            progress=show,
        )
    files = [] if out is None else _write(found, out)
    if as_json:
        print(json.dumps(found.data(), indent=2, allow_nan=False, ensure_ascii=False))
        return
    _show(found)
    for file in files:
        console.print(f"wrote {file}", highlight=False, markup=False)


def _date(option: str, text: str | None) -> datetime.date | None:
    try:
        return None if text is None else datetime.date.fromisoformat(text)
    except ValueError:
        raise refuse(f"{option}: must be a date as YYYY-MM-DD; got {text!r}.") from None


def _write(found: "Study", out: Path) -> list[Path]:
    from perfcontrol import results
    from perfcontrol.plotting.market_figures import figure_allocations, figure_capital, figure_windows
    from perfcontrol.reports.market import markdown, weights_csv

    with in_words(f"write to {out}"):
        results.save_json(found.data(), out / "stocks.json")
        results.save_text(markdown(found), out / "stocks.md")
        results.save_text(weights_csv(found), out / "weights.csv")
        files = [out / "stocks.json", out / "stocks.md", out / "weights.csv"]
        files += figure_allocations(found, out / "allocations") + figure_windows(found, out / "windows")
        return files + (figure_capital(found, out / "capital") if found.sweep is not None else [])


def _show(found: "Study") -> None:
    for note in found.table.notes:
        console.print(f"note: {note}", highlight=False, markup=False)
    first, last = found.table.dates[0], found.table.dates[-1]
    console.print(f"{len(found.table.stocks)} stocks, {len(found.table.dates)} days from {first} to {last}.")
    policies, summary = found.now.policies, found.summary()
    held = Table("stock", *policies, title=f"Weights to hold from {last}")
    for index, stock in enumerate(found.table.stocks):
        held.add_row(stock, *(f"{found.portfolio(name)[index]:.3f}" for name in policies))
    console.print(held)
    count = len(found.windows.first)
    costs = Table(
        "allocation", "expected cost", "mean cost", "ratio", "cheaper", "calibration",
        title=f"Costs: expected from now on, and realised in {count} windows out of sample",
        caption="Realised costs: mean, ratio to equal weight (geometric mean), in how many windows cheaper than it; "
        "calibration: realised / expected (median).",
    )  # fmt: skip
    for name, row in summary.items():
        expected = shown(found.now.costs[name])
        ratio, over = shown(row["ratio"]), shown(row["realised_over_expected"])
        costs.add_row(name, expected, shown(row["mean"]), ratio, f"{row['cheaper']} of {row['windows']}", over)
    console.print(costs)
    text = "No stable policy was found." if found.certificate is None else str(found.certificate)
    console.print(text, highlight=False, markup=False)
