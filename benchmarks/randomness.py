"""A battery of statistical tests of `pc.fast_key`, each over as many 32-bit numbers as asked for.

    python -m benchmarks.randomness [--numbers 32] [--out table.md]     # 2^32 numbers
    python -m benchmarks.randomness --raw children | dieharder -a -g 200

Numbers are taken in five ways: one long stream; the first 16 numbers of each child by `fold_in`, and by `split`; the
two halves of 64-bit numbers; and the exclusive or of the streams of neighbouring children. Every statistic is normal,
Poisson or chi-square under the null hypothesis and is reported by its two-sided p-value. The last column is a generator
that must fail: the same with one round instead of four, over 2^28 numbers at most.
"""

import argparse
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402 - after JAX is configured
import numpy as np  # noqa: E402
from scipy import stats  # noqa: E402

import perfcontrol as pc  # noqa: E402

CHUNK = 2**22
SHORT = 16  # numbers of one child
BIRTHDAYS = 2**12  # in a year of 2^32 days: BIRTHDAYS³ / 2^34 = 4 equal spacings expected
SORTED = 32  # one lot in so many is sorted, which is slow, for birthdays and collisions
LAGS = (1, 2, 16, 1024)


@partial(jax.jit, static_argnums=0)
def chunk(way: str, index: Any) -> jax.Array:
    """CHUNK numbers, the `index`-th such lot."""
    root = jax.random.fold_in(pc.fast_key(2024), 5)
    if way == "one stream":  # lots of one stream by its own counter
        data = jax.random.key_data(root).astype(jnp.uint64)
        start = (data[2] << 32 | data[3]) + index * np.uint64(CHUNK)
        moved = jnp.stack([data[0], data[1], start >> 32, start & np.uint64(2**32 - 1)]).astype(jnp.uint32)
        return jax.random.bits(jax.random.wrap_key_data(moved, impl=jax.random.key_impl(root)), (CHUNK,), "uint32")
    if way == CONTROL:
        k = jax.random.key_data(root).astype(jnp.uint64)[0] << 32 | np.uint64(0x9E3779B9)
        x = (index * np.uint64(CHUNK) + jnp.arange(CHUNK, dtype=jnp.uint64)) * k
        return ((x * x + x) >> 32).astype(jnp.uint32)
    if way == "halves":
        wide = jax.random.bits(jax.random.fold_in(root, index), (CHUNK // 2,), "uint64")
        return jnp.stack([wide >> 32, wide & np.uint64(2**32 - 1)], axis=1).astype(jnp.uint32).ravel()
    count = CHUNK // SHORT
    if way == "split":
        keys = jax.random.split(jax.random.fold_in(root, index), count)
    else:
        keys = jax.vmap(lambda d: jax.random.fold_in(root, d))(index * np.uint64(count) + jnp.arange(count + 1))
    numbers = jax.vmap(lambda key: jax.random.bits(key, (SHORT,), "uint32"))(keys)
    return (numbers[1:] ^ numbers[:-1] if way == "neighbours" else numbers[:count]).ravel()


WAYS = ("one stream", "children", "split", "halves", "neighbours")
CONTROL = "one round"


def lots(way: str, numbers: int) -> Iterator[np.ndarray]:
    """`numbers` in lots of CHUNK."""
    for index in range(max(1, numbers // CHUNK)):
        yield np.asarray(chunk(way, np.uint64(index)))


class Battery:
    """Running sums of all statistics over lots of numbers."""

    def __init__(self) -> None:
        self.seen = 0
        self.high, self.low, self.pairs = (np.zeros(2**16, np.int64) for _ in range(3))
        self.weights = np.zeros(33, np.int64)
        self.weight_pairs = np.zeros(4, np.int64)
        self.bits = np.zeros(32, np.int64)
        self.lagged, self.lagged_count = (np.zeros(len(LAGS), np.int64) for _ in range(2))
        self.lots = self.spacings = self.years = self.collisions = 0
        self.collisions_mean = self.collisions_variance = 0.0

    def add(self, x: np.ndarray) -> None:
        """One lot."""
        self.seen += x.size
        self.high += np.bincount(x >> 16, minlength=2**16)
        self.low += np.bincount(x & 0xFFFF, minlength=2**16)
        two = x.reshape(-1, 2)
        self.pairs += np.bincount((two[:, 0] >> 24 << 8) | (two[:, 1] >> 24), minlength=2**16)
        weight = np.bitwise_count(x)
        self.weights += np.bincount(weight, minlength=33)
        heavy = (weight > 16).reshape(-1, 2)  # of neighbours, whether each is heavy
        self.weight_pairs += np.bincount(heavy[:, 0] * 2 + heavy[:, 1], minlength=4)
        self.bits += _ones(x)
        for row, lag in enumerate(LAGS):
            self.lagged[row] += np.bitwise_count(x[lag:] ^ x[:-lag]).sum(dtype=np.int64)
            self.lagged_count[row] += 32 * (x.size - lag)
        self.lots += 1
        if self.lots % SORTED == 1:
            self._add_sorted(x)

    def _add_sorted(self, x: np.ndarray) -> None:
        years = np.sort(x.reshape(-1, BIRTHDAYS), axis=1)
        gaps = np.sort(np.diff(years.astype(np.int64), axis=1), axis=1)
        self.spacings += int(np.sum(gaps[:, 1:] == gaps[:, :-1]))
        self.years += len(years)
        self.collisions += x.size - np.unique(x).size
        n, cells = x.size, 2.0**32
        self.collisions_mean += n - cells * -np.expm1(n * np.log1p(-1 / cells))
        self.collisions_variance += n * (n - 1) / (2 * cells)  # Poisson, to a part in a thousand at this density

    def p_values(self) -> dict[str, float]:
        """By test."""
        binomial = stats.binom.pmf(np.arange(33), 32, 0.5)
        tail = binomial * self.seen >= 5
        weights = np.append(self.weights[tail], self.weights[~tail].sum())
        expected = np.append(binomial[tail], binomial[~tail].sum()) * self.seen
        if expected[-1] < 5:
            weights, expected = weights[:-1], expected[:-1] * weights[:-1].sum() / expected[:-1].sum()
        heavy = binomial[17:].sum()
        heavy_pairs = np.outer([1 - heavy, heavy], [1 - heavy, heavy]).ravel() * self.weight_pairs.sum()
        lagged = (self.lagged - self.lagged_count / 2) / np.sqrt(self.lagged_count / 4)
        mean = self.years * _equal_spacings(BIRTHDAYS, 2.0**32)
        return {
            "equidistribution, high 16 bits": _chi_square(self.high),
            "equidistribution, low 16 bits": _chi_square(self.low),
            "serial, pairs of high bytes": _chi_square(self.pairs),
            "Hamming weights": _chi_square(weights, expected),
            "Hamming weights of neighbours": _chi_square(self.weight_pairs, heavy_pairs),
            "each bit": _p_of_sum((self.bits - self.seen / 2) / np.sqrt(self.seen / 4)),
            f"bits against those {', '.join(map(str, LAGS))} later": _p_of_sum(lagged),
            "birthday spacings": _two_sided(stats.poisson(mean), self.spacings),
            "collisions": 2 * stats.norm.sf(
                abs(self.collisions - self.collisions_mean) / np.sqrt(self.collisions_variance)
            ),
        }  # fmt: skip


def _equal_spacings(birthdays: int, days: float) -> float:
    """Expected equal spacings among the sorted birthdays, m³/(4 d), with the next order in m/d negligible."""
    return birthdays**3 / (4 * days)


def _ones(x: np.ndarray) -> np.ndarray:
    """How often each of the 32 bits is one."""
    bytes_ = x.astype("<u4").view(np.uint8).reshape(-1, 4)
    table = (np.arange(256)[:, None] >> np.arange(8)) & 1
    return np.concatenate([np.bincount(bytes_[:, k], minlength=256) @ table for k in range(4)])


def _chi_square(counts: np.ndarray, expected: np.ndarray | None = None) -> float:
    return _two_sided_p(stats.chisquare(counts, expected).pvalue)  # pyright: ignore


def _p_of_sum(z: np.ndarray) -> float:
    return _two_sided_p(stats.chi2.sf(np.sum(z**2), z.size))


def _two_sided(law: Any, value: int) -> float:
    return _two_sided_p(law.sf(value - 1) if value > law.mean() else 1 - law.cdf(value))


def _two_sided_p(p: Any) -> float:
    """Small where p is close to 0 or to 1: numbers that are too even fail as well."""
    return float(min(1.0, 2 * min(p, 1 - p)))


def main(arguments: list[str] | None = None) -> None:
    """Print the table, or raw numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--numbers", type=int, default=32, help="2 to this power, for each way")
    parser.add_argument("--raw", choices=WAYS, help="write these numbers to standard output without end")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    if options.raw:
        for lot in lots(options.raw, 2**60):
            try:
                sys.stdout.buffer.write(lot.tobytes())
            except BrokenPipeError:
                return
    lines = ["| test | " + " | ".join((*WAYS, CONTROL)) + " |", "|" + " --- |" * (2 + len(WAYS))]
    columns = []
    for way in (*WAYS, CONTROL):
        battery = Battery()
        for lot in lots(way, 2 ** min(options.numbers, 28 if way == CONTROL else options.numbers)):
            battery.add(lot)
        columns.append(battery.p_values())
        sys.stderr.write(f"{way}: {columns[-1]}\n")
    for test in columns[0]:
        lines.append(f"| {test} | " + " | ".join(f"{column[test]:.3g}" for column in columns) + " |")
    text = "\n".join(lines) + "\n"
    sys.stdout.write(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
