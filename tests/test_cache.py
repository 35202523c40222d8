"""Compiled programs on disk, in processes of their own: the switch changes JAX's configuration."""

import subprocess
import sys
from pathlib import Path

import pytest

import perfcontrol as pc
from tests.tools import assert_refused

PROGRAM = """
import jax, sys
jax.numpy.ones(3).sum().block_until_ready()  # something is compiled before the switch
import perfcontrol as pc
pc.cache(sys.argv[1])
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("cache_hits") else None)
jax.jit(lambda x: (x * 3).sum())(jax.numpy.arange(5.0)).block_until_ready()
print(len(hits))
"""


def hits(folder: Path) -> int:
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(folder)], capture_output=True, text=True, check=True)
    return int(done.stdout)


def test_a_second_process_finds_what_the_first_has_compiled(tmp_path):
    folder = tmp_path / "new" / "folder"
    assert hits(folder) == 0
    assert hits(folder) > 0


@pytest.mark.parametrize("name", ["taken", "taken/below"])
def test_cache_is_refused_where_it_cannot_be_written(tmp_path, name):
    (tmp_path / "taken").write_text("")
    assert_refused(lambda: pc.cache(tmp_path / name), "path", "taken")
