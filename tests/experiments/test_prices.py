"""Files of prices: read, mended or refused, each with one clear message."""

import datetime
import gzip

import numpy as np
import pytest
from typer.testing import CliRunner

import perfcontrol as pc
from perfcontrol.cli.app import app
from perfcontrol.experiments.prices.cleaning import adjusted, find_jumps
from tests.experiments.price_files import DAYS, GOOD, MALFORMED, MENDED, NAMES, cell, gap, jump, lines, prices, weekdays
from tests.tools import assert_refused

read_prices = pc.experiments.read_prices


def write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_file_is_refused_with_one_message_and_status_two(case, tmp_path):
    """By the command as by the library; nothing on standard output, nothing written, no traceback."""
    content, *words = MALFORMED[case]
    path = write(tmp_path / "prices.csv", content)
    assert_refused(lambda: read_prices(path), "prices", *words)
    result = CliRunner().invoke(app, ["stocks", str(path), "--horizon", "20", "--json", "--out", str(tmp_path / "out")])
    assert result.exit_code == 2 and isinstance(result.exception, SystemExit)
    assert result.stdout == "" and result.stderr.startswith("error: `prices` must ") and result.stderr.count("\n") == 1
    assert not list((tmp_path / "out").iterdir())


def test_there_are_enough_malformed_files():
    assert len(MALFORMED) >= 15


def check_good(table, expected=None):
    assert table.stocks == NAMES and list(table.dates) == weekdays(DAYS)
    np.testing.assert_array_equal(table.prices, prices() if expected is None else expected)


SAME = {
    "as it is": GOOD,
    "gzip": gzip.compress(GOOD.encode()),
    "a byte order mark": b"\xef\xbb\xbf" + GOOD.encode(),
    "semicolons": GOOD.replace(",", ";"),
    "tabs and Windows line ends": GOOD.replace(",", "\t").replace("\n", "\r\n"),
    "times of day": "\n".join(line.replace(",", " 16:00:00,", 1) if k else line for k, line in enumerate(lines())),
    "dates without hyphens": "\n".join(line.replace("-", "") for line in lines()),
    "quotes and spaces": "\n".join(",".join(f'"{part}"' for part in line.split(",")) for line in lines()),
    "the date in the last column": "\n".join(",".join((*line.split(",")[1:], line.split(",")[0])) for line in lines()),
    "blank lines": GOOD.replace("\n", "\n\n"),
}


@pytest.mark.parametrize("case", SAME)
def test_good_file_is_read_as_it_was_made(case, tmp_path):
    table = read_prices(write(tmp_path / "prices.csv", SAME[case]))
    check_good(table)
    assert table.notes == ()


@pytest.mark.parametrize("case", MENDED)
def test_small_faults_are_mended_and_said(case, tmp_path):
    content, words = MENDED[case]
    table = read_prices(write(tmp_path / "prices.csv", content))
    check_good(table)
    assert len(table.notes) == 1 and words in table.notes[0]


def test_missing_prices_become_the_price_before(tmp_path):
    table = read_prices(write(tmp_path / "prices.csv", gap(20, 25, 2)))
    expected = prices()
    expected[19:24, 1] = expected[18, 1]
    check_good(table, expected)
    assert table.notes == ("Bee: 5 missing prices, each taken as the price before.",)
    for word in ("NA", "nan", "null", "-", " "):
        expected = prices()
        expected[4, 1] = expected[3, 1]
        check_good(read_prices(write(tmp_path / "prices.csv", cell(5, 2, word))), expected)


def test_part_of_a_file_is_used_and_only_that_is_judged(tmp_path):
    values = prices(days=120)
    values[:50, 1] *= 2  # looks like a split after 50 days
    path = write(tmp_path / "prices.csv", "\n".join(lines(values)))
    days = weekdays(120)
    assert_refused(lambda: read_prices(path), "prices", "split")
    for part in ({"start": days[50]}, {"last": 70}):
        table = read_prices(path, **part)
        assert list(table.dates) == days[50:]
        np.testing.assert_array_equal(table.prices, np.round(values, 2)[50:])
    table = read_prices(path, stocks=["cow", "Ant"], end=days[99])
    assert table.stocks == ("Cow", "Ant") and len(table.dates) == 100
    np.testing.assert_array_equal(table.prices, np.round(values, 2)[:100, [2, 0]])
    assert_refused(lambda: read_prices(path, stocks=["Ant", "Dog"]), "stocks", "Dog", "Ant, Bee, Cow")
    assert_refused(lambda: read_prices(path, stocks=["Ant", "ant"]), "stocks", "once")
    assert_refused(lambda: read_prices(path, start=datetime.date(2031, 1, 1)), "start", "2031-01-01")


@pytest.mark.parametrize(("ratio", "shares"), [(1 / 2, 2), (2 / 3, 1.5), (1 / 7, 7), (10.0, 0.1)])
def test_split_is_adjusted_or_kept_as_asked(ratio, shares, tmp_path):
    path = write(tmp_path / "prices.csv", jump(ratio))
    raw = np.array([line.split(",")[1:] for line in jump(ratio).split("\n")[1:]], dtype=float)
    found = find_jumps(raw)
    assert [(one.day, one.stock) for one in found] == [(40, 1)] and found[0].split == pytest.approx(shares)
    check_good(read_prices(path, splits="keep"), raw)
    mended = read_prices(path, splits="adjust")
    expected = raw.copy()
    expected[:40, 1] /= shares
    np.testing.assert_allclose(mended.prices, expected, rtol=1e-14)
    assert "Bee on 2021-03-01" in mended.notes[0] and mended.notes[0].endswith("adjusted.")
    np.testing.assert_allclose(np.diff(np.log(mended.prices[:, 1])), np.diff(np.log(prices()[:, 1])), atol=2e-3)
    assert find_jumps(mended.prices) == []


def test_unexplained_jump_is_taken_out_when_adjusted():
    values = prices()
    values[40:, 1] *= 0.0035
    assert find_jumps(adjusted(values, find_jumps(values))) == []


def test_true_moves_are_no_splits():
    values = prices()
    for day, ratio in ((20, 0.71), (40, 1.6), (50, 0.58)):
        values[day:, 1] *= ratio * values[day - 1, 1] / values[day, 1]
    assert find_jumps(values) == []


def test_command_says_what_it_cannot_read(tmp_path):
    result = CliRunner().invoke(app, ["stocks", str(tmp_path / "nowhere.csv")])
    assert result.exit_code == 1 and "cannot read" in result.stderr and "does not exist" in result.stderr
    path = write(tmp_path / "prices.csv", GOOD)
    for arguments, words in ((["--from", "last year"], "--from"), (["--stocks", "Ant,Emu"], "Emu")):
        result = CliRunner().invoke(app, ["stocks", str(path), *arguments])
        assert result.exit_code == 2 and words in result.stderr and result.stderr.count("\n") == 1
