"""What a fit knows of its parameters and how well, kept in a file beside the model file.

The model file names it with its hash, so that one model's figures are never taken for another's. The file holds all
that the readings left behind: parameters, covariance, tolerances and noise, and what they mean. New readings can be
added to it without the old ones.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import HexapodError, InputFileError, ModelError, PoseError
from ..formats.outputs import new_file
from ..formats.paths import input_file
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel
from ..machine.model_file import save_model
from ..measurements.readings import KINDS
from ..pose import Pose
from .datum import HeldDatum
from .fit import ModelFit
from .parameters import FitSettings, ParameterSpace, Region

FORMAT = "hexapod_comp/posterior"
VERSION = 1

SUFFIX = ".posterior.npz"

HELD = ("datum_position", "datum_rotation", "datum_part", "datum_given_up")
"""Arrays of a held datum."""

MOST_BYTES = 200_000_000
"""Larger arrays are no fit's: some 5000 parameters."""


@dataclass(frozen=True)
class FittedParameters:
    """The parameters of a joint fit and how well they are known.

    Attributes
    ----------
    space : ParameterSpace
        What they mean.
    x : ndarray, shape (size,)
        The most probable ones, SI.
    covariance : ndarray, shape (size, size)
        Theirs.
    tolerances : ndarray, shape (blocks,)
        Size of each block's prior.
    noise : ndarray, shape (kinds,)
        Factor on the stated standard deviation of each kind's readings.
    held : HeldDatum or None
        Where the model holds the tool; `x` and `covariance` are as readings and priors left them, before. None in
        older files.
    """

    space: ParameterSpace
    x: np.ndarray
    covariance: np.ndarray
    tolerances: np.ndarray
    noise: np.ndarray
    held: HeldDatum | None = None

    @staticmethod
    def of(fit: ModelFit) -> FittedParameters:
        """Return what a fit knows."""
        posterior = fit.solution.posterior
        return FittedParameters(
            fit.space, fit.solution.x, fit.covariance, posterior.tolerances, posterior.noise, fit.held
        )


def save_with_posterior(model: MachineModel, fitted: FittedParameters | None, path: str | Path) -> list[Path]:
    """Write a model file, and beside it what its fit knows; return what was written beside.

    Parameters
    ----------
    model : MachineModel
        The model.
    fitted : FittedParameters or None
        What the fit knows; None where nobody knows, as after scheme lines.
    path : str or Path
        The model file. Into a pipe only the model is written.

    Raises
    ------
    InputFileError
        A file cannot be written.
    """
    file = Path(path)
    if fitted is None or (file.exists() and not file.is_file()):
        save_model(model, path)
        return []
    beside, content = file.with_name(file.stem + SUFFIX), _content(fitted)
    with new_file(beside, "wb") as stream:  # first: a model file never names what is not there yet
        stream.write(content)
    posterior = beside.name, hashlib.sha256(content).hexdigest()
    save_model(replace(model, origin=replace(model.origin, posterior=posterior)), path)
    return [beside]


def _content(fitted: FittedParameters) -> bytes:
    space, stream = fitted.space, io.BytesIO()
    head = {"format": FORMAT, "version": VERSION, "machine": space.geometry.name, "settings": asdict(space.settings)}
    head["kinds"] = KINDS
    arrays = {name: getattr(fitted, name) for name in ("x", "tolerances", "noise")}
    arrays["covariance"] = fitted.covariance[np.tril_indices(space.size)]  # it is symmetric
    arrays |= {f"region_{name}": value for name, value in vars(space.region).items()}
    if fitted.held is not None:
        values = fitted.held.pose.position, fitted.held.pose.rotation, fitted.held.part, fitted.held.given_up
        arrays |= dict(zip(HELD, values, strict=True))
    np.savez_compressed(stream, head=np.array(json.dumps(head)), labels=np.array(space.labels), **arrays)
    return stream.getvalue()


def load_posterior(
    model: MachineModel,
    geometry: HexapodGeometry,
    path: str | Path,
    opener: Callable[[str, int], int] | None = None,
) -> tuple[FittedParameters | None, str]:
    """Return what a model's fit knows of its parameters, or why that is not known.

    Parameters
    ----------
    model, geometry : MachineModel, HexapodGeometry
        The model and its machine.
    path : str or Path
        The model's file, as :func:`~hexapod_comp.machine.model_file.load_model` takes it.
    opener : callable, optional
        As Python's ``open`` takes it, such as :func:`~hexapod_comp.formats.paths.confined_opener`.

    Returns
    -------
    FittedParameters or None, str
        None: not known, for the reason given.
    """
    if model.origin.posterior is None:
        return None, f"model {model.name!r} carries no covariance of a fit"
    name, digest = model.origin.posterior
    try:
        file = input_file(path).with_name(name)
        content = _read(file, opener)
        if hashlib.sha256(content).hexdigest() != digest:
            return None, f"{name} is not the file that was written with model {model.name!r}"
        return _parsed(content, file, geometry), ""
    except HexapodError as error:
        return None, str(error)


def _read(path: Path, opener: Callable[[str, int], int] | None) -> bytes:
    try:
        with open(path, "rb", opener=opener) as stream:
            content = stream.read(MOST_BYTES + 1)
    except OSError as error:
        raise InputFileError(path, "", f"cannot be read: {error.strerror}") from error
    if len(content) > MOST_BYTES:
        raise InputFileError(path, "", f"larger than the allowed {MOST_BYTES // 1_000_000} MB")
    return content


def _parsed(content: bytes, path: Path, geometry: HexapodGeometry) -> FittedParameters:
    """Return the parameters of a file's content.

    Raises
    ------
    InputFileError
        It is no such file, of another version or machine, or its parts do not belong together.
    """
    try:
        if sum(part.file_size for part in zipfile.ZipFile(io.BytesIO(content)).infolist()) > MOST_BYTES:
            raise InputFileError(path, "", f"unpacks to more than {MOST_BYTES // 1_000_000} MB")
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = dict(archive)
        head = json.loads(str(arrays["head"]))
        known = FORMAT, VERSION, geometry.name
        if (head["format"], head["version"], head["machine"]) != known:
            raise InputFileError(path, "head", f"must be {known}", [head["format"], head["version"], head["machine"]])
        region = Region(**{entry.name: arrays[f"region_{entry.name}"] for entry in fields(Region)})
        space = ParameterSpace((geometry, region), _settings(head["settings"]))
        if tuple(arrays["labels"].tolist()) != space.labels:
            problem = "are not those of this geometry's parameters; was the geometry changed?"
            raise InputFileError(path, "labels", problem)
        covariance = np.zeros((space.size, space.size))
        covariance[np.tril_indices(space.size)] = arrays["covariance"]
        covariance += np.tril(covariance, -1).T
        noise = _noise(arrays["noise"], head.get("kinds"))
        fitted = FittedParameters(space, arrays["x"], covariance, arrays["tolerances"], noise, _held(arrays))
    except (KeyError, TypeError, ValueError, zipfile.BadZipFile, ModelError, PoseError) as error:
        raise InputFileError(path, "", f"is no file of a fit's posterior: {error}") from error
    shapes = {"x": (space.size,), "covariance": (space.size,) * 2}
    shapes |= {"tolerances": (len(space.blocks),), "noise": (len(KINDS),)}
    for name, shape in shapes.items():
        array = getattr(fitted, name)
        if array.shape != shape or not np.isfinite(array).all():
            raise InputFileError(path, name, f"must be finite, of shape {shape}", list(array.shape))
    return fitted


def _noise(factors: np.ndarray, kinds: list[str] | None) -> np.ndarray:
    """Return a file's noise factors in the order of :data:`KINDS`; 1 for kinds that it does not know.

    Files that do not name the kinds are older, and have the first ones.
    """
    names = KINDS[: len(factors)] if kinds is None else kinds
    known = dict(zip(names, factors, strict=True))
    unknown = [name for name in known if name not in KINDS]
    if unknown:
        raise ValueError(f"kinds {unknown} are unknown; allowed are {list(KINDS)}")
    return np.array([known.get(name, 1.0) for name in KINDS])


def _held(arrays: dict[str, np.ndarray]) -> HeldDatum | None:
    """Return the datum of a file's arrays; None: it is older than that."""
    if not any(name in arrays for name in HELD):
        return None
    position, rotation, part, given_up = (arrays[name] for name in HELD)
    if part.shape != (6, 6) or given_up.shape != (6,) or not (np.isfinite(part).all() and np.isfinite(given_up).all()):
        raise ValueError("datum_part and datum_given_up must be finite, of shapes (6, 6) and (6,)")
    return HeldDatum(Pose(position, rotation), part, given_up)


def _settings(given: dict[str, Any]) -> FitSettings:
    tolerances = tuple((name, value) for name, value in given.pop("tolerances"))
    return FitSettings(blocks=tuple(given.pop("blocks")), tolerances=tolerances, **given)
