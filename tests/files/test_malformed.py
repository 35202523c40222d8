"""Malformed files: one message each, with line, key and remedy, exit status 2, and never a traceback."""

import re

import numpy as np
import pytest
from typer.testing import CliRunner

import perfcontrol as pc
from perfcontrol.cli import app

GOOD = """\
horizon = 4
memory = 1

[system]
A = [[0.5, 0.1], [0.0, 0.4]]
B = [[1.0], [0.5]]

[noise]
type = "Gaussian"
mean = [0.0, 0.0]
covariance = [[1.0, 0.0], [0.0, 1.0]]

[cost]
type = "QuadraticCost"
Q = [[1.0, 0.0], [0.0, 1.0]]
R = [[1.0]]

[perturbation]
type = "DirectionalPerturbation"
directions = [[[1.0, 0.0], [0.0, 1.0]]]
scale = { type = "Norm", offset = [0.1], weight = [0.1] }

[feasible_set]
type = "FrobeniusBall"
radius = 1.0

[solver]
type = "StablePoint"
"""


def change(old, new):
    """A file in which something stands in the place of something else, as text."""
    assert GOOD.count(old) == 1, old
    return GOOD.replace(old, new)


def line(text):
    return GOOD[: GOOD.index(text)].count("\n") + 1


NOISE = 'type = "Gaussian"\nmean = [0.0, 0.0]\ncovariance = [[1.0, 0.0], [0.0, 1.0]]'
SET = 'type = "FrobeniusBall"\nradius = 1.0'

# name: text or bytes, line (None: the message names none), words of the message
FILES = {
    # no TOML
    "empty": ("", None, ["a problem needs the key `system`", "nor horizon, noise, cost"]),
    "prose": ("dear computer, please find a stable policy", 1, ["valid TOML"]),
    "json": ('{"horizon": 4}', 1, ["valid TOML"]),
    "yaml with code": ("horizon: !!python/object/apply:os.system ['true']", 1, ["valid TOML"]),
    "open bracket": (change("[[0.5, 0.1], [0.0, 0.4]]", "[[0.5, 0.1], [0.0, 0.4]"), 6, ["valid TOML"]),
    "open string": (change('"Gaussian"', '"Gaussian'), 9, ["valid TOML"]),
    "no value": (change("horizon = 4", "horizon ="), 1, ["valid TOML"]),
    "fraction": (change("horizon = 4", "horizon = 8/2"), 1, ["valid TOML"]),
    "comma as decimal point": (change("radius = 1.0", "radius = 1,0"), 25, ["valid TOML"]),
    "expression": (change("radius = 1.0", "radius = __import__('os').getpid()"), 25, ["valid TOML"]),
    "null byte": (change("horizon = 4", "horizon = 4\0"), 1, ["valid TOML"]),
    "latin-1": (change("horizon = 4", "# Stabilit\xe4t\nhorizon = 4").encode("latin-1"), 1, ["UTF-8", "0xe4"]),
    "utf-16": (GOOD.encode("utf-16"), 1, ["UTF-8"]),
    "binary": (bytes(range(256)), 2, ["UTF-8"]),
    "pickle": (b"\x80\x04cos\nsystem\n(S'true'\ntR.", 1, ["UTF-8"]),
    "nested too deeply": ("A = " + 5000 * "[" + 5000 * "]", None, ["nested"]),
    "number of 5000 digits": (change("horizon = 4", "horizon = " + 5000 * "9"), None, ["reasonable size"]),
    # keys
    "key twice": (change("memory = 1", "memory = 1\nmemory = 2"), 3, ["given twice"]),
    "table twice": (GOOD + '[noise]\ntype = "Uniform"\n', 29, ["given twice"]),
    "unknown key": (change("memory = 1", "memroy = 1"), 2, ["`memroy`", "Did you mean 'memory'?"]),
    "unknown key in a table": (change("radius = 1.0", "raduis = 1.0"), 25, ["`feasible_set.raduis`", "'radius'"]),
    "unknown table": (change("[perturbation]", "[pertubation]"), 18, ["`pertubation`", "Did you mean 'perturbation'?"]),
    "unknown key inline": (change("offset = [0.1]", "ofset = [0.1]"), 21, ["`perturbation.scale.ofset`", "'offset'"]),
    "argument that only Python has": (GOOD + "transform = 1\n", 29, ["`solver.transform` is no key of StablePoint"]),
    "missing key": (change("covariance = [[1.0, 0.0], [0.0, 1.0]]\n", ""), 8, ["needs the key `covariance`", "(n, n)"]),
    "missing table": (change(f"[noise]\n{NOISE}", ""), None, ["needs the key `noise`", "[noise]", "Gaussian"]),
    "missing type": (change('type = "FrobeniusBall"\n', ""), 23, ["`feasible_set` must have a type", "RowSum"]),
    # types
    "unknown type": (change('"Gaussian"', '"Gausian"'), 9, ["`noise.type`", "Did you mean 'Gaussian'?"]),
    "type of another ingredient": (change('"FrobeniusBall"', '"Gaussian"'), 24, ["`feasible_set.type`", "Box"]),
    "type in another case": (change('"Gaussian"', '"gaussian"'), 9, ["Did you mean 'Gaussian'?"]),
    "type with its prefix": (change('"Gaussian"', '"pc.Gaussian"'), 9, ["Did you mean 'Gaussian'?"]),
    "type as a number": (change('type = "Gaussian"', "type = 3"), 9, ["`noise.type`", "got 3"]),
    "function": (change('"Norm"', '"Function"'), 21, ["holds a Python function", "pc.Affine"]),
    "sampler": (change('"DirectionalPerturbation"', '"SampledPerturbation"'), 19, ["holds a Python function"]),
    "text for a number": (change("horizon = 4", 'horizon = "4"'), 1, ["`horizon`", "a number", "the text '4'"]),
    "fraction of a step": (change("memory = 1", "memory = 1.5"), 2, ["`memory` must be a whole number", "1.5"]),
    "truth value for a number": (change("memory = 1", "memory = true"), 2, ["`memory` must be a whole number", "true"]),
    "text for a truth value": (GOOD + 'rescue = "no"\n', 29, ["`solver.rescue` must be true or false", "'no'"]),
    "number for a table": (change(f"[noise]\n{NOISE}", "[noise.x]\n"), 8, ["`noise` must have a type"]),
    "number for a law": (change(f"[noise]\n{NOISE}", "").replace("memory", "noise = 3\nmemory"), 2, ["`noise`", "3"]),
    "table for a matrix": (change("[[1.0], [0.5]]", "{ a = 1 }"), 6, ["`system.B`", "a table"]),
    "date for a matrix": (change("[[1.0], [0.5]]", "1979-05-27"), 6, ["`system.B`", "the time 1979-05-27"]),
    "text in a matrix": (change("[0.0, 0.4]", '[0.0, "0.4"]'), 5, ["`system.A[1][1]`", "the text '0.4'"]),
    "one of a few": (change("directions", 'law = "cauchy"\ndirections'), 20, ["`perturbation.law`", "rademacher"]),
    "list for a set": (change(SET, f'{SET}\n[[memory_]]\n'), 26, ["`memory_` is no key of a problem"]),
    "seed below zero": ("seed = -1\n" + GOOD, 1, ["`seed` must lie between 0 and 2^32 - 1"]),
    # shapes
    "ragged matrix": (change("[0.0, 0.4]", "[0.0]"), 5, ["`system.A[1]`", "as long as the rows before it"]),
    "number among rows": (change("[0.0, 0.4]", "0.4"), 5, ["`system.A[1]`", "a number after shape (2,)"]),
    "not square": (change("[[0.5, 0.1], [0.0, 0.4]]", "[[0.5, 0.1]]"), 5, ["`system.A` must have shape", "(1, 2)"]),
    "transposed": (change("[[1.0], [0.5]]", "[[1.0, 0.5]]"), 6, ["`system.B`", "swapped"]),
    "vector for a matrix": (change("[[1.0], [0.5]]", "[1.0, 0.5]"), 6, ["`system.B`", "single input as a column"]),
    "law of another dimension": (change("mean = [0.0, 0.0]", "mean = [0.0]"), 11, ["`noise.covariance`", "(1, 1)"]),
    "cost of another dimension": (change("R = [[1.0]]", "R = [[1.0, 0.0], [0.0, 1.0]]"), 16, ["`cost.R`", "(1, 1)"]),
    "direction without its axis": (
        change("[[[1.0, 0.0], [0.0, 1.0]]]", "[[1.0, 0.0], [0.0, 1.0]]"), 20, ["`perturbation.directions`", "[D]"]
    ),
    "scale of another length": (change("offset = [0.1]", "offset = [0.1, 0.2]"), 21, ["`perturbation.scale`", "(2,)"]),
    "start of another shape": ("M0 = [[0.0, 0.0]]\n" + GOOD, 1, ["`M0` must have shape", "(1, 1, 2)"]),
    "empty list": (change("R = [[1.0]]", "R = []"), 16, ["`cost.R`", "square"]),
    # values
    "nan": (change("radius = 1.0", "radius = nan"), 25, ["`feasible_set.radius` must be a number; got nan"]),
    "nan in a matrix": (change("[0.0, 0.4]", "[0.0, nan]"), 5, ["`system.A[1][1]` must be a number; got nan"]),
    "infinite matrix": (change("[0.0, 0.4]", "[0.0, inf]"), 5, ["`system.A` must have finite entries", "[1, 1]"]),
    "overflowing number": (change("[0.0, 0.4]", "[0.0, 1e999]"), 5, ["`system.A` must have finite entries"]),
    "huge whole number": (change("[0.0, 0.4]", "[0, 99999999999999999999]"), 5, ["`system.A[1][1]`", "2^63"]),
    "huge horizon": (change("horizon = 4", "horizon = 1000000000"), 1, ["`horizon` must be at most 1e+06"]),
    "huge memory": (
        change("horizon = 4", "horizon = 900000").replace("memory = 1", "memory = 800000000"), 2, ["`memory` must be"]
    ),
    "horizon of many digits": (change("horizon = 4", "horizon = 1" + 30 * "0"), 1, ["`horizon`", "31 digits"]),
    "nan horizon": (change("horizon = 4", "horizon = nan"), 1, ["`horizon`", "nan"]),
    "memory beyond the horizon": (change("memory = 1", "memory = 4"), 2, ["`memory` must be below the horizon 4"]),
    "indefinite cost": (change("R = [[1.0]]", "R = [[-1.0]]"), 16, ["`cost.R` must be positive semidefinite"]),
    "negative radius": (change("radius = 1.0", "radius = -1.0"), 25, ["`feasible_set.radius` must be nonnegative"]),
    "empty intersection": (
        change(SET, 'type = "Intersection"\nsets = [{ type = "Box", low = 1.0, high = 2.0 }, { type = "FrobeniusBall", '
               "radius = 0.1 }]"),
        25, ["`feasible_set.sets` must have a common point"],
    ),
    "start outside the set": ("M0 = [[[9.0, 0.0]]]\n" + GOOD, 1, ["`M0` must lie in the feasible set"]),
    "tolerance out of reach": (GOOD + "tolerance = 1e-30\n", 29, ["`solver.tolerance` must be at least"]),
    "method that does not apply": (
        change(f"[noise]\n{NOISE}", '[noise]\ntype = "Uniform"\nlow = -1\nhigh = 1').replace(
            'type = "QuadraticCost"\nQ = [[1.0, 0.0], [0.0, 1.0]]\nR = [[1.0]]',
            'type = "ConvexCost"\nfunction = { type = "Huber", threshold = 1.0 }',
        ).replace('type = "StablePoint"', 'type = "RSGD"\nsteps = 3\nstep_size = 0.1\ngradient = "Exact"'),
        line("[cost]"), ["`cost` must be a QuadraticCost", "pc.estimate_cost"],
    ),
    # experiments
    "unknown experiment": ('experiment = "stok_market"', 1, ["`experiment`", "Did you mean 'stock_market'?"]),
    "experiment and a key": ('horizon = 3\nexperiment = "stock_market"', 1, ["`horizon` is no key", "experiment"]),
    "argument of an experiment": ('[experiment]\ntype = "stock_market"\norder = "up"', 3, ["`experiment.order`"]),
    # files beside
    "path out of the folder": (change("[[1.0], [0.5]]", '"../secret.npy"'), 6, ["in the folder of this one"]),
    "absolute path": (change("[[1.0], [0.5]]", '"/etc/passwd.csv"'), 6, ["in the folder of this one"]),
    "link out of the folder": (change("[[1.0], [0.5]]", '"link.npy"'), 6, ["in the folder of this one"]),
    "file that is not there": (change("[[1.0], [0.5]]", '"B.csv"'), 6, ["'B.csv', which is not there"]),
    "folder for a file": (change("[[1.0], [0.5]]", '"folder.npy"'), 6, ["which is not there"]),
    "file of another kind": (change("[[1.0], [0.5]]", '"B.mat"'), 6, ["`system.B`", ".csv or .npy"]),
    "null byte in a name": (change("[[1.0], [0.5]]", '"a\\u0000.csv"'), 6, ["which is not there"]),
    "name of 5000 letters": (change("[[1.0], [0.5]]", f'"{5000 * "a"}.csv"'), 6, ["which is not there"]),
    "pickled array": (change("[[1.0], [0.5]]", '"objects.npy"'), 6, ["objects.npy", "NumPy file of numbers"]),
    "text as an array": (change("[[1.0], [0.5]]", '"text.npy"'), 6, ["text.npy", "NumPy file of"]),
    "complex array": (change("[[1.0], [0.5]]", '"complex.npy"'), 6, ["complex128", "real numbers"]),
    "cut array": (change("[[1.0], [0.5]]", '"cut.npy"'), 6, ["cut.npy", "NumPy file of numbers"]),
    "array that promises a terabyte": (change("[[1.0], [0.5]]", '"promise.npy"'), 6, ["promise.npy"]),
    "no array at all": (change("[[1.0], [0.5]]", '"empty.npy"'), 6, ["empty.npy", "NumPy file of numbers"]),
    "nan in an array": (change("[[1.0], [0.5]]", '"nan.npy"'), 6, ["nan at [1, 0] of 'nan.npy'"]),
    "array of another shape": (change("[[1.0], [0.5]]", '"three.npy"'), 6, ["`system.B` must have 2 rows", "(3, 1)"]),
    "words in a table": (change("[[1.0], [0.5]]", '"words.csv"'), 6, ["words.csv: line 2, column 1", "'high'"]),
    "ragged table": (change("[[1.0], [0.5]]", '"ragged.csv"'), 6, ["ragged.csv: line 3 must have 2 numbers"]),
    "table without numbers": (change("[[1.0], [0.5]]", '"names.csv"'), 6, ["names.csv: the file must hold numbers"]),
    "missing number": (change("[[1.0], [0.5]]", '"gap.csv"'), 6, ["gap.csv: line 1, column 2"]),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files that the malformed ones name."""
    folder = tmp_path_factory.mktemp("files")
    np.save(folder / "secret.npy", np.ones((2, 1)))
    inside = folder / "inside"
    inside.mkdir()
    (inside / "folder.npy").mkdir()
    (inside / "link.npy").symlink_to(folder / "secret.npy")
    np.save(inside / "objects.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.save(inside / "text.npy", np.array(["1.0", "0.5"]))
    np.save(inside / "complex.npy", np.ones((2, 1)) + 1j)
    np.save(inside / "nan.npy", np.array([[1.0], [np.nan]]))
    np.save(inside / "three.npy", np.ones((3, 1)))
    whole = (inside / "three.npy").read_bytes()
    (inside / "cut.npy").write_bytes(whole[:-3])
    (inside / "empty.npy").write_bytes(b"")
    header = whole[: whole.index(b"\n")].replace(b"(3, 1)", b"(99999999999, 1)")
    (inside / "promise.npy").write_bytes(header[: len(whole) - 25] + b"\n" + bytes(24))
    (inside / "words.csv").write_text("1.0\nhigh\n")
    (inside / "ragged.csv").write_text("a,b\n1.0,2.0\n1.0\n")
    (inside / "names.csv").write_text("# nothing\na,b\n")
    (inside / "gap.csv").write_text("1.0,,2.0\n")
    return inside


def refusal(folder, content, *options):
    """What `perfcontrol solve` says of a file that it refuses."""
    path = folder / "problem.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    result = CliRunner().invoke(app, ["--no-cache", "solve", str(path), "--no-certify", *options])
    assert result.exit_code == 2, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert "Traceback" not in result.output
    (said,) = result.stderr.strip().split("\n")
    return said


def test_there_are_enough_of_them_and_the_good_file_is_good(folder):
    assert len(FILES) >= 60
    (folder / "good.toml").write_text(GOOD)
    assert isinstance(pc.load(folder / "good.toml"), pc.PerformativeProblem)


@pytest.mark.parametrize("name", FILES)
def test_malformed_file_is_refused_in_one_line_with_status_two(name, folder):
    content, number, words = FILES[name]
    said = refusal(folder, content)
    found = re.search(r"problem\.toml, line (\d+)", said)
    assert said.startswith("error: ") and said.endswith((".", "?")), said
    assert (int(found[1]) if found else None) == number, said
    for word in words:
        assert word in said, said


def test_file_of_a_hundred_megabytes_is_refused_at_once(folder):
    with (folder / "large.toml").open("wb") as file:
        file.truncate(100 * 2**20)  # sparse: nothing is written, and nothing must be read
    result = CliRunner().invoke(app, ["--no-cache", "solve", str(folder / "large.toml")])
    assert result.exit_code == 2 and "at most 8 MiB" in result.stderr
    with pytest.raises(pc.InputError, match="at most 8 MiB"):
        pc.load(folder / "large.toml")


def test_paths_that_are_no_files_are_refused(folder):
    none, empty = folder / "none.toml", folder / "folder.npy"
    for path, words in ((none, "does not exist"), (empty, "does not exist"), ("/dev/zero", "no regular file")):
        result = CliRunner().invoke(app, ["--no-cache", "solve", str(path)])
        assert result.exit_code == 2 and words in result.stderr.replace("\n", " ")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("horizon", "be key=value"),
        ("=3", "be key=value"),
        ("horizon.x=3", "horizon is neither a table"),
        ("cost.Q.9.0=3", "cost.Q.9 is neither"),
        ("cost.Z=3", "`cost.Z` is no key of QuadraticCost"),
        ("memory=[1", "`memory` must be a whole number"),
        ("seed=-1", "`seed` must lie between"),
    ],
)
def test_wrong_changes_are_refused(setting, words, folder):
    assert words in refusal(folder, GOOD, "--set", setting)


def test_nothing_in_files_is_executed():
    from pathlib import Path

    import perfcontrol.files

    room = Path(perfcontrol.files.__file__).parent
    text = "\n".join(path.read_text() for path in room.glob("*.py"))
    assert not re.search(r"\b(pickle\.|eval\(|exec\(|yaml|marshal|allow_pickle=True)", text)
