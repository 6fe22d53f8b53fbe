"""Loading a model while the machine moves: a process of its own finds, reads and checks the file.

Parsing YAML keeps Python's lock for tens of milliseconds, a large model's for hundreds, in which no command would
be answered; and a file on a dead network mount is waited for without end. So the node only gives the file's name. The
process hands back the text and checked numbers as two lines of JSON, which are read within a millisecond; when it has
not done so in time, it is given up. It is ``python -m hexapod_comp.ros.model_loading NAME MACHINE PLACE [FOLDER]``.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..compensation.journal import IDEAL_SOURCE, LARGEST_SOURCE, Source
from ..errors import HexapodError
from ..formats.json import json_text
from ..formats.paths import confined_file, confined_opener
from ..machine.field import GridField
from ..machine.model import Datum, MachineModel, ModelOrigin
from ..machine.region import Region
from ..machine.struts import StrutErrors
from ..machine.temperatures import LateGrowth

LOADED_WITHIN = 30.0
"""A file that takes longer to read is given up, s; the shipped ones take one second, nearly all of it imports."""

ENDED_WITHIN = 0.5
"""How long an end of the process is waited for, s: who waits for a dead mount cannot even be killed."""

PACKAGE_ROOT = Path(__file__).resolve().parents[2]
"""Where the process runs: Python also imports from the folder it runs in, which must not be just any."""


class LoadingError(HexapodError):
    """The model could not be loaded; the message is the loader's."""

    reason = "bad_file"


def model_json(model: MachineModel) -> str:
    """Return a model as JSON; its numbers come back bit for bit."""
    return json_text(model, indent=None)


def model_of(text: str) -> MachineModel:
    """Return the model of a :func:`model_json`.

    Raises
    ------
    ModelError
        Its numbers cannot describe a machine.
    """
    data = json.loads(text)
    field, origin = data["field"], data["origin"]
    origin["sources"] = tuple(tuple(source) for source in origin["sources"])
    origin["posterior"] = None if origin["posterior"] is None else tuple(origin["posterior"])
    origin["datum"] = None if origin["datum"] is None else Datum(**origin["datum"])
    data["late_growth"] = LateGrowth(**data["late_growth"])
    data["struts"] = StrutErrors(**data["struts"])
    data["field"] = GridField(**{**field, "grid": tuple(field["grid"]), "lines": tuple(field["lines"])})
    data["origin"] = ModelOrigin(**origin)
    data["region"] = None if data["region"] is None else Region(**data["region"])
    return MachineModel(**data)


class ModelName(NamedTuple):
    """Where a model is to be looked for: nothing of it is looked at here.

    Attributes
    ----------
    name : str
        Path of the file, or the name of a shipped one.
    place : str
        Folder that relative paths start from.
    folder : Path or None
        As for :func:`~hexapod_comp.formats.paths.confined_file`.
    """

    name: str
    place: str
    folder: Path | None


def load_elsewhere(wanted: ModelName, machine: str) -> tuple[MachineModel, Source]:
    """Find and read a machine's model file in a process of its own; wait for it without keeping Python's lock.

    Returns
    -------
    MachineModel
    Source
        What it was made of; without its text where that is too long for the journal.

    Raises
    ------
    LoadingError
        As :func:`~hexapod_comp.formats.paths.confined_file` and
        :func:`~hexapod_comp.machine.model_file.parse_model`, or the process failed, or did not end in time.
    """
    command = [sys.executable, "-m", __name__, wanted.name, machine, wanted.place]
    command += [] if wanted.folder is None else [str(wanted.folder)]
    try:
        process = subprocess.Popen(command, cwd=PACKAGE_ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)
    except (OSError, ValueError) as error:
        raise LoadingError(f"{wanted.name}: could not be loaded: {error}") from error
    output = _output(process, wanted.name)
    if process.returncode == 0:
        source, _, model = output.partition("\n")
        return model_of(model), Source(**json.loads(source))
    raise LoadingError(output or f"{wanted.name}: the loading process ended with {process.returncode}")


def _output(process: subprocess.Popen[bytes], name: str) -> str:
    """Return all that a process says, or give it up."""
    try:
        return process.communicate(timeout=LOADED_WITHIN)[0].decode("utf-8", "replace")
    except subprocess.TimeoutExpired as error:
        process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(ENDED_WITHIN)
        if process.stdout is not None:
            process.stdout.close()
        problem = f"could not be read within {LOADED_WITHIN:g} s; is the disk or the network behind it there?"
        raise LoadingError(f"{name}: {problem}") from error


class Loading:
    """One model on its way, in a thread that waits for the process.

    Parameters
    ----------
    wanted : ModelName or None
        The file; None: the ideal model.
    machine : str
        Name of the machine that it must belong to.
    """

    def __init__(self, wanted: ModelName | None, machine: str) -> None:
        self._loaded: tuple[MachineModel, Source] | None = None
        self._error: HexapodError | None = None
        self._thread = threading.Thread(target=self._run, args=(wanted, machine), name="model loading", daemon=True)
        self._thread.start()

    @property
    def done(self) -> bool:
        """Whether there is a result."""
        return not self._thread.is_alive()

    def result(self) -> tuple[MachineModel, Source]:
        """Return the model and what it was made of.

        Raises
        ------
        HexapodError
            Why there is none.
        """
        if self._loaded is None:
            raise self._error or LoadingError("the model has not been loaded yet")
        return self._loaded

    def _run(self, wanted: ModelName | None, machine: str) -> None:
        try:
            ideal = MachineModel(machine), IDEAL_SOURCE
            self._loaded = ideal if wanted is None else load_elsewhere(wanted, machine)
        except HexapodError as error:
            self._error = error
        except Exception as error:  # a thread's error would be lost, and the service never answer
            name = "" if wanted is None else wanted.name
            self._error = LoadingError(f"{name}: {type(error).__name__}: {error}")


def main(argv: Sequence[str] | None = None) -> int:
    """Read a model file for a machine and print text and numbers; or print why not, and return 1."""
    name, machine, place, *folders = sys.argv[1:] if argv is None else argv
    folder = Path(folders[0]) if folders else None
    try:
        os.chdir(place)
        source = Source.read(confined_file(name, folder, "model"), confined_opener(folder))
        model = source.model(machine)
    except (HexapodError, OSError) as error:
        sys.stdout.buffer.write(str(error).encode("utf-8", "replace"))
        return 1
    text = source.text if len(source.text or "") <= LARGEST_SOURCE else None
    head = json.dumps({"name": source.name, "text": text, "sha256": source.sha256})
    sys.stdout.write(f"{head}\n{model_json(model)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
