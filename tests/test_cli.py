"""The command line: typed options, clear errors, exit statuses."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from perfcontrol.cli import app

runner = CliRunner()


def test_help_lists_the_options() -> None:
    result = runner.invoke(app, ["reproduce", "--help"])
    assert result.exit_code == 0
    for option in ("--out", "--seeds", "--steps", "--feasible-set", "--quick"):
        assert option in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "1"], "seeds"),
        (["--steps", "many"], "steps"),
        (["--feasible-set", "cube"], "feasible"),
        (["--step-size", "-1"], "step-size"),
        (["--rate", "nan"], "rate"),
    ],
)
def test_bad_option_exits_with_status_two_and_names_it(arguments: list[str], message: str, tmp_path: Path) -> None:
    result = runner.invoke(app, ["reproduce", "--out", str(tmp_path), *arguments])
    assert result.exit_code == 2
    assert message in result.output + result.stderr
    assert list(tmp_path.iterdir()) == []


def test_unwritable_folder_exits_with_status_one_before_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    result = runner.invoke(app, ["reproduce", "--quick", "--out", str(tmp_path / "file" / "deeper")])
    assert result.exit_code == 1
    assert "cannot write" in result.output + result.stderr
