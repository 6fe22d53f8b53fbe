"""The geometry and the model that a compensator's parameters name, read from where they may be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..compensation.journal import Source, load_with_source
from ..formats.paths import confined_file, folder_of
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import MachineModel
from ..machine.model_file import load_model
from .model_loading import Loading
from .parameters import ParameterError

IDEAL = "ideal"
"""The word for no model."""


class MachineFiles:
    """Files of a machine, each from its own folder at the start, or from ``model_folder``.

    Parameters
    ----------
    options : dict
        The node's parameters.

    Attributes
    ----------
    sources : dict of str to Source
        What was read last, word for word: ``geometry`` and ``model``.

    Raises
    ------
    ParameterError
        ``model_folder`` is no folder.
    """

    def __init__(self, options: dict[str, Any]) -> None:
        self._geometry_file, self._model_file = options["geometry_file"], options["model_file"]
        self._folders = {name: _folder(name, options) for name in (self._geometry_file, self._model_file)}
        self.sources: dict[str, Source] = {}

    def geometry(self) -> HexapodGeometry:
        """Read the geometry."""
        geometry, self.sources["geometry"] = load_with_source(self._path(self._geometry_file), load_geometry)
        return geometry

    def model(self, geometry: HexapodGeometry) -> MachineModel:
        """Read the model."""
        if self._model_file == IDEAL:
            self.sources["model"] = Source.of(IDEAL, "")
            return MachineModel(geometry.name)
        path = self._path(self._model_file)
        model, self.sources["model"] = load_with_source(path, lambda file: load_model(file, geometry))
        return model

    def begin_loading(self, machine: str) -> Loading:
        """Begin to read the model of a machine again, elsewhere."""
        return Loading(None if self._model_file == IDEAL else self._path(self._model_file), machine)

    def described(self, model: MachineModel) -> str:
        """Return what to say of the model at the start."""
        if self._model_file == IDEAL:
            return "the ideal model, which corrects nothing (parameter model_file)"
        return f"model {model.name!r}"

    def _path(self, name: str) -> Path:
        return confined_file(name, self._folders[name])


def _folder(name: str, options: dict[str, Any]) -> Path | None:
    """Return the folder from which a file may be read."""
    configured = options["model_folder"]
    if not configured:
        return folder_of(name)
    folder = Path(configured).expanduser()
    if not folder.is_dir():
        raise ParameterError(f"parameter model_folder: {configured!r} is not a folder")
    return folder
