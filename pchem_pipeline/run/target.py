"""Which run is meant: its configuration, the folder of its paths, its store, its YAML file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pchem_pipeline.base.errors import ConfigError, StoreError, quoted
from pchem_pipeline.config.load import load_config, make_config, parse_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.store.files import read_record
from pchem_pipeline.store.remote_path import place_of
from pchem_pipeline.store.run_store import RunStore, stored_config


@dataclass(frozen=True)
class Target:
    """A run: its configuration, the folder its paths refer to, its store, and its YAML file if it has one."""

    config: RunConfig
    base_dir: Path
    store: Path
    config_path: Path | None = None

    def changed(self, section: str, **values: object) -> Target:
        """Return the same run with other values in a section of its configuration."""
        content = self.config.model_dump(by_alias=True)
        content[section] = {**content[section], **values}
        return replace(self, config=make_config(content, "the command line"))

    def sensor(self, store: RunStore) -> SensorInfo:
        """Return its input, with the bit depth and integration time of its configuration, if these are set.

        Raises:
            StoreError: nothing was ingested yet.
        """
        return SensorInfo.read(store).with_settings(self.config.input)

    def stored(self, *, writable: bool = False) -> RunStore:
        """Return its store.

        Raises:
            StoreError: it was never run, or its store cannot be used.
        """
        if self.config_path is not None and not self.store.exists():
            raise StoreError(
                f"there is no run at {self.store} yet; run: pchem run {quoted(self.config_path)}"
            )
        return RunStore.open(self.store, writable=writable)


def with_maps(store: RunStore) -> RunStore:
    """Return a run that has maps.

    Raises:
        StoreError: it has none.
    """
    if "summary" not in store.attributes("maps"):
        raise StoreError(f"{store.path} has no maps yet; run: pchem maps {quoted(store.path)}")
    return store


def find_run(path: Path) -> Target:
    """Return the run that a YAML file or a store belongs to.

    Raises:
        ConfigError: neither a YAML file nor a store, or its content is wrong.
        StoreError: the store is missing or damaged.
    """
    path = place_of(path)
    if path.is_dir():
        text = stored_config(path)
        if text is None:
            RunStore.open(path)  # says so where it is no run at all
            raise StoreError(f"{path} has no configuration; give its YAML file")
        cure = "give the run's YAML file instead of its store"
        location = read_record(path / ".pchem" / "location.json", cure) or {}
        written = location.get("config")
        return Target(
            parse_config(text, str(path)),
            Path(location.get("base_dir", path.parent)),
            path,
            None if written is None else Path(written),
        )
    if path.suffix.lower() not in (".yaml", ".yml"):
        if not path.exists():
            raise StoreError(f"{path} does not exist; give a config.yaml or the store of a run")
        raise ConfigError(f"{path} is neither a YAML file nor a run; give a config.yaml or a run's store")
    config = load_config(path)
    base_dir = path.resolve().parent
    return Target(config, base_dir, place_of(config.run.store, base_dir), path.resolve())
