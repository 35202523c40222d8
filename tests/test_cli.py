"""The command line: typed options, clear errors, exit statuses."""

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from perfcontrol._checks import fail
from perfcontrol.cli.app import Commands, app, in_words

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
    said = " ".join((result.output + result.stderr).split())
    assert "cannot write" in said and "a file stands where a folder should be" in said


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PermissionError(13, "Permission denied", "/a/b"), ("/a/b", "permission", "Choose a folder")),
        (FileExistsError(17, "File exists", "/a/b"), ("/a/b", "a file stands where a folder should be")),
        (NotADirectoryError(20, "Not a directory", "/a/b"), ("/a/b", "a file stands where a folder should be")),
        (OSError(28, "No space left on device", "/a/b"), ("the disk is full", "is kept")),
        (OSError(30, "Read-only file system", "/a/b"), ("read-only", "Choose another path")),
        (OSError(5, "Input/output error"), ("Input/output error", "Check the path and the disk")),
    ],
)
def test_errors_of_the_operating_system_are_said_in_words(error, words, capsys):
    with pytest.raises(typer.Exit) as caught, in_words("write the table"):
        raise error
    said = " ".join(capsys.readouterr().err.split())
    assert caught.value.exit_code == 1
    assert said.startswith("error: cannot write the table")
    for word in words:
        assert word in said


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (OSError(28, "No space left on device"), 1, "error: cannot go on: the disk is full."),  # as of a full stdout
        (fail("growth", "nan", "be finite", "Pass a number."), 2, "error: `growth` must be finite; got nan."),
        (MemoryError("Unable to allocate 8 TiB"), 1, "error: there is not enough memory for this: Unable to allocate"),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory"), 1, "error: there is not enough memory for this"),
        (OverflowError("the cost overflows float64"), 1, "error: the cost overflows float64"),
    ],
)
def test_no_command_ends_in_a_traceback_of_what_system_or_library_refuse(error, status, words):
    commands = typer.Typer(cls=Commands)

    @commands.callback()
    def root() -> None: ...

    @commands.command()
    def work() -> None:
        raise error

    result = runner.invoke(commands, ["work"])
    assert result.exit_code == status
    assert result.stderr.startswith(words)
