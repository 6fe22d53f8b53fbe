"""The geometry and the model that a compensator's parameters name, read from where they may be read."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ..compensation.journal import IDEAL_SOURCE, Source
from ..formats.paths import confined_file, confined_opener, folder_of
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel
from ..machine.model_file import IDEAL
from .model_loading import Loading, ModelName
from .parameters import ParameterError


class MachineFiles:
    """Files of a machine, as its parameters name them now, each from its folder at the start or from ``model_folder``.

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
        self._options = options
        self._folders = {kind: _folder(options[f"{kind}_file"], options) for kind in ("geometry", "model")}
        self.sources: dict[str, Source] = {}

    def geometry(self) -> HexapodGeometry:
        """Read the geometry."""
        self.sources["geometry"] = self._read("geometry")
        return self.sources["geometry"].geometry()

    def model(self, geometry: HexapodGeometry) -> MachineModel:
        """Read the model; the ideal one has no file."""
        self.sources["model"] = IDEAL_SOURCE if self._options["model_file"] == IDEAL else self._read("model")
        return self.sources["model"].model(geometry.name)

    def begin_loading(self, machine: str) -> Loading:
        """Begin to read the model of a machine again, elsewhere."""
        name = self._options["model_file"]
        return Loading(None if name == IDEAL else ModelName(name, _place(), self._folders["model"]), machine)

    def handed_on(self) -> dict[str, Any]:
        """Return what another process needs to make geometry and model of the same texts, for JSON."""
        folder = self._folders["model"]
        return {**{name: vars(source) for name, source in self.sources.items()}, "folder": folder and str(folder)}

    def described(self, model: MachineModel) -> str:
        """Return what to say of the model at the start."""
        if self._options["model_file"] == IDEAL:
            return "the ideal model, which corrects nothing (parameter model_file)"
        return f"model {model.name!r}"

    def _read(self, kind: str) -> Source:
        folder = self._folders[kind]
        return Source.read(confined_file(self._options[f"{kind}_file"], folder, kind), confined_opener(folder))


def _place() -> str:
    """Return the folder that relative paths start from; where it was deleted, only absolute ones are found."""
    try:
        return os.getcwd()
    except FileNotFoundError:
        return os.sep


def _folder(name: str, options: dict[str, Any]) -> Path | None:
    """Return the folder from which a file may be read."""
    configured = options["model_folder"]
    if not configured:
        return folder_of(name)
    folder = Path(configured).expanduser()
    if not folder.is_dir():
        raise ParameterError(f"parameter model_folder: {configured!r} is not a folder")
    return folder
