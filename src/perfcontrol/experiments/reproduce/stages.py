"""Stages kept on disk, so that a killed run resumes."""

import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import xarray

from perfcontrol.config import ReproduceSettings
from perfcontrol.results import load_dataset, save_dataset, versions

Value = TypeVar("Value")


class Stages:
    """Stages kept on disk under the fingerprint of what they depend on; a finished one is read, not run again."""

    def __init__(self, folder: Path, settings: ReproduceSettings, fresh: bool):
        self.folder, self.settings, self.fresh = folder, settings, fresh
        text = json.dumps([settings.model_dump(), versions()], sort_keys=True)
        self.fingerprint = hashlib.sha256(text.encode()).hexdigest()[:16]
        self.seconds: dict[str, float] = {}

    def run(self, name: str, compute: Callable[[], xarray.Dataset]) -> xarray.Dataset:
        path = self.folder / f"{name}.nc"
        if not self.fresh and path.exists():
            try:
                dataset = load_dataset(path)
            except (OSError, ValueError, KeyError):  # not ours, or cut short by an older version: run again
                dataset = None
            if dataset is not None and dataset.attrs.get("fingerprint") == self.fingerprint:
                self.seconds[name] = 0.0
                return dataset

        def computed() -> xarray.Dataset:
            dataset = compute()
            attributes = {"settings": self.settings.model_dump(), "fingerprint": self.fingerprint}
            save_dataset(dataset, path, attributes)
            return dataset

        return self.timed(name, computed)

    def timed(self, name: str, work: Callable[[], Value]) -> Value:
        """What `work` gives, the seconds that it took added to those of the stage."""
        began = time.monotonic()
        value = work()
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - began
        return value
