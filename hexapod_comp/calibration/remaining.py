"""The expected tool error after a calibration, and after one further measurement of each possible kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..errors import InputFileError
from ..formats.texts import aligned, number, relative_change
from ..machine.model import RealMachine, measured_region
from ..machine.passes import Poses
from ..machine.region import region_json, region_text
from ..measurements.readings import CHANNELS, DEFAULT_UNCERTAINTY
from ..workspace.combined import covariance_factor, monte_carlo, root_sum_of_squares
from .candidates import TILTS, box_template
from .design import RemainingError, information_of_fit
from .posterior import POINTS, ErrorPredictor, FittedParameters

MACHINES_DRAWN = 2000  # random machines; the share of them below a percentile of 95 % has a standard error of 0.5 %


def remaining(
    machine: RealMachine,
    fitted: FittedParameters,
    workspace: Poses,
    name: str = "workspace",
    progress: Callable[[str], object] = lambda text: None,
) -> dict[str, Any]:
    """Return for JSON the tool error, after best-fit alignment, that is expected after a calibration.

    `left` is the error in the measured box (level tool) and in the workspace; of the machines that agree with the
    readings, 95 % have smaller errors than `machines_95_m` at all poses. `if_known` is the error if one block of
    parameters were known exactly, `if_measured` the error after one further measurement.
    """
    space, predictor, rng = fitted.space, ErrorPredictor(machine, fitted), np.random.default_rng(7)
    box = measured_region(machine.model)
    in_box = box.poses(rng.uniform(box.box[0], box.box[1], (POINTS, 3)), space.level)
    factor = covariance_factor(fitted.covariance)
    left, squares = [], []  # squares: mean square error of each region, (p, p), in the space of `factor`; trace: m²
    for where, poses in (("measured box, level tool", in_box), (name, workspace)):
        progress(where)
        tips, absolute, slopes, held_motion = predictor.slopes(poses)
        reached = np.isfinite(slopes).all(axis=(1, 2))
        tips, effects = tips[reached], np.swapaxes(slopes[reached] @ factor, 1, 2)
        sizes = root_sum_of_squares(effects)
        unaligned = np.concatenate([absolute[reached] @ factor, held_motion[reached, :, None]], axis=2)[:, :3]
        drawn = monte_carlo(effects, MACHINES_DRAWN, percentiles=(95.0,), normal=True)
        worst, rms = int(sizes[:, 0].argmax()), np.sqrt((sizes**2).mean(axis=0))
        left.append(
            {
                "where": where,
                "poses": len(tips),
                "rms_m": float(rms[0]),
                "rms_rotation_rad": float(rms[1]),
                "worst_m": float(sizes[worst, 0]),
                "worst_at_m": tips[worst],  # tip in `work`
                "machines_95_m": float(drawn.values[0, 0]),
                "rms_datum_as_it_stands_m": float(np.sqrt((unaligned**2).sum(axis=(1, 2)).mean())),
            }
        )
        displacement = effects[..., :3]
        squares.append(np.einsum("npc,nqc->pq", displacement, displacement, optimize=True) / len(tips))

    def shares(tried: list[tuple[str, int, np.ndarray]], counted: str) -> list[dict[str, Any]]:
        """Return the tool error left after one measurement of `tried`, for each: name, count, ∂(readings / σ)/∂x."""
        # Of rows only AᵀA counts, so those of many readings become few by a QR decomposition
        seen = [np.asarray(np.linalg.qr(rows @ factor, mode="r")) for *_, rows in tried]
        gains = [RemainingError(seen, square).gains() for square in squares]
        after = np.sqrt(np.maximum([[np.trace(square)] for square in squares] - np.array(gains), 0.0))
        return [
            {"name": what, counted: count, "left_box_m": float(in_box), "left_workspace_m": float(in_workspace)}
            for (what, count, _), in_box, in_workspace in zip(tried, *after, strict=True)
        ]

    # A block counts as known exactly if it is measured to 1/10,000 of its standard deviation
    deviations = np.linalg.norm(factor, axis=1)
    known = np.diag(1e4 / np.where(deviations > 0.0, deviations, 1.0))
    blocks = [(block.name, len(block.labels), known[block.part]) for block in space.blocks]
    progress("measurements")
    return {
        "machine": machine.geometry.name,
        "model": machine.model.name,
        "parameters": space.size,
        "frame": "work",
        "measured_box": region_json(machine.model.measured, machine.geometry),
        "left": left,
        "if_known": shares(blocks, "parameters"),
        "if_measured": sorted(shares(list(measurable(fitted)), "readings"), key=lambda s: s["left_workspace_m"]),
    }


def measurable(fitted: FittedParameters) -> Iterator[tuple[str, int, np.ndarray]]:
    """Yield possible measurements in the measured box: name, number of readings, derivatives of readings / σ by x."""
    space = fitted.space
    lines, _ = box_template(space, lines=3, readings=9)
    rows, means = information_of_fit(fitted, lines)
    run = np.array([run.name.partition(" ")[0] for run in lines.runs])[lines.run]
    channel = []
    for axis, name in zip(run, (CHANNELS[index] for index in lines.channel), strict=True):
        kind, _, about = name.partition("_")
        turning = "roll" if about == axis else "pitch and yaw"
        channel.append({"linear": "linear laser", "straightness": "straightness"}.get(kind, turning))
    for axis, read in dict.fromkeys(zip(run.tolist(), channel, strict=True)):
        members = (run == axis) & (np.array(channel) == read)
        where = "body diagonals" if axis == "diagonal" else f"lines along {axis}"
        yield f"{read}, {where}", int(members.sum()), rows[np.unique(means.of_reading[members])]
    poses = 20
    for tilts in ((0.0,), TILTS):
        try:
            readings, tilt = box_template(space, poses=poses, tilts=tilts)
        except InputFileError:  # the machine does not reach enough poses
            continue
        rows, _ = information_of_fit(fitted, readings)
        yield f"tracker, {poses} poses, {f'tilted up to {tilt:g}°' if tilt else 'level'}", len(readings), rows


def remaining_text(result: dict[str, Any], machine: RealMachine) -> str:
    head = (
        f"machine {result['machine']}, model {result['model']!r}: expected tool error after compensation, "
        f"from the covariance of the fit's {result['parameters']} parameters.\n"
        f"{region_text(machine.model.measured, machine.geometry)}\nErrors are after best-fit alignment over the "
        "measured box. Outside this box only errors that the fit's parameters describe are included."
    )
    titles = ["where", "poses", "RMS µm", "worst pose µm", "worst pose: tool in work, x, y, z mm"]
    titles += ["95 % of machines below µm", "rotation µrad", "absolute, RMS µm"]
    rows = []
    for part in result["left"]:
        names = ("rms_m", "worst_m", "machines_95_m", "rms_rotation_rad", "rms_datum_as_it_stands_m")
        sizes = [number(part[name] * 1e6, 2) for name in names]
        place = ", ".join(number(v * 1e3, 1) for v in part["worst_at_m"])
        rows.append((part["where"], str(part["poses"]), *sizes[:2], place, *sizes[2:]))
    noise = ", ".join(f"{name} {value * 1e6:g}" for name, value in DEFAULT_UNCERTAINTY.items())
    blocks = {"if_known": ("if these parameters were known exactly", "parameters")}
    blocks["if_measured"] = f"after one more measurement in the measured box (σ in µm or µrad: {noise})", "readings"
    parts = [head, aligned(titles, rows)]
    for key, (title, counted) in blocks.items():
        table = []
        for share in result[key]:
            row = [share["name"], str(share[counted])]
            for part, name in zip(result["left"], ("left_box_m", "left_workspace_m"), strict=True):
                row += [number(share[name] * 1e6, 2), relative_change(part["rms_m"], share[name], 0)]
            table.append(row)
        header = ("", counted, *(text for part in result["left"] for text in (part["where"], "")))
        parts.append(f"{title}, RMS µm\n{aligned(header, table)}")
    return "\n\n".join(parts)


def measurement_rows(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a CSV file, one for each possible measurement: rank, and expected errors after it, µm."""
    return [
        {"rank": rank, "measurement": share["name"], "readings": share["readings"]}
        | {f"left_{key}_um": share[f"left_{key}_m"] * 1e6 for key in ("box", "workspace")}
        for rank, share in enumerate(result["if_measured"], start=1)
    ]
