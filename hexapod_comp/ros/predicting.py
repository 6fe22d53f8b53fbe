"""The process that works out the predicted error of the tool; its other end is :mod:`.predicted_error`.

Lines of JSON come in: first what machine and model are made of, then a pose a line. A line of JSON goes out for each
pose. It ends with its input, so that it never outlives the node.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.posterior import ErrorPredictor, FittedParameters, PredictedError
from ..calibration.posterior_file import load_posterior
from ..compensation.journal import Source
from ..errors import HexapodError
from ..formats.json import json_text
from ..formats.paths import confined_opener
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, RealMachine
from ..machine.temperatures import Temperatures

NICENESS = 10
"""Commands come first."""


class Predicting:
    """Predictors of one model, made anew when tool or temperature change.

    Parameters
    ----------
    setup : dict
        ``geometry`` and ``model``: name, text and sha256 of each :class:`Source`; ``folder`` from which files may be
        read, or None.
    """

    def __init__(self, setup: dict[str, Any]) -> None:
        sources = [Source(**setup[name]) for name in ("geometry", "model")]
        self.geometry: HexapodGeometry = sources[0].geometry()
        self.model: MachineModel = sources[1].model(self.geometry.name)
        self.fitted: FittedParameters | None
        opener = confined_opener(None if setup["folder"] is None else Path(setup["folder"]))
        self.fitted, self.unknown = load_posterior(self.model, self.geometry, sources[1].name, opener)
        self._at: tuple[str, dict[str, float], dict[str, list[float]]] | None = None

    def result(self, asked: dict[str, Any]) -> dict[str, Any]:
        """Return the errors at a pose: ``position``, ``rotation``, ``sense``, ``tool``, ``temperatures``, ``lags``."""
        at = asked["tool"], asked["temperatures"], asked["lags"]
        if at != self._at:
            temperatures = Temperatures.restored(*at[1:], len(self.model.late_growth.time_constants))
            machine = RealMachine(self.geometry.using(tool=at[0]), self.model, temperatures)
            self._predictor, self._at = ErrorPredictor(machine, self.fitted), at
        pose = np.array([asked["position"]]), np.array([asked["rotation"]])
        standing, aligned = self._predictor.predict(pose, np.array([asked["sense"]]))
        result = {"standing": _numbers(standing), "aligned": None if aligned is None else _numbers(aligned)}
        return {**result, "unknown": self.unknown}


def _numbers(result: PredictedError) -> dict[str, Any]:
    covariance = None if result.covariance is None else result.covariance[0].ravel()
    return {"values": result.values[0], "covariance": covariance}


def main() -> int:
    """Answer until the input ends."""
    os.nice(NICENESS)
    try:
        predicting = Predicting(json.loads(sys.stdin.readline()))
        for line in sys.stdin:
            sys.stdout.write(json_text(predicting.result(json.loads(line)), indent=None))
            sys.stdout.flush()
    except HexapodError as error:
        sys.stdout.write(json_text({"problem": str(error)}, indent=None))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
