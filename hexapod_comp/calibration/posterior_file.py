"""The posterior file, beside the model file: parameters, covariance, tolerances, noise and settings of a fit.

With this file, a model can be checked, and updated by new readings, without the readings of the fit. The model file has
the hash of its posterior file, so that the posterior file of another fit is refused.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from ..errors import HexapodError, InputFileError, ModelError, PoseError
from ..formats.files import MAX_ARCHIVE_BYTES, MEGABYTE, Opener, parsing, read_bytes
from ..formats.json import has_type, json_content
from ..formats.outputs import new_file, write_text
from ..formats.paths import input_file
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel
from ..machine.model_file import model_text, save_model, text_sha256
from ..measurements.readings import KINDS
from ..pose import Pose
from .datum import HeldDatum
from .parameters import Extent, FitSettings, ParameterSpace
from .posterior import FittedParameters

FORMAT, VERSION, SUFFIX = "hexapod_comp/posterior", 1, ".posterior.npz"

HELD = {"datum_position": (3,), "datum_rotation": (3, 3), "datum_part": (6, 6), "datum_given_up": (6,)}
"""Arrays of a held datum, with their shapes."""

REGION_SHAPES = {"commands": (2,), "box": (2, 3), "work_box": (2, 3), "level": (3, 3), "probe": (3,)}

LARGEST, MOST_LISTED = 1e6, 100
"""Limits of the file: largest magnitude of a number, SI; largest number of entries in a list of the settings."""

NO_POSTERIOR = "is not a posterior file of a fit"


def save_with_posterior(model: MachineModel, fitted: FittedParameters | None, path: str | Path) -> list[Path]:
    """Write a model file and, beside it, its posterior file; return the latter's path, or [] if `path` is a pipe."""
    file = Path(path)
    if fitted is None or (file.exists() and not file.is_file()):
        save_model(model, path)
        return []
    beside, unknown = file.with_name(file.stem + SUFFIX), hashlib.sha256(FORMAT.encode()).hexdigest()
    text = model_text(replace(model, origin=replace(model.origin, posterior=(beside.name, unknown))))
    content = _content(fitted, text_sha256(text))  # hash of the model's text without name and hash of this file
    with new_file(beside, "wb") as stream:  # written first, so that no model file names a missing file
        stream.write(content)
    write_text(path, text.replace(unknown, hashlib.sha256(content).hexdigest()))
    return [beside]


def _content(fitted: FittedParameters, model_sha256: str) -> bytes:
    space, stream = fitted.space, io.BytesIO()
    head = {"format": FORMAT, "version": VERSION, "machine": space.geometry.name, "settings": asdict(space.settings)}
    head |= {"kinds": KINDS, "model_sha256": model_sha256}
    arrays = {name: getattr(fitted, name) for name in ("x", "tolerances", "noise")}
    arrays["covariance"] = fitted.covariance[np.tril_indices(space.size)]  # lower triangle
    arrays |= {f"region_{name}": value for name, value in vars(space.region).items()}
    if fitted.held is not None:
        values = fitted.held.pose.position, fitted.held.pose.rotation, fitted.held.part, fitted.held.error_before
        arrays |= dict(zip(HELD, values, strict=True))
    np.savez_compressed(stream, head=np.array(json.dumps(head)), labels=np.array(space.labels), **arrays)
    return stream.getvalue()


def load_posterior(
    model: MachineModel,
    geometry: HexapodGeometry,
    path: str | Path,
    opener: Opener | None = None,
) -> tuple[FittedParameters | None, str]:
    """Return the posterior of a model's fit, or the reason why it is not known.

    Parameters
    ----------
    model, geometry : MachineModel, HexapodGeometry
        The model and its machine.
    path : str or Path
        The model's file or name, as for :func:`~hexapod_comp.machine.model_file.load_model`.
    opener : callable, optional
        The argument `opener` of Python's ``open``, such as :func:`~hexapod_comp.formats.paths.confined_opener`.

    Returns
    -------
    FittedParameters or None, str
        The posterior and an empty text; or None and the reason why the posterior is not known.
    """
    if model.origin.posterior is None:
        return None, f"model {model.name!r} names no posterior file of a fit"
    name, digest = model.origin.posterior
    try:
        file = input_file(path).with_name(name)
        content = read_bytes(file, MAX_ARCHIVE_BYTES, opener)
        if hashlib.sha256(content).hexdigest() != digest:
            return None, f"{name} is not the file that was written with model {model.name!r}"
        head, arrays = _unpacked(content, file)
        if head.get("model_sha256") != model.origin.text_sha256:
            return None, (
                f"{name} was written with another text of model {model.name!r}: the model file was altered after its "
                "fit, or comes from an earlier version; fit again"
            )
        return _parsed(head, arrays, file, geometry), ""
    except HexapodError as error:
        return None, str(error)


def _unpacked(content: bytes, path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return head and arrays of a posterior file; reject numbers that are not finite or exceed LARGEST."""
    with parsing(path, NO_POSTERIOR):
        size = sum(part.file_size for part in zipfile.ZipFile(io.BytesIO(content)).infolist())
    if size > MAX_ARCHIVE_BYTES:
        raise InputFileError(path, "", f"unpacks to more than {MAX_ARCHIVE_BYTES // MEGABYTE} MB")
    with parsing(path, NO_POSTERIOR), np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {name: np.asarray(archive[name]) for name in archive.files}
        head = json_content(str(arrays.pop("head")))
    if not isinstance(head, dict):
        raise InputFileError(path, "head", "must be an object", head)
    for name, array in arrays.items():
        if name != "labels" and not (array.dtype.kind == "f" and (np.abs(array) <= LARGEST).all()):
            raise InputFileError(path, name, f"must be finite numbers, up to ±{LARGEST:g}")
    return head, arrays


def _parsed(
    head: dict[str, Any], arrays: dict[str, np.ndarray], path: Path, geometry: HexapodGeometry
) -> FittedParameters:
    """Return the posterior; reject a file of another version or another machine, or with inconsistent arrays."""
    known = FORMAT, VERSION, geometry.name
    given = tuple(head.get(key) for key in ("format", "version", "machine"))
    if given != known:
        raise InputFileError(path, "head", f"must be {known}", given)

    def array(name: str, *shape: int) -> np.ndarray:
        if name not in arrays or arrays[name].shape != shape:
            given = list(arrays[name].shape) if name in arrays else "none"
            raise InputFileError(path, name, f"must be an array of shape {shape}", given)
        return arrays[name]

    region = Extent(**{name: array(f"region_{name}", *shape) for name, shape in REGION_SHAPES.items()})
    try:
        space = ParameterSpace((geometry, region), _settings(path, head.get("settings")))
    except (ModelError, PoseError) as error:
        raise InputFileError(path, "head.settings", str(error)) from error
    labels = arrays.get("labels", np.zeros(0))
    if tuple(labels.ravel().tolist()) != space.labels:
        problem = "are not the parameters of this geometry; was the geometry changed after the fit?"
        raise InputFileError(path, "labels", problem)
    n = space.size
    covariance = np.zeros((n, n))
    covariance[np.tril_indices(n)] = array("covariance", n * (n + 1) // 2)
    covariance += np.tril(covariance, -1).T
    variances = np.diag(covariance)
    largest = (1.0 + 1e-6) * np.sqrt(np.maximum(np.outer(variances, variances), 0.0))  # 1e-6: rounding
    if (variances < 0.0).any() or (np.abs(covariance) > largest).any():
        problem = "must be a covariance: no variance is negative, and no correlation exceeds 1"
        raise InputFileError(path, "covariance", problem)
    if head.get("kinds") != list(KINDS):
        problem = f"must be {list(KINDS)}: the kinds of channel, in the order of the noise factors"
        raise InputFileError(path, "head.kinds", problem, head.get("kinds"))
    tolerances, noise = array("tolerances", len(space.blocks)), array("noise", len(KINDS))
    for name, values in (("tolerances", tolerances), ("noise", noise)):
        if not (values > 0.0).all():
            raise InputFileError(path, name, "must be above zero", float(values.min()))
    held = None
    if any(name in arrays for name in HELD):
        position, rotation, part, error_before = (array(name, *shape) for name, shape in HELD.items())
        with parsing(path, "datum", PoseError):
            held = HeldDatum(Pose(position, rotation), part, error_before)
    return FittedParameters(space, array("x", n), covariance, tolerances, noise, held)


def _settings(path: Path, given: Any) -> FitSettings:
    """Return the fit settings; reject unknown settings, and values of a wrong type."""
    if not isinstance(given, dict):
        raise InputFileError(path, "head.settings", "must be an object", given)
    types, words = get_type_hints(FitSettings), {one.name: str(one.type) for one in fields(FitSettings)}
    for name, value in given.items():
        if name not in types:
            raise InputFileError(path, f"head.settings.{name}", "is not known to this release", value)
        if not has_type(value, types[name], LARGEST, MOST_LISTED):
            raise InputFileError(path, f"head.settings.{name}", f"must be of the type {words[name]}", value)
    lists = {name: tuple(tuple(v) if isinstance(v, list) else v for v in value)
             for name, value in given.items() if isinstance(value, list)}  # fmt: skip
    return FitSettings(**{**given, **lists})
