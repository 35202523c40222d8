"""Files are written whole or not at all."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray

from perfcontrol import results


def test_written_whole_leaves_the_old_file_when_the_block_fails(tmp_path: Path) -> None:
    target = tmp_path / "table.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), results.written_whole(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_save_dataset_round_trips_values_settings_and_versions(tmp_path: Path) -> None:
    dataset = xarray.Dataset({"error": (("seed", "step"), np.arange(6.0).reshape(2, 3))})
    results.save_dataset(dataset, tmp_path / "deep" / "runs.nc", {"settings": {"seeds": 2}, "fingerprint": "ab"})
    loaded = results.load_dataset(tmp_path / "deep" / "runs.nc")
    np.testing.assert_array_equal(loaded["error"], dataset["error"])
    assert json.loads(loaded.attrs["settings"]) == {"seeds": 2}
    assert "jax" in json.loads(loaded.attrs["versions"])


def test_save_json_refuses_non_finite_numbers_and_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        results.save_json({"value": float("nan")}, tmp_path / "claims.json")
    assert list(tmp_path.iterdir()) == []
