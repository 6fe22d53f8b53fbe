"""Loading a model while the machine moves: a process of its own reads and checks the file.

Parsing YAML keeps Python's lock for tens of milliseconds, a large model's for hundreds, in which no command would
be answered. The process is given the file's text and hands back checked numbers as JSON, which is read within a
millisecond. It is ``python -m hexapod_comp.nodes.model_loading NAME MACHINE < TEXT``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from ..compensation.journal import IDEAL_SOURCE, Source
from ..errors import HexapodError
from ..formats.json import json_text
from ..machine.field import GridField
from ..machine.model import MachineModel, ModelOrigin
from ..machine.model_file import parse_model
from ..machine.struts import StrutErrors

LOADED_WITHIN = 30.0
"""A file that takes longer to read is given up, s; the shipped ones take one second, nearly all of it imports."""

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
    data["struts"] = StrutErrors(**data["struts"])
    data["field"] = GridField(**{**field, "grid": tuple(field["grid"]), "lines": tuple(field["lines"])})
    data["origin"] = ModelOrigin(**origin)
    return MachineModel(**data)


def load_elsewhere(source: Source, machine: str) -> MachineModel:
    """Read a model file's text for a machine in a process of its own, and wait for it without keeping Python's lock.

    Raises
    ------
    LoadingError
        As :func:`~hexapod_comp.machine.model_file.parse_model`, or the process failed.
    """
    command = [sys.executable, "-m", __name__, source.name, machine]
    try:
        done = subprocess.run(
            command,
            cwd=PACKAGE_ROOT,
            input=(source.text or "").encode(),
            stdout=subprocess.PIPE,
            timeout=LOADED_WITHIN,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise LoadingError(f"{source.name}: could not be loaded: {error}") from error
    output = done.stdout.decode("utf-8", "replace")
    if done.returncode == 0:
        return model_of(output)
    raise LoadingError(output or f"{source.name}: the loading process ended with {done.returncode}")


class Loading:
    """One model on its way, in a thread that waits for the process.

    Parameters
    ----------
    path : Path or None
        The file; None: the ideal model.
    machine : str
        Name of the machine that it must belong to.
    """

    def __init__(self, path: Path | None, machine: str) -> None:
        self._loaded: tuple[MachineModel, Source] | None = None
        self._error: HexapodError | None = None
        self._thread = threading.Thread(target=self._run, args=(path, machine), name="model loading", daemon=True)
        self._thread.start()

    @property
    def done(self) -> bool:
        """Whether there is a result."""
        return not self._thread.is_alive()

    def result(self) -> tuple[MachineModel, Source]:
        """Return the model and the text that it was read from.

        Raises
        ------
        HexapodError
            Why there is none.
        """
        if self._loaded is None:
            raise self._error or LoadingError("the model has not been loaded yet")
        return self._loaded

    def _run(self, path: Path | None, machine: str) -> None:
        try:
            if path is None:
                self._loaded = MachineModel(machine), IDEAL_SOURCE
            else:
                source = Source.read(path)
                self._loaded = load_elsewhere(source, machine), source
        except HexapodError as error:
            self._error = error
        except Exception as error:  # a thread's error would be lost, and the service never answer
            self._error = LoadingError(f"{path}: {type(error).__name__}: {error}")


def main(argv: Sequence[str] | None = None) -> int:
    """Read a model file's text, called as given, for the machine given and print it; or print why not, return 1."""
    name, machine = sys.argv[1:] if argv is None else argv
    try:
        model = parse_model(sys.stdin.buffer.read().decode(), machine, name)
    except HexapodError as error:
        sys.stdout.buffer.write(str(error).encode())
        return 1
    sys.stdout.write(model_json(model))
    return 0


if __name__ == "__main__":
    sys.exit(main())
