"""A market's allocations and costs as a page of Markdown and a table of weights."""

import csv
import io
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from perfcontrol.experiments.prices.study import Study


def markdown(study: "Study") -> str:
    """What `perfcontrol stocks` found, as a page."""
    table, settings = study.table, study.settings
    parts = [f"# {len(table.stocks)} stocks, {len(table.dates)} days from {table.dates[0]} to {table.dates[-1]}"]
    parts.append("\n".join(f"- {name.replace('_', ' ')}: {value}" for name, value in settings.items()))
    if table.notes:
        parts.append("## Mended while reading\n\n" + "\n".join(f"- {note}" for note in table.notes))
    names = list(study.now.policies)
    rows = [[stock, *(f"{study.portfolio(name)[i]:.4f}" for name in names)] for i, stock in enumerate(table.stocks)]
    parts.append(f"## Weights to hold from {table.dates[-1]}\n\n{_table(['stock', *names], rows)}")
    header = [
        "allocation",
        "expected cost",
        "mean cost",
        "median cost",
        "against equal weight",
        "cheaper in",
        "realised / expected",
    ]
    keys = ("mean", "median", "ratio")
    rows = []
    for name, row in study.summary().items():
        cells = [name, _number(study.now.costs[name]), *(_number(row[key]) for key in keys)]
        rows.append([*cells, f"{row['cheaper']} of {row['windows']}", _number(row["realised_over_expected"])])
    count = len(study.windows.first)
    parts.append(
        f"## Costs: expected from now on, and realised in {count} windows out of sample\n\n{_table(header, rows)}"
    )
    parts.append(
        "Against equal weight: the geometric mean of the ratios of realised costs, window by window. Realised / "
        "expected: the median."
    )
    certificate = "No stable policy was found." if study.certificate is None else str(study.certificate)
    parts.append(f"## Certificate\n\n{certificate}")
    return "\n\n".join(parts) + "\n"


def weights_csv(study: "Study") -> str:
    """A row a stock, a column an allocation; empty where there is no such policy."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    columns = {name: study.portfolio(name) for name in study.now.policies}
    writer.writerow(["stock", *columns])
    for index, stock in enumerate(study.table.stocks):
        values = [float(column[index]) for column in columns.values()]
        writer.writerow([stock, *("" if value != value else f"{value:.6f}" for value in values)])
    return out.getvalue()


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"


def _table(header: list[str], rows: list[list[Any]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
