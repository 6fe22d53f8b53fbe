"""What a calibration leaves of the tool's error, and which one more measurement would remove most of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputFileError
from ..formats.texts import aligned, number
from ..machine.model import RealMachine, measured_region
from ..machine.passes import Poses
from ..machine.region import region_json, region_text
from ..measurements.readings import CHANNELS, DEFAULT_UNCERTAINTY
from ..workspace.combined import covariance_factor, monte_carlo, root_sum_of_squares
from .candidates import TILTS, laid_out
from .design import ErrorLeft, information_of_fit
from .posterior import POINTS, ErrorPredictor, FittedParameters

MACHINES_DRAWN = 2000  # for the percentile of the worst pose: 95 % to ± 0.5 %


@dataclass(frozen=True)
class ErrorOverPoses:
    """Remaining error over some poses, the datum aligned."""

    where: str
    poses: int
    rms: np.ndarray  # (2,): displacement, m, and standard deviation of the rotation about the worst axis, rad
    worst: float  # the same displacement at the worst pose, m
    at: np.ndarray  # (3,): the tool there, in `work`, m
    most: float  # stays below this everywhere for nineteen of twenty machines that agree with the readings, m
    standing: float  # RMS displacement with the datum as the machine stands, m


@dataclass(frozen=True)
class Share:
    """The remaining error if a block of parameters were known exactly, or with one more measurement."""

    name: str
    count: int  # its parameters, or readings
    left: np.ndarray  # (regions,): RMS displacement, m, in the order of Remaining.left


@dataclass(frozen=True)
class Remaining:
    """The remaining error of a calibration."""

    machine: RealMachine  # as calibrated
    parameters: int  # number of the fit's parameters
    left: tuple[ErrorOverPoses, ...]  # in the measured box with a level tool, and in the workspace
    blocks: tuple[Share, ...]
    measurements: tuple[Share, ...]  # the one that reduces the error in the workspace most is first


def remaining(
    machine: RealMachine,
    fitted: FittedParameters,
    workspace: Poses,
    name: str = "workspace",
    progress: Callable[[str], object] = lambda text: None,
) -> Remaining:
    """Return the remaining tool error after a calibration: in its box, and over platform poses in ``base``."""
    space, predictor, rng = fitted.space, ErrorPredictor(machine, fitted), np.random.default_rng(7)
    box = measured_region(machine.model)
    in_box = box.poses(rng.uniform(box.box[0], box.box[1], (POINTS, 3)), space.level)
    factor = covariance_factor(fitted.covariance)
    left, squares = [], []
    for where, poses in (("measured box, level tool", in_box), (name, workspace)):
        progress(where)
        part, square = _left(predictor, poses, factor, where)
        left.append(part)
        squares.append(square)

    def shares(tried: list[tuple[str, int, np.ndarray]]) -> list[Share]:
        """Return the remaining error after each of some measurements, (name, count, rows by x), by itself."""
        gains = [ErrorLeft([rows @ factor for *_, rows in tried], square).gains() for square in squares]
        after = np.sqrt(np.maximum([[np.trace(square)] for square in squares] - np.array(gains), 0.0))
        return [Share(what, count, column) for (what, count, _), column in zip(tried, after.T, strict=True)]

    # Knowing a block is measuring its parameters, far better than they are known.
    deviations = np.linalg.norm(factor, axis=1)
    known = np.diag(1e4 / np.where(deviations > 0.0, deviations, 1.0))
    blocks = shares([(block.name, len(block.labels), known[block.part]) for block in space.blocks])
    progress("measurements")
    measurements = shares(list(measurable(fitted)))
    measurements.sort(key=lambda share: share.left[-1])
    return Remaining(machine, space.size, tuple(left), tuple(blocks), tuple(measurements))


def _left(predictor: ErrorPredictor, poses: Poses, factor: np.ndarray, where: str) -> tuple[ErrorOverPoses, np.ndarray]:
    """Return the remaining error over some poses, and M, (p, p): its mean square is tr(M) of independent effects."""
    tips, standing, slopes, given_up = predictor.slopes(poses)
    reached = np.isfinite(slopes).all(axis=(1, 2))
    tips, effects = tips[reached], np.swapaxes(slopes[reached] @ factor, 1, 2)
    sizes = root_sum_of_squares(effects)
    as_it_stands = np.concatenate([standing[reached] @ factor, given_up[reached, :, None]], axis=2)[:, :3]
    drawn = monte_carlo(effects, MACHINES_DRAWN, percentiles=(95.0,), normal=True)
    worst = int(sizes[:, 0].argmax())
    left = ErrorOverPoses(
        where=where,
        poses=len(tips),
        rms=np.sqrt((sizes**2).mean(axis=0)),
        worst=float(sizes[worst, 0]),
        at=tips[worst],
        most=float(drawn.values[0, 0]),
        standing=float(np.sqrt((as_it_stands**2).sum(axis=(1, 2)).mean())),
    )
    return left, np.einsum("npc,nqc->pq", effects[..., :3], effects[..., :3], optimize=True) / len(tips)


def measurable(fitted: FittedParameters) -> Iterator[tuple[str, int, np.ndarray]]:
    """Yield measurements in a fit's box: name, count of readings, and rows by x, (cells, size), over the noise."""
    space = fitted.space
    lines, _ = laid_out(space, lines=3, readings=9)
    rows, cells = information_of_fit(fitted, lines)
    run = np.array([run.name.partition(" ")[0] for run in lines.runs])[lines.run]
    channel = []
    for axis, name in zip(run, (CHANNELS[index] for index in lines.channel), strict=True):
        kind, _, about = name.partition("_")
        turning = "roll" if about == axis else "pitch and yaw"
        channel.append({"linear": "linear laser", "straightness": "straightness"}.get(kind, turning))
    for axis, read in dict.fromkeys(zip(run.tolist(), channel, strict=True)):
        members = (run == axis) & (np.array(channel) == read)
        where = "body diagonals" if axis == "diagonal" else f"lines along {axis}"
        yield f"{read}, {where}", int(members.sum()), rows[np.unique(cells.of_reading[members])]
    poses = 20
    for tilts in ((0.0,), TILTS):
        try:
            readings, tilt = laid_out(space, poses=poses, tilts=tilts)
        except InputFileError:  # out of reach
            continue
        rows, _ = information_of_fit(fitted, readings)
        yield f"tracker, {poses} poses, {f'tilted up to {tilt:g}°' if tilt else 'level'}", len(readings), rows


def remaining_text(result: Remaining) -> str:
    """Return the remaining error of a calibration as text."""
    geometry, model = result.machine.geometry, result.machine.model
    head = (
        f"machine {geometry.name}, model {model.name!r}: what is left of the tool's error after compensation, by the "
        f"covariance of the fit's {result.parameters} parameters.\n{region_text(model.measured, geometry)}\nThe datum "
        "is aligned over that box. Where nothing was measured, only what the fit's parameters describe counts."
    )
    titles = ["where", "poses", "RMS µm", "worst pose µm", "there, tool in work: x, y, z mm"]
    titles += ["95 % of machines below µm", "rotation µrad", "datum as it stands, RMS µm"]
    rows = []
    for part in result.left:
        sizes = [number(v * 1e6, 2) for v in (part.rms[0], part.worst, part.most, part.rms[1], part.standing)]
        place = ", ".join(number(v * 1e3, 1) for v in part.at)
        rows.append((part.where, str(part.poses), *sizes[:2], place, *sizes[2:]))
    noise = ", ".join(f"{name} {value * 1e6:g}" for name, value in DEFAULT_UNCERTAINTY.items())

    def shares(given: Iterable[Share], counted: str) -> str:
        now, table = np.array([part.rms[0] for part in result.left]), []
        for share in given:
            less = 100.0 * (1.0 - share.left / now)
            pairs = ((number(v * 1e6, 2), f"{r:.0f} % less") for v, r in zip(share.left, less, strict=True))
            table.append((share.name, str(share.count), *(cell for pair in pairs for cell in pair)))
        return aligned(("", counted, *(title for part in result.left for title in (part.where, ""))), table)

    return "\n\n".join(
        (
            head,
            aligned(titles, rows),
            "if these parameters were known exactly, RMS µm\n" + shares(result.blocks, "parameters"),
            f"with one more measurement in the measured box (noise, µm and µrad: {noise}), RMS µm\n"
            + shares(result.measurements, "readings"),
        )
    )


def measurement_rows(result: Remaining) -> list[dict[str, Any]]:
    """Return the measurements for CSV: a record each, µm."""
    return [
        {"rank": rank, "measurement": share.name, "readings": share.count}
        | {f"left_{key}_um": float(value) * 1e6 for key, value in zip(("box", "workspace"), share.left, strict=True)}
        for rank, share in enumerate(result.measurements, start=1)
    ]


def remaining_json(result: Remaining) -> dict[str, Any]:
    """Return the remaining error of a calibration as plain numbers; units are in the keys."""

    def shares(given: Iterable[Share], counted: str) -> list[dict[str, Any]]:
        return [
            {"name": s.name, counted: s.count, "left_box_m": s.left[0], "left_workspace_m": s.left[1]} for s in given
        ]

    return {
        "machine": result.machine.geometry.name,
        "model": result.machine.model.name,
        "parameters": result.parameters,
        "frame": "work",
        "measured_box": region_json(result.machine.model.measured, result.machine.geometry),
        "left": [
            {
                "where": part.where,
                "poses": part.poses,
                "rms_m": part.rms[0],
                "rms_rotation_rad": part.rms[1],
                "worst_m": part.worst,
                "worst_at_m": part.at,
                "machines_95_m": part.most,
                "rms_datum_as_it_stands_m": part.standing,
            }
            for part in result.left
        ],
        "if_known": shares(result.blocks, "parameters"),
        "if_measured": shares(result.measurements, "readings"),
    }
