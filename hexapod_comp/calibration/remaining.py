"""What a calibration leaves of the tool's error, which parameters make it up, and which measurement would remove most.

Of a fit only the covariance of its parameters is needed: a measurement adds information, whatever it will read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputFileError
from ..formats.texts import aligned, number
from ..machine.model import RealMachine, commanded_box, measured_region
from ..machine.passes import Poses
from ..machine.region import region_json, region_text
from ..measurements.campaign import Campaign, template
from ..measurements.readings import CHANNELS, DEFAULT_UNCERTAINTY, MeasurementSet
from ..workspace.combined import NORMAL, covariance_factor, monte_carlo, root_sum_of_squares
from .estimator import Estimation
from .posterior import ErrorPredictor, FittedParameters

POINTS, SEED = 300, 7
"""Random poses of the measured box."""

DRAWS = 2000
"""Machines drawn from the covariance."""

LINES, READINGS = 3, 9
"""A measurement that is tried has so many lines across each direction, and so many readings on the shortest line."""

SCATTERED = 20
"""Poses that a tracker would read."""

TILTS = (10.0, 5.0, 2.0)
"""Largest tilts of such poses, degrees: the first that is within reach in the whole box."""

SAME = 1e-10
"""Directions of the parameters that are smaller, beside the largest, are rounding."""


@dataclass(frozen=True)
class Left:
    """What is left over some poses, the datum aligned.

    Attributes
    ----------
    where : str
        Which poses.
    poses : int
        How many.
    rms : ndarray, shape (2,)
        To expect over all of them: displacement of the tool, m, and the standard deviation of its rotation about the
        worst axis, rad.
    worst : float
        The same displacement at the worst pose, m.
    at : ndarray, shape (3,)
        Where that is: the tool in ``work``, m.
    most : float
        Nineteen of twenty machines that the readings allow stay below this everywhere, m.
    standing : float
        RMS displacement with the datum as the machine stands, m.
    """

    where: str
    poses: int
    rms: np.ndarray
    worst: float
    at: np.ndarray
    most: float
    standing: float


@dataclass(frozen=True)
class Share:
    """What would be left, RMS displacement, shape (regions,), m, if something were known or measured in addition.

    Attributes
    ----------
    name : str
        A block of parameters, or a measurement.
    count : int
        Its parameters, or its readings.
    left : ndarray, shape (regions,)
        m, in the order of :attr:`Remaining.left`.
    """

    name: str
    count: int
    left: np.ndarray


@dataclass(frozen=True)
class Remaining:
    """What a calibration leaves.

    Attributes
    ----------
    machine : RealMachine
        As calibrated.
    parameters : int
        How many the fit has.
    left : tuple of Left
        In the measured box with a level tool, and in the workspace.
    blocks : tuple of Share
        What would be left if the parameters of one block were known exactly.
    measurements : tuple of Share
        What one more measurement would leave; the one that removes most from the workspace first.
    """

    machine: RealMachine
    parameters: int
    left: tuple[Left, ...]
    blocks: tuple[Share, ...]
    measurements: tuple[Share, ...]


def remaining(
    machine: RealMachine,
    fitted: FittedParameters,
    workspace: Poses,
    name: str = "workspace",
    progress: Callable[[str], object] = lambda text: None,
) -> Remaining:
    """Return what is left of the tool's error after a calibration.

    Parameters
    ----------
    machine, fitted : RealMachine, FittedParameters
        The machine as calibrated, and what its fit knows.
    workspace : Poses
        ``pose_platform_in_base`` over which it is asked, shapes (N, 3), m, and (N, 3, 3).
    name : str
        What these are called.
    progress : callable
        Called with what goes on.
    """
    space, predictor = fitted.space, ErrorPredictor(machine, fitted)
    rng = np.random.default_rng(SEED)
    region = measured_region(machine.model)
    in_box = region.poses(rng.uniform(region.box[0], region.box[1], (POINTS, 3)), space.level)
    factor = covariance_factor(fitted.covariance)
    left, effects = [], []
    for where, poses in (("measured box, level tool", in_box), (name, workspace)):
        progress(where)
        part, vectors = _left(predictor, poses, factor, where)
        left.append(part)
        effects.append(vectors)
    squares = np.array([np.einsum("npc,nqc->pq", v[..., :3], v[..., :3]) / len(v) for v in effects])
    blocks = tuple(_known(block.name, factor[block.part], squares) for block in space.blocks)
    progress("measurements")
    measurements = [_measured(*tried, factor, squares) for tried in _tried(machine, fitted)]
    measurements.sort(key=lambda share: share.left[-1])
    return Remaining(machine, space.size, tuple(left), blocks, tuple(measurements))


def _left(predictor: ErrorPredictor, poses: Poses, factor: np.ndarray, where: str) -> tuple[Left, np.ndarray]:
    """Return what is left over some poses, and the independent effects that make it up, shape (N, size, 6)."""
    tips, standing, slopes, given_up = predictor.slopes(poses)
    reached = np.isfinite(slopes).all(axis=(1, 2))
    tips, effects = tips[reached], np.swapaxes(slopes[reached] @ factor, 1, 2)
    sizes = root_sum_of_squares(effects)
    as_it_stands = np.concatenate([standing[reached] @ factor, given_up[reached, :, None]], axis=2)[:, :3]
    drawn = monte_carlo(effects, DRAWS, percentiles=(95.0,), distribution=NORMAL)
    worst = int(sizes[:, 0].argmax())
    return (
        Left(
            where=where,
            poses=len(tips),
            rms=np.sqrt((sizes**2).mean(axis=0)),
            worst=float(sizes[worst, 0]),
            at=tips[worst],
            most=float(drawn.worst_values[0, 0]),
            standing=float(np.sqrt((as_it_stands**2).sum(axis=(1, 2)).mean())),
        ),
        effects,
    )


def _known(name: str, rows: np.ndarray, squares: np.ndarray) -> Share:
    """Return what is left when parameters, rows (n, size) of the factor, are known: their directions are gone."""
    _, sizes, directions = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True), full_matrices=False)
    gone = directions[sizes > SAME * sizes[0]]
    taken = np.einsum("ip,rpq,iq->r", gone, squares, gone)
    return Share(name, len(rows), np.sqrt(np.maximum(np.trace(squares, axis1=1, axis2=2) - taken, 0.0)))


def _measured(name: str, count: int, normal: np.ndarray, factor: np.ndarray, squares: np.ndarray) -> Share:
    """Return what is left with readings whose derivatives have a normal matrix (size, size), each of one sigma."""
    information = np.eye(factor.shape[1]) + factor.T @ normal @ factor
    return Share(name, count, np.sqrt([np.trace(np.linalg.solve(information, part)) for part in squares]))


def _tried(machine: RealMachine, fitted: FittedParameters) -> Iterator[tuple[str, int, np.ndarray]]:
    """Yield name, count of readings and normal matrix of the measurements that are tried, in the measured box."""
    box = commanded_box(machine.geometry, machine.model)
    side = float(np.ptp(box, axis=0).min())
    grid = Campaign(box, side / (LINES - 1), side / (READINGS - 1), "6-D", 4)
    yield from _parts(template(grid, machine.geometry), fitted)
    for tilt in (0.0, *TILTS):
        poses = replace(grid, instrument=None, diagonals=0, poses=SCATTERED, tilt=float(np.radians(tilt)))
        try:
            readings = template(poses, machine.geometry)
        except InputFileError:  # out of reach
            continue
        shown = f"tilted up to {tilt:g}°" if tilt else "level"
        rows, _ = _rows(readings, fitted)
        yield f"tracker, {SCATTERED} poses, {shown}", len(readings), rows.T @ rows
        if tilt:
            return


def _parts(readings: MeasurementSet, fitted: FittedParameters) -> Iterator[tuple[str, int, np.ndarray]]:
    """Yield what each instrument would see along each direction of a grid, and on the diagonals."""
    rows, cells = _rows(readings, fitted)
    run = np.array([run.name.partition(" ")[0] for run in readings.runs])[readings.run]
    names = [CHANNELS[index] for index in readings.channel]
    channel = np.array([_instrument(*pair) for pair in zip(run, names, strict=True)])
    for name in dict.fromkeys(zip(run.tolist(), channel.tolist(), strict=True)):
        members = (run == name[0]) & (channel == name[1])
        chosen = rows[np.unique(cells[members])]
        where = "body diagonals" if name[0] == "diagonal" else f"lines along {name[0]}"
        yield f"{name[1]}, {where}", int(members.sum()), chosen.T @ chosen


def _instrument(axis: str, channel: str) -> str:
    """Return the name of what reads a channel on a line along an axis."""
    kind, _, about = channel.partition("_")
    return {"linear": "linear laser", "straightness": "straightness"}.get(
        kind, "roll" if about == axis else "pitch and yaw"
    )


def _rows(readings: MeasurementSet, fitted: FittedParameters) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives by the parameters, (cells, size), over the noise, free of zeros; and each reading's cell."""
    estimation = Estimation(readings, fitted.space, alone=False)
    problem, _ = estimation.linearise(fitted.x, np.ones(len(readings)))
    return fitted.space.unwhitened(problem.rows.dense()), estimation.cells.of_reading


# What is printed.


def remaining_text(result: Remaining) -> str:
    """Return what is left, for people."""
    geometry, model = result.machine.geometry, result.machine.model
    head = (
        f"machine {geometry.name}, model {model.name!r}: what is left of the tool's error after compensation, by the "
        f"covariance of the fit's {result.parameters} parameters.\n{region_text(model.measured, geometry)}\nThe datum "
        "is aligned over that box. Where nothing was measured, only what the fit's parameters describe counts."
    )
    titles = ["where", "poses", "RMS µm", "worst pose µm", "there, tool in work: x, y, z mm"]
    titles += ["95 % of machines below µm", "rotation µrad", "datum as it stands, RMS µm"]
    rows = [_left_row(part) for part in result.left]
    noise = ", ".join(f"{name} {value * 1e6:g}" for name, value in DEFAULT_UNCERTAINTY.items())
    return "\n\n".join(
        (
            head,
            aligned(titles, rows),
            "if these parameters were known exactly, RMS µm\n" + _shares(result, result.blocks, "parameters"),
            f"with one more measurement in the measured box (noise, µm and µrad: {noise}), RMS µm\n"
            + _shares(result, result.measurements, "readings"),
        )
    )


def _left_row(left: Left) -> tuple[str, ...]:
    place = ", ".join(number(v * 1e3, 1) for v in left.at)
    sizes = (number(v * 1e6, 2) for v in (left.rms[0], left.worst))
    rest = (number(v * 1e6, 2) for v in (left.most, left.rms[1], left.standing))
    return (left.where, str(left.poses), *sizes, place, *rest)


def _shares(result: Remaining, shares: tuple[Share, ...], counted: str) -> str:
    """Return a table of what would be left."""
    now = np.array([part.rms[0] for part in result.left])
    rows = []
    for share in shares:
        removed = 100.0 * (1.0 - share.left / now)
        cells = [
            cell for v, r in zip(share.left, removed, strict=True) for cell in (number(v * 1e6, 2), f"{r:.0f} % less")
        ]
        rows.append((share.name, str(share.count), *cells))
    return aligned(("", counted, *(title for part in result.left for title in (part.where, ""))), rows)


def measurement_rows(result: Remaining) -> list[dict[str, Any]]:
    """Return the measurements for CSV: a record each, µm."""
    keys = ("box", "workspace")
    return [
        {"rank": rank, "measurement": share.name, "readings": share.count}
        | {f"left_{key}_um": float(value) * 1e6 for key, value in zip(keys, share.left, strict=True)}
        for rank, share in enumerate(result.measurements, start=1)
    ]


def remaining_json(result: Remaining) -> dict[str, Any]:
    """Return what is left as plain numbers; units are in the keys."""

    def shares(given: tuple[Share, ...], counted: str) -> list[dict[str, Any]]:
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
