"""What `pc.fit`, `pc.test_reaction` and `Fit.decide` are worth on known plants: errors, coverage, levels, decisions.

    python -m benchmarks.identification [--only coverage] [--share 0.1] [--out table.md]

`--share` scales all counts of data sets. The whole takes hours on one core; every part can be run alone.
"""

import argparse
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

from benchmarks import decisions, estimates, reaction_levels  # noqa: E402 - after JAX is configured
from benchmarks.plants import plant  # noqa: E402


def parts(share: float) -> dict[str, Callable[[], Iterable[str]]]:
    """The tables by name, line by line."""

    def count(full: int) -> int:
        return max(1, round(share * full))

    def coverage() -> Iterator[str]:
        yield "| plant | block | parameters | covered | lowest | highest | outside 92-98 % |"
        yield "|" + " --- |" * 7
        for seed, n, kind in ((0, 2, "norm"), (4, 3, "matrix and affine")):
            for given in (True, False):
                yield from estimates.coverage(plant(seed, n, kind), count(500), 40, given)

    def deciding() -> Iterator[str]:
        yield "| directions | reaction | systems | solved | median | 90 % | largest | ignoring the reaction, median |"
        yield "|" + " --- |" * 8
        for directions in ("given", "estimated"):
            yield from decisions.end_to_end(count(50), directions)

    def ensembles() -> Iterator[str]:
        yield "| reaction | data sets | members | level | cost | cost of M | policy, entries | certified |"
        yield "|" + " --- |" * 8
        for reaction in (None, "auto"):
            yield from decisions.ensembles(count(50), 1, 200, 0.95, reaction)

    return {
        "recovery": lambda: estimates.recovery(count(25), (8, 80, 800)),
        "coverage": coverage,
        "levels": lambda: reaction_levels.levels(count(1000), 15),
        "power": lambda: reaction_levels.power(count(200), (2, 3)),
        "decisions": deciding,
        "ensembles": ensembles,
    }


def _said(line: str) -> str:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
    return line + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Print the tables, and write them where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=list(parts(1.0)), action="append")
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    tables = parts(options.share)
    text = ""
    for name in options.only or tables:
        for line in itertools.chain((f"## {name}", ""), tables[name](), ("",)):
            text += _said(line)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
