"""What importing the package costs."""

import subprocess
import sys

HEAVY = ("pandas", "matplotlib", "xarray", "gymnasium", "control", "pydantic", "typer", "rich", "h5netcdf", "optax")


def test_package_import_loads_none_of_the_application_packages() -> None:
    program = f"import sys, perfcontrol; print([name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
