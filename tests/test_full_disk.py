"""A disk that fills up at every possible moment, and one that takes no writing: an error that says so, and no damage.

The disk is a memory file system of a few kilobytes, mounted in a namespace of this test's own.
"""

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.__main__ import main
from perfcontrol.solvers import checkpoint, history
from tests.solvers.problems import drifting

ROOT = Path(__file__).parents[1]
NAMESPACE = ("unshare", "--map-root-user", "--mount")
STEP, PAGE_STEP, LARGEST = 4, 100, 4000  # kilobytes
KEY = jax.random.key(3)
STABLE = pc.StablePoint()
PROBLEM = """
horizon = 10
system = { A = [[0.5]], B = [[1.0]] }
noise = { type = "Uniform", low = -1.0, high = 1.0 }
cost = { type = "QuadraticCost", Q = [[1.0]], R = [[1.0]] }
"""


def one_run(folder):
    pc.solve(drifting(), pc.RSGD(3000, 0.002), key=KEY, checkpoint=folder / "one")


def many_runs(folder):
    pc.solve_many(drifting(), pc.RSGD(30, 0.002), keys=jax.random.split(KEY, 200), checkpoint=folder / "many")


def kept_run(folder):
    problem = pc.experiments.stock_market("random")
    run = pc.Run(problem, pc.solve(problem, STABLE), STABLE, versions={"none": "0"})
    pc.save(run, folder / "run")


def a_page(folder):
    problem = drifting()
    pc.report(problem, pc.solve(problem, pc.RSGD(100, 0.002), key=KEY), path=folder / "page.html")


WRITERS = {"one run": one_run, "many runs": many_runs, "kept run": kept_run, "page": a_page}
RESUMED = ("one run", "many runs")


def mount(disk, *options):
    subprocess.run(("mount", "-t", "tmpfs", "-o", ",".join(options), "tmpfs", disk), check=True)


def contents(folder):
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "lock"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def refused(write, disk, number):
    """Whether writing failed as it should."""
    try:
        write(disk)
    except OSError as error:
        assert error.errno == number, repr(error)
        assert str(error.filename).startswith(str(disk)), repr(error)
        hidden = [name for name in contents(disk) if Path(name).name.startswith(".")]
        assert not hidden, hidden
        return True
    return False


def inside(disk, whole):
    """What is checked on the disk of the namespace; `whole` is a folder where there is room."""
    checkpoint.PAUSE = 0  # saved as often as can be
    history.PIECE = 1000
    for name, write in WRITERS.items():
        shutil.rmtree(whole, ignore_errors=True)
        whole.mkdir()
        write(whole)
        mount(disk, f"size={STEP}k")
        failures = 0
        for size in range(STEP, LARGEST, PAGE_STEP if name == "page" else STEP):
            mount(disk, "remount", f"size={size}k")
            before = contents(disk)
            if not refused(write, disk, errno.ENOSPC):
                break
            failures += 1
            if name in RESUMED:  # what was finished stays as it was
                after = contents(disk)
                assert {file: after.get(file) for file in before if "runs-" in file} == {
                    file: data for file, data in before.items() if "runs-" in file
                }
            else:
                assert not contents(disk), "half of it is there"
        assert failures > 1
        print(f"{name}: a full disk {failures} times", file=sys.stderr)
        after, expected = contents(disk), contents(whole)
        if name not in RESUMED:  # their files hold the time of day
            assert after.keys() == expected.keys()
        if name == "kept run":
            np.testing.assert_array_equal(pc.load(disk / "run").solution.M, pc.load(whole / "run").solution.M)
        if name in RESUMED:
            assert after == expected
        mount(disk, "remount", "ro")
        for other, elsewhere in WRITERS.items():
            if other != name:
                assert refused(elsewhere, disk, errno.EROFS), other
        assert contents(disk) == after
        subprocess.run(("umount", disk), check=True)


def commands(disk, problem):
    """The commands on a disk without room, and on one that takes no writing: status 1 and one line."""
    problem.write_text(PROBLEM)
    for options, reason in (("size=4k", "the disk is full"), ("ro", "the disk is read-only")):
        mount(disk, options)
        if options != "ro":
            (disk / "filler").write_bytes(bytes(4096))
        for command in (
            ("new", disk / "new.toml"),
            ("solve", problem, "--out", disk / "run"),
            ("sweep", problem, "--out", disk / "sweep", "--vary", "horizon=10,11"),
            ("simulate", problem, "--out", disk / "paths.nc"),
            ("report", problem, "--out", disk / "page.html"),
            ("reproduce", "--out", disk / "paper"),
        ):
            sys.argv = ["perfcontrol", *map(str, command)]
            try:
                main()
                raise AssertionError(f"{command[0]} ended well")
            except SystemExit as end:
                assert end.code == 1, (command, end.code)
            print(command[0], reason, file=sys.stderr)
        subprocess.run(("umount", disk), check=True)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["inside", "commands"])
def test_full_or_read_only_disk_is_said_and_damages_nothing(tmp_path, part):
    if shutil.which("unshare") is None or subprocess.run((*NAMESPACE, "true"), check=False).returncode:
        pytest.skip("mounting a disk of one's own needs Linux with user namespaces")
    disk, other = tmp_path / "disk", tmp_path / "other"
    disk.mkdir()
    call = f"import tests.test_full_disk as t; t.{part}(t.Path({str(disk)!r}), t.Path({str(other)!r}))"
    command = (*NAMESPACE, sys.executable, "-W", "ignore", "-c", call)
    done = subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    print(done.stderr)
