"""The demonstration's steps: hidden errors, a laser campaign, a fit, and its prediction for the poses to come."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..calibration.estimator import physical_covariance
from ..calibration.evaluation import PaperMetric, paper_metric
from ..calibration.fit import ModelFit, fit_model
from ..calibration.lines import fit_lines
from ..calibration.parameters import FitSettings
from ..calibration.posterior import left_errors, stations_of
from ..calibration.report import tool_error_text
from ..calibration.sensitivity import predict
from ..compensation.compensator import Compensator
from ..formats.texts import number
from ..machine.arrays import rms
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, RealMachine
from ..machine.passes import Passes
from ..machine.trajectory import Path, circle, commanded_in_base, join, move, pocket
from ..machine.trial import without_datum
from ..measurements.campaign import Campaign, template
from ..measurements.readings import ANGULAR_KINDS
from ..pose import Pose
from ..virtual.instruments import measure
from ..virtual.machine import StrutDrive
from ..workspace.reach import machine_box
from .report import ALIGNED, ErrorRow, PathRecord, PoseRecord, SessionResult, Track, error_rows
from .session import MOVE_FEED

LONGEST_SIDE = 0.2  # longest side of the measured box, m: what the demonstration crosses in two seconds
PROPORTIONS = np.array([1.0, 1.0, 0.5])  # sides of that box to each other, along x, y and z of the work frame

# Distances of the grid's lines, and of the readings along them, as shares of the longest side
LINES_APART, READINGS_APART = 0.25, 0.0625

FEWEST_STEPS = 8  # spacing of the readings, so that the shortest side has as many steps: polynomials along it need nine
POSES = 12  # held-out poses of the measured box

# Largest side of the milled figure, m, and the time for a side at full speed, s: as slow as the drives need
PATH_SIDE, PATH_TIME = 0.018, 0.9

ON_PATH = 150  # places of a path at which a prediction is computed

# Ratio of the drives' error over DDS, where no command is on time to the millisecond, to that without
DRIVES = 2.0

EXACT = ((0.0, 0.0), (0.0, 0.0))  # prediction for the true model: no error but the drives'

REMARK = """as it is: includes the shift and turn of the whole machine, which laser lines do not show and a workpiece
zero set with the model on removes. Datum aligned: without that rigid motion."""

REST = 0.3  # time for the machine to come to rest, s: sixty of the drives' lags


@dataclass(frozen=True)
class Calibration:
    """A machine measured and fitted."""

    fit: ModelFit  # scheme joint on 5-D lines and diagonals
    lines: PaperMetric  # Mou & King's own metric of their 1-D scheme
    joint: PaperMetric  # and of `fit`


@dataclass(frozen=True)
class Place:
    """Where the demonstration happens."""

    box: np.ndarray  # (2, 3): lowest and highest measured tool position, m in ``work``
    attitude: np.ndarray  # (3, 3): of the tool in ``work``: level, or as at home where it cannot be level


def demo_place(geometry: HexapodGeometry) -> Place:
    """Return the measured box: about home, within the machine's largest box, and no larger than necessary."""
    largest = machine_box(geometry)
    low, high = largest.box
    half = np.minimum(0.5 * LONGEST_SIDE * PROPORTIONS, 0.49 * (high - low)).round(4)
    centre = np.clip(geometry.tool_pose(geometry.home).position, low + half, high - half)
    return Place(np.array([centre - half, centre + half]).round(9), largest.rotation)


def demo_campaign(place: Place, instrument: str = "5-D", diagonals: int = 16) -> Campaign:
    """Return the campaign there: lines along the box's sides, and its diagonals, read with the default noise."""
    sides = np.ptp(place.box, axis=0)
    longest, shortest = float(sides.max()), float(sides.min())
    apart, step = min(LINES_APART * longest, shortest), min(READINGS_APART * longest, shortest / FEWEST_STEPS)
    return Campaign(place.box, apart, step, instrument, diagonals, level=place.attitude)


def calibrate(
    geometry: HexapodGeometry,
    truth: MachineModel,
    place: Place,
    seed: int,
    say: Callable[[str], object] = lambda text: None,
) -> Calibration:
    """Measure a machine with virtual lasers, noise included, and fit it by both schemes."""
    real, campaign = RealMachine(geometry, truth), demo_campaign(place)
    say("measuring with 5-D lasers")
    measured = measure(template(campaign, geometry, seed), campaign, real, seed)
    measured = replace(measured, uncertainty=np.array(campaign.noise)[measured.kind])
    # the data sheet gives the screws' lead: it is used where they err and the geometry does not have it
    struts = truth.struts
    waves = (struts.cosine.any() or struts.sine.any()) and not geometry.screw_lead.any()
    fit = fit_model(measured, FitSettings(lead=float(struts.period[0]) if waves else None), say)
    say("the 1-D scheme of Mou & King")
    # Their lines run along the base's axes, and the platform is as level as above, whatever the work frame is.
    level = geometry.work.rotation @ place.attitude @ geometry.tool.rotation.T
    straight = replace(geometry, work=Pose.identity(), tool=Pose(geometry.tool.position, level.T))
    real, place = RealMachine(straight, truth), demo_place(straight)
    campaign = demo_campaign(place, "1-D", 0)
    lines = fit_lines(measure(template(campaign, straight, seed), campaign, real, seed)).model
    metric = partial(paper_metric, real, box=place.box, step=campaign.step, seed=seed)
    return Calibration(fit, metric(lines), metric(fit.model))


def calibration_text(calibration: Calibration) -> str:
    """Return measurement, fit and prediction as lines of text."""
    fit, lines, joint = calibration.fit, calibration.lines, calibration.joint
    sides = " × ".join(number(side * 1e3, 1) for side in np.ptp(fit.space.work_box, axis=0))
    noise = [f"{c.stated * 1e6:g} {'µrad' if c.kind in ANGULAR_KINDS else 'µm'} {c.kind}" for c in fit.channels]
    count = f"{len(fit.measurements)} readings of {len(fit.measurements.runs)} lines"
    parts = [
        f"measured: {count} by 5-D lasers, box of {sides} mm",
        f"noise:    {', '.join(noise)}",
        f"fitted:   {', '.join(block.name for block in fit.space.blocks)}",
    ]
    if fit.level is not None:
        parts.append(f"promised: {tool_error_text(fit.level)}; datum aligned, in the whole box")
    parts.append(
        f"Mou & King's measure, mean |error| along {lines.lines} lines: {lines.before * 1e6:.2f} µm; "
        f"their 1-D scheme leaves {lines.after * 1e6:.3f}, this fit {joint.after * 1e6:.3f}"
    )
    return "\n".join([*parts, *(f"note: {note}" for note in (*fit.notes, *filter(None, [fit.misfit])))])


def as_json(calibration: Calibration) -> dict[str, object]:
    """Return the same for programs; SI units are in the keys."""
    fit, lines, joint = calibration.fit, calibration.lines, calibration.joint
    level = fit.level and {f"{name}_m": getattr(fit.level, name) for name in ("before", "after", "low", "high")}
    return {
        "readings": len(fit.measurements),
        "frame": "work",
        "box_m": fit.space.work_box,
        "blocks": [block.name for block in fit.space.blocks],
        "expected_tool_error": level,
        "mean_displacement_error_along_lines": {
            "without_m": lines.before,
            "scheme_lines_1d_m": lines.after,
            "scheme_joint_m": joint.after,
        },
        "notes": fit.notes,
        "misfit": fit.misfit,
    }


def demo_poses(place: Place, seed: int) -> list[Pose]:
    """Return random poses of the tool in the measured box, in ``work``, each the next nearest."""
    box = place.box
    left = list(np.random.default_rng(seed).uniform(box[0], box[1], (POSES, 3)).round(6))
    ordered = [box.mean(axis=0)]
    while left:
        distances = [float(np.linalg.norm(point - ordered[-1])) for point in left]
        ordered.append(left.pop(int(np.argmin(distances))))
    return [Pose(point, place.attitude) for point in ordered[1:]]


def demo_path(geometry: HexapodGeometry, place: Place, rate: float) -> Path:
    """Return a milled circle, then a zigzag pocket, in the middle of the measured box, across the tool, in ``base``."""
    box, in_base = place.box, commanded_in_base(geometry)
    side = min(PATH_SIDE, 0.25 * float(np.ptp(box, axis=0)[:2].min()))
    feed, centre = side / PATH_TIME, geometry.work @ Pose(box.mean(axis=0), place.attitude)
    ring = circle(centre, radius=0.5 * side, feed=feed, rate=rate)
    corner = centre @ Pose(np.array([-0.5 * side, -side / 6.0, 0.0]), np.eye(3))
    rows = pocket(in_base, corner, (side, side / 3.0), pitch=side / 6.0, feed=feed, rate=rate)
    return join([ring, move(in_base, ring.pose(len(ring) - 1), corner, rate, feed), rows])


def promises(fit: ModelFit, poses: Sequence[Pose], path: Path) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the predicted interval of the tool's RMS error at rest and along a path, m, with 95 %, the datum
    aligned."""
    # As the fit's own expected tool error, at these very poses and with their own datum instead of the whole box's.
    # Along the path only what is across it counts.
    geometry, space = fit.space.geometry, fit.space
    in_base = [geometry.work @ pose for pose in poses]
    at = np.linspace(1, len(path) - 1, ON_PATH).astype(int)
    home = (geometry.home @ geometry.tool).position
    positions = np.array([pose.position for pose in in_base])
    ways = np.concatenate([np.diff(positions, axis=0, prepend=[home]), path.positions[at] - path.positions[at - 1]])
    tool = (
        np.concatenate([positions, path.positions[at]]),
        np.concatenate([[pose.rotation for pose in in_base], path.rotations[at]]),
    )
    stations = stations_of(Passes.of_tool(commanded_in_base(geometry), *tool, ways))
    rest, prediction = slice(0, len(poses)), predict(space, fit.solution.x, stations)
    lengths = np.linalg.norm(ways, axis=1, keepdims=True)
    along = ways / np.where(lengths > 0.0, lengths, 1.0)
    covariance = physical_covariance(space, fit.solution.posterior)
    aligned = without_datum(tool[0], left_errors(space, prediction, stations, covariance)[:, :3], rest)
    across = aligned - along[:, :, None] * np.einsum("ni,nid->nd", along, aligned)[:, None]
    rest_left, path_left = (np.sqrt((e**2).sum(axis=1).mean(axis=0)) for e in (aligned[rest], across[len(poses) :]))
    beyond = fit.verdict.unexplained
    at_rest = beyond.promised(rest_left, tool[0][rest])
    return at_rest[1:], beyond.promised(path_left, tool[0][len(poses) :])[1:]


def left_by_drives(
    geometry: HexapodGeometry, truth: MachineModel, poses: Sequence[Pose], path: Path
) -> tuple[float, float]:
    """Return the RMS tool error that the drives cause with the true model, at rest and along a path, m, datum aligned.

    The same commands to the same drives, here and without DDS: motor steps, lag, backlash being taken up.
    """
    in_base = commanded_in_base(geometry)
    core, drive = Compensator(in_base, truth), StrutDrive(RealMachine(in_base, truth))
    seen: list[np.ndarray] = []

    def travel(way: Path) -> None:
        seen.clear()
        for n in range(len(way)):
            drive.set_command(core.correct(way.pose(n)).command)
            drive.advance(1.0 / way.rate)
            seen.append(drive.true_tool_pose().position)

    records, at = [], in_base.home @ in_base.tool
    for target in [geometry.work @ pose for pose in poses]:
        travel(move(in_base, at, target, path.rate, MOVE_FEED))
        drive.advance(REST)
        records.append(PoseRecord(target, true_with=drive.true_tool_pose()))
        at = target
    travel(move(in_base, at, path.pose(0), path.rate, MOVE_FEED))
    drive.advance(REST)
    travel(path)
    track = Track.along(path, np.array(seen), np.arange(1, len(path) + 1))
    result = SessionResult(records, PathRecord(path, None, track, np.zeros((0, 6))))
    at_rest, on_path = (rms(row.compensated) for row in error_rows(result) if row.datum == ALIGNED)
    return at_rest, on_path


def with_promises(
    rows: Sequence[ErrorRow], promised: Sequence[tuple[float, float]], drives: Sequence[float]
) -> list[ErrorRow]:
    """Return rows whose aligned ones have the predicted interval for rest and path, the drives' share added."""
    whole = {
        what: (low, float(np.hypot(high, DRIVES * own)))
        for what, (low, high), own in zip(("at rest", "path"), promised, drives, strict=True)
    }
    return [replace(row, promised=whole[row.what]) if row.datum == ALIGNED else row for row in rows]
