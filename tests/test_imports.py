"""What importing the package costs, and what its names are."""

import subprocess
import sys

import pytest

import perfcontrol as pc

HEAVY = ("pandas", "matplotlib", "xarray", "gymnasium", "control", "pydantic", "typer", "rich", "h5netcdf", "optax")


def loaded(program: str, names: tuple[str, ...]) -> str:
    """Which of the modules a fresh interpreter has loaded after the program."""
    program = f"{program}; import sys; print([name for name in {names!r} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.strip()


def test_package_import_loads_none_of_the_application_packages() -> None:
    assert loaded("from perfcontrol import *; StablePoint()", (*HEAVY, "scipy.stats", "scipy.integrate")) == "[]"


def test_jax_waits_until_a_public_name_is_asked_for() -> None:
    assert loaded("import perfcontrol, perfcontrol.cli", ("jax", "numpy")) == "[]"
    assert loaded("import perfcontrol; perfcontrol.StablePoint", ("jax",)) == "['jax']"


def test_rooms_are_at_hand_and_do_not_hide_functions() -> None:
    program = "import perfcontrol.identification.logs, perfcontrol as pc; assert callable(pc.fit); pc.plotting.style"
    assert loaded(program, ("matplotlib",)) == "['matplotlib']"


def test_names_are_listed_and_others_refused() -> None:
    assert set(pc.__all__) <= set(dir(pc))
    for name in pc.__all__:
        assert getattr(pc, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'StablePolicy'"):
        pc.StablePolicy  # noqa: B018
    with pytest.raises(ImportError):
        from perfcontrol import StablePolicy  # noqa: F401
