"""Results on disk: labelled arrays in NetCDF, tables in JSON and Markdown, each file written whole or not at all."""

import importlib.metadata
import io
import json
import platform
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray

from perfcontrol._files import naming, written_whole


def check_writable(folder: Path) -> None:
    """Make the folder and write in it, so that OSError comes before the work and not after it."""
    folder.mkdir(parents=True, exist_ok=True)
    with naming(folder), tempfile.TemporaryFile(dir=folder) as probe:
        probe.write(b"probe")


def versions() -> dict[str, str]:
    """What the numbers depend on."""
    names = ("perfcontrol", "jax", "jaxlib", "numpy", "equinox")
    return {"python": platform.python_version(), **{name: importlib.metadata.version(name) for name in names}}


def save_dataset(dataset: xarray.Dataset, path: Path, attributes: Mapping[str, Any]) -> None:
    """Write a dataset as NetCDF with settings and versions in its attributes (nested ones as JSON)."""
    plain = {
        key: value if isinstance(value, str | int | float) else json.dumps(value) for key, value in attributes.items()
    }
    dataset = dataset.assign_attrs({**plain, "versions": json.dumps(versions())})
    encoding = {str(name): {"zlib": True, "complevel": 1} for name, values in dataset.data_vars.items() if values.ndim}
    whole = io.BytesIO()  # HDF5 itself reports a full disk late, and not as an OSError
    dataset.to_netcdf(whole, engine="h5netcdf", encoding=encoding)
    with written_whole(path) as temporary:
        temporary.write_bytes(whole.getbuffer())


def load_dataset(path: Path) -> xarray.Dataset:
    """Read a dataset into memory and close the file."""
    with xarray.open_dataset(path, engine="h5netcdf") as dataset:
        return dataset.load()


def save_json(data: Any, path: Path) -> None:
    """Write JSON; non-finite numbers are refused."""
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def save_text(text: str, path: Path) -> None:
    """Write text."""
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
