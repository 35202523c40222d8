"""Files are written whole or not at all."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray

from perfcontrol import results
from perfcontrol._files import written_whole


def test_written_whole_leaves_the_old_file_when_the_block_fails(tmp_path: Path) -> None:
    target = tmp_path / "table.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), written_whole(target) as temporary:
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


def test_full_disk_is_reported_with_the_file_that_was_meant(tmp_path: Path) -> None:
    target = tmp_path / "table.txt"
    with pytest.raises(OSError) as caught, written_whole(target):
        raise OSError(28, "No space left on device")  # as `write` raises it: without a name
    assert caught.value.filename == str(target)
    assert list(tmp_path.iterdir()) == []


def test_folder_in_the_place_of_the_file_is_reported_without_the_temporary_name(tmp_path: Path) -> None:
    (tmp_path / "runs.nc").mkdir()
    with pytest.raises(IsADirectoryError) as caught:
        results.save_dataset(xarray.Dataset(), tmp_path / "runs.nc", {})
    assert (caught.value.filename, caught.value.filename2) == (str(tmp_path / "runs.nc"), None)
    assert [path.name for path in tmp_path.iterdir()] == ["runs.nc"]


def test_check_writable_leaves_nothing_behind_and_names_the_folder(tmp_path: Path, monkeypatch) -> None:
    results.check_writable(tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []

    def refuse(**_):
        raise PermissionError(13, "Permission denied", "some temporary name")

    monkeypatch.setattr(results.tempfile, "TemporaryFile", refuse)
    with pytest.raises(PermissionError) as caught:
        results.check_writable(tmp_path / "new")
    assert caught.value.filename == str(tmp_path / "new")
