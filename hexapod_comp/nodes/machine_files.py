"""The geometry and the model that a compensator's parameters name, read from where they may be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..compensation.journal import IDEAL_SOURCE, Source
from ..formats.paths import confined_file, folder_of
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel
from ..machine.model_file import IDEAL
from .model_loading import Loading
from .parameters import ParameterError


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
        self.sources["geometry"] = Source.read(self._path(self._geometry_file))
        return self.sources["geometry"].geometry()

    def model(self, geometry: HexapodGeometry) -> MachineModel:
        """Read the model."""
        path = self._model_path()
        self.sources["model"] = IDEAL_SOURCE if path is None else Source.read(path)
        return self.sources["model"].model(geometry.name)

    def begin_loading(self, machine: str) -> Loading:
        """Begin to read the model of a machine again, elsewhere."""
        return Loading(self._model_path(), machine)

    def described(self, model: MachineModel) -> str:
        """Return what to say of the model at the start."""
        if self._model_file == IDEAL:
            return "the ideal model, which corrects nothing (parameter model_file)"
        return f"model {model.name!r}"

    def _model_path(self) -> Path | None:
        """Return the model's file; None for the ideal model, which has none."""
        return None if self._model_file == IDEAL else self._path(self._model_file)

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
