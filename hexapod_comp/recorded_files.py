"""The geometry and the model that a recording was made with."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from .errors import InputFileError
from .geometry import HexapodGeometry, load_geometry
from .journal import Source
from .machine import MachineModel
from .model_file import load_model
from .recording import Recording

IDEAL = Source.of("", "").sha256
"""Hash of the model that is none."""


class Files:
    """Finds geometries and models by their hash: in the recording, and among files that the user names.

    Parameters
    ----------
    recording : Recording
        Carries its own, unless they were not recorded.
    given : mapping of str to Source
        More, by hash.
    """

    def __init__(self, recording: Recording, given: Mapping[str, Source]) -> None:
        self._path = recording.path
        self._sources = {**recording.sources, **given}
        self._geometries: dict[str, HexapodGeometry] = {}
        self._models: dict[tuple[str, str], MachineModel] = {}
        pages = [page for _, page in recording.pages]
        models = [entry.values for page in pages for entry in page.entries if entry.what == "model"]
        self.used = {one["sha256"] for page in pages for one in (page.geometry, page.model)}
        self.used |= {str(one["sha256"]) for one in models}

    @property
    def used_ideal(self) -> bool:
        """Whether there was a time without a model."""
        return IDEAL in self.used

    def missing(self) -> str | None:
        """Return the hash of a file that was in use and is not at hand, None when all are."""
        absent = (s for s in sorted(self.used) if s != IDEAL and not getattr(self._sources.get(s), "text", None))
        return next(absent, None)

    def geometry(self, identity: Mapping[str, str]) -> HexapodGeometry:
        """Return a geometry by its name and hash."""
        sha = identity["sha256"]
        if sha not in self._geometries:
            self._geometries[sha] = self._load("machine", identity, load_geometry)
        return self._geometries[sha]

    def model(self, identity: Mapping[str, str], geometry: HexapodGeometry) -> MachineModel:
        """Return a model by its name and hash."""
        key = identity["sha256"], geometry.name
        if key not in self._models:
            if identity["sha256"] == IDEAL:
                self._models[key] = MachineModel(geometry.name)
            else:
                self._models[key] = self._load("model", identity, lambda path: load_model(path, geometry))
        return self._models[key]

    def _load(self, what: str, identity: Mapping[str, str], load: Callable[[Path], Any]) -> Any:
        source = self._sources.get(identity["sha256"])
        if source is None or source.text is None:
            problem = (
                f"does not carry the {what} {identity.get('name', '')!r} that was in use; "
                f"give its file with --{what} (sha256 {identity['sha256']})"
            )
            raise InputFileError(self._path, "", problem)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "text.yaml"
            path.write_text(source.text, encoding="utf-8")
            try:
                return load(path)
            except InputFileError as error:
                # A file of another version of this package, most likely: name the bag, not our copy.
                raise InputFileError(self._path, f"{source.name}: {error.key}", error.problem, error.value) from error
