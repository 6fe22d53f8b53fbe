"""Comparison with Song, Mou & King: Tables 1 to 5, round trips of ideal and real structures, figures, misprints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.kinematics import (
    Structure,
    jacobian,
    solve_pose,
    solve_poses,
    strut_lengths,
    strut_lengths_batch,
)
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.pose import Pose, angles_from_rotation, rotation_from_angles
from hexapod_comp.virtual.assessment import Assessment, assess
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model

from . import misprints
from .comparing import (
    MISSED,
    OPEN,
    SHOWN,
    WRONG,
    Exhibit,
    NumberTable,
    Paper,
    Statement,
    angles_deg,
    judged,
    lengths_mm,
    roundings,
    small,
    table,
    values,
    within,
)
from .pictures import changes_figure, configuration_figure

ROWS = tuple(str(n) for n in range(1, 11))
LENGTHS = lengths_mm("L1", "L2", "L3", "L4", "L5", "L6")
POSES = (*angles_deg("α", "β", "γ"), *lengths_mm("X", "Y", "Z"))

IDEAL_MM, REAL_MM = 1e-5, 1e-4
"""Errors of a round trip that the paper states, mm: about 0.01 µm (ideal structure) and about 0.1 µm (real one)."""

BOUND = 10e-6  # Bound of every error of the real structure, m

BOUNDS = ImperfectionBounds(joint=BOUND, strut_offset=BOUND)

RANDOM_POSES, REAL_POSES = 1000, 200
"""Number of random poses in addition to Table 1, and number of these poses that are computed on real structures."""

RANDOM_BOX, RANDOM_TILT = np.array([[-0.2032, -0.2032, 0.35], [0.2032, 0.2032, 0.5532]]), np.radians(10.0)
"""Range of the random poses: the box that Mou & King measured, m, and the largest angle of Table 1, rad."""

DRAWS = 200_000  # Number of machines that are drawn to estimate a probability


@dataclass(frozen=True)
class Simulation:
    """A repetition of the paper's simulation."""

    geometry: HexapodGeometry
    poses: list[Pose]  # the poses of Table 1
    lengths: np.ndarray  # (10, 6): exact strut lengths of the ideal structure, m
    drawn: tuple[Assessment, ...]  # random machines of each pose: as in the paper each pose has new errors


def simulate(geometry: HexapodGeometry, machines: int = 50, seed: int = 1) -> Simulation:
    """Repeat the paper's simulation: at each of ten poses draw `machines` machines within ±10 µm, with new seeds."""
    rows = values(1)
    poses = [Pose.from_angles(row[3:] * 1e-3, np.radians(row[:3])) for row in rows]
    drawn = tuple(assess(geometry, [pose], BOUNDS, seed + n * machines, machines) for n, pose in enumerate(poses))
    return Simulation(geometry, poses, np.array([strut_lengths(geometry, pose) for pose in poses]), drawn)


def paper(geometry: HexapodGeometry, machines: int = 50, seed: int = 1) -> Paper:
    """Return the comparison of the whole paper."""
    run = simulate(geometry, machines, seed)
    exhibits = (drawings(run), table_2(run), table_3(run), table_4(run), table_5(run), random_poses(run, seed), wrong())
    title = "Kinematic Performance Analysis of a Parallel-Chain Hexapod Machine"
    return Paper("Song, Mou & King", title, exhibits)


def drawings(run: Simulation) -> Exhibit:
    """Return the comparison of Figures 1 and 3 (machine), 2 (rotation matrix) and 4 (triangles)."""
    cases = misprints.cases()
    rotation = max(float(np.abs(pose.rotation - at.rotation).max()) for pose, at in zip(run.poses, cases, strict=True))
    heights = max(float(np.abs(np.hypot(at.h, at.p) - at.lengths[::2]).max()) for at in cases)
    a = float(np.linalg.norm(run.geometry.platform_joints[0] - run.geometry.platform_joints[2]))
    b, d = (float(np.linalg.norm(run.geometry.base_joints[i] - run.geometry.base_joints[i + 1])) for i in (2, 1))
    statements = (
        Statement(
            "Figure 3: sides a of the top, b and d of the base",
            "letters",
            f"a = {a * 1e3:.3f}, b = {b * 1e3:.3f}, d = {d * 1e3:.3f} mm",
            SHOWN,
            "The paper does not print these numbers. They follow from Table 2 and reproduce it to the last digit.",
        ),
        Statement(
            "Figure 2: the printed matrix minus Ry(β) Rx(α) Rz(γ)",
            "nine entries",
            f"within {small(rotation)}",
            within(rotation < 1e-15),
            "At the ten poses of Table 1.",
        ),
        Statement(
            "Figure 4: foot p and height h of the pair-linked triangles",
            "p² + h² = L²",
            f"within {small(heights)} mm",
            within(heights < 1e-9),
            "For the six struts at the ten poses.",
        ),
    )
    figures = {"The machine at home, with the dimensions of Figure 3": configuration_figure(run.geometry)}
    return Exhibit("Figures 1 to 4: the machine", "Drawings, computed from the geometry.", (), statements, figures)


def table_2(run: Simulation) -> Exhibit:
    """Return the comparison of Table 2: strut lengths of the ideal structure."""
    printed, computed = table(2), run.lengths * 1e3
    met = np.abs(computed - values(2)) <= roundings(printed)
    compared = NumberTable(
        "Table 2: strut lengths of the ideal structure",
        "Computed: the distances between the joints at the poses of Table 1.",
        *(LENGTHS, ROWS, printed, computed, judged(met, MISSED)),
    )
    return Exhibit("Tables 1 and 2", "Ten commanded poses and their strut lengths.", (compared,))


def table_3(run: Simulation) -> Exhibit:
    """Return the comparison of Table 3, poses computed from lengths: the exact poses, and the paper's with tanh."""
    printed, truth = table(3), values(1)
    solved = _solved(run, run.lengths)
    exact, rounded, by_tanh = _rows(solved), _rows(_solved(run, values(2) * 1e-3)), _rows_by_tanh(run, solved)
    allowed = np.maximum(roundings(printed), [_stated_angle(IDEAL_MM)] * 3 + [IDEAL_MM] * 3)
    right = np.abs(exact - truth) <= 1e-9
    met, explained = (np.abs(computed - values(3)) <= allowed for computed in (exact, by_tanh))
    tables = (
        NumberTable(
            "Table 3: predicted poses of the ideal structure",
            "Computed: the loop closures solved for the exact lengths; the result is Table 1. The printed angles "
            "4.99998° (for 5°) and 9.99937° or 9.99938° (for 10°) are wrong.",
            *(POSES, ROWS, printed, exact, judged(met, np.where(right, WRONG, MISSED))),
        ),
        NumberTable(
            "Table 3 as it was probably computed",
            "Computed: the same top joints, but angles by the paper's formulas with tanh in place of arctan; γ′ enters "
            "β′ (9.99937° in row 5, where γ is not 0). The result is the printed table.",
            *(POSES, ROWS, printed, by_tanh, judged(explained, MISSED)),
        ),
    )
    statements = _trip("from the exact lengths", exact - truth, IDEAL_MM), _rounded_trip(run, rounded - truth)
    return Exhibit("Table 3: the round trip", "Poses computed from strut lengths.", tables, statements)


def _solved(run: Simulation, lengths: np.ndarray) -> list[Pose]:
    return [solve_pose(run.geometry, row) for row in lengths]


def _rows(poses: list[Pose]) -> np.ndarray:
    """Return poses in the units of the paper: α, β, γ in degrees, then x, y, z in mm."""
    return np.array([[*np.degrees(angles_from_rotation(pose.rotation)), *(pose.position * 1e3)] for pose in poses])


def _rows_by_tanh(run: Simulation, poses: list[Pose]) -> np.ndarray:
    """Return poses as :func:`_rows` does, but with angles by the paper's formulas with tanh in place of arctan."""
    tops = [pose.position + run.geometry.platform_joints[::2] @ pose.rotation.T for pose in poses]
    angles = [misprints.printed_angles(top * 1e3, np.tanh) for top in tops]
    return np.column_stack([angles, [pose.position * 1e3 for pose in poses]])


def _stated_angle(length: float) -> float:
    """Return the angle, °, that moves a top joint of the paper's machine by `length`, mm."""
    return float(np.degrees(length / (misprints.A / misprints.S3)))


def _trip(what: str, off: np.ndarray, stated: float) -> Statement:
    """Compare the errors of a round trip with the error `stated` in the paper, mm."""
    place, angle = float(np.abs(off[:, 3:]).max()), float(np.abs(off[:, :3]).max())
    good = place <= stated and angle <= _stated_angle(stated)
    computed = f"{place * 1e3:.0e} µm, {angle:.0e}°"
    return Statement(f"round trip {what}", f"about {stated * 1e3:g} µm", computed, within(good))


def _rounded_trip(run: Simulation, off: np.ndarray) -> Statement:
    """Compare the pose errors caused by the rounding of Table 2 with their bounds."""
    share = 0.0
    for pose, row in zip(run.poses, off, strict=True):
        allowed = np.abs(np.linalg.inv(jacobian(run.geometry, pose))).sum(axis=1) * 0.5e-3  # mm, by 0.5 µm per strut
        share = max(share, float((np.abs(row[3:]) / allowed[:3]).max()))
    place, angle = float(np.abs(off[:, 3:]).max()), float(np.abs(off[:, :3]).max())
    return Statement(
        "round trip from the lengths as printed",
        "rounded to 1 µm",
        f"{place * 1e3:.2f} µm, {angle:.1e}°",
        within(share <= 1.0 + 1e-6),
        f"The pose errors are at most {share:.2f} of the bound that follows from the rounding of the lengths.",
    )


def table_4(run: Simulation) -> Exhibit:
    """Return the comparison of Table 4: strut lengths of the real structure, with new errors for each pose."""
    printed = table(4)
    real = np.array([one.real_lengths[0, 0] for one in run.drawn])
    changes = np.array([one.strut_changes[:, 0] for one in run.drawn])
    shown = (values(4) * 1e-3 - run.lengths) * 1e6
    bounds = np.array([change_bounds(run.geometry, pose) for pose in run.poses])
    compared = NumberTable(
        "Table 4: strut lengths of the real structure",
        "Computed: one machine for each pose, drawn within ±10 µm for every joint coordinate and strut. The paper does "
        "not print its random numbers, so its digits cannot be met; the differences are those of two random draws.",
        *(LENGTHS, ROWS, printed, real * 1e3, judged(np.zeros((10, 6), dtype=bool), OPEN)),
    )
    statements = (
        Statement(
            "Table 4 − Table 2 within the bounds for errors of ±10 µm",
            f"{shown.min():.1f} … {shown.max():.1f} µm",
            f"at most ±{bounds.min():.1f} to ±{bounds.max():.1f} µm, by strut and pose",
            within((np.abs(shown) <= bounds).all()),
            "Bound: 10 µm times (|u|₁ + |Rᵀu|₁ + 1), with both joints in a corner of their cubes. All 60 changes are "
            "within their bounds.",
        ),
        *_range_statements(run, changes * 1e6, shown),
    )
    figures = {"Table 4 − Table 2: as printed, and for random machines": changes_figure(changes * 1e6, shown)}
    return Exhibit(
        "Table 4: imperfect machines", "The same poses on real structures.", (compared,), statements, figures
    )


def change_bounds(geometry: HexapodGeometry, pose: Pose) -> np.ndarray:
    """Return the largest changes, µm, of the six strut lengths at a pose if joints and struts have errors of ±10 µm."""
    struts = pose.transform(geometry.platform_joints) - geometry.base_joints
    units = struts / np.linalg.norm(struts, axis=1)[:, None]
    return BOUND * 1e6 * (np.abs(units).sum(axis=1) + np.abs(units @ pose.rotation).sum(axis=1) + 1.0)


def _range_statements(run: Simulation, changes: np.ndarray, shown: np.ndarray) -> tuple[Statement, ...]:
    """Compare the printed changes with uniform errors: mean, scatter, and the probability of the printed range."""
    low, high = float(shown.min()), float(shown.max())
    chances = np.array([range_probability(run.geometry, pose, low, high) for pose in run.poses])
    power, wider = np.log10(chances).sum(), range_probability(run.geometry, run.poses[0], -6.0, 2.0)
    return (
        Statement(
            "mean and standard deviation of the 60 changes",
            f"{shown.mean():.2f} and {shown.std():.2f} µm",
            f"{changes.mean():.2f} and {changes.std():.2f} µm over {changes.size} drawn",
            OPEN,
            "Three uniform errors of ±10 µm act along a strut, so its length has a standard deviation of 10 µm. The "
            "printed changes have a sixth of that, and their mean is not zero. So the errors of Table 4 were not "
            "uniform within ±10 µm.",
        ),
        Statement(
            "all six changes of a row within the printed range",
            "in each of ten rows",
            f"probability {chances.min():.5f} to {chances.max():.5f} per row, 10^{power:.0f} for ten rows",
            OPEN,
            f"Range {low:.1f} … {high:.1f} µm. For the range of the rounded tables, −6 … +2 µm, the probability is "
            f"{wider:.5f} at the first pose. {DRAWS} machines were drawn for each pair of struts that share a joint.",
        ),
        _one_machine(run, shown),
    )


def range_probability(geometry: HexapodGeometry, pose: Pose, low: float, high: float, seed: int = 1) -> float:
    """Return the probability that uniform ±10 µm errors change all six lengths at a pose by low … high, µm.

    The two struts of a pair share a top joint. Different pairs share no error, so their probabilities multiply.
    """
    rng = np.random.default_rng(seed)
    parts = _change_matrix(geometry, pose)
    chance = 1.0
    for pair in range(3):
        rows = parts[2 * pair : 2 * pair + 2]
        used = np.flatnonzero(np.abs(rows).sum(axis=0))
        drawn = rng.uniform(-BOUND * 1e6, BOUND * 1e6, (DRAWS, len(used))) @ rows[:, used].T
        chance *= float(((drawn >= low) & (drawn <= high)).all(axis=1).mean())
    return chance


def _change_matrix(geometry: HexapodGeometry, pose: Pose) -> np.ndarray:
    """Return the derivatives of the lengths by 18 base coordinates, 9 top coordinates and 6 offsets, shape (6, 33).

    The neglected second order is (10 µm)² divided by the strut's length: 0.0002 µm.
    """
    struts = pose.transform(geometry.platform_joints) - geometry.base_joints
    units = struts / np.linalg.norm(struts, axis=1)[:, None]
    matrix = np.zeros((6, 33))
    for strut, unit in enumerate(units):
        matrix[strut, 3 * strut : 3 * strut + 3] = -unit
        top = 18 + 3 * (strut // 2)
        matrix[strut, top : top + 3] = unit @ pose.rotation
        matrix[strut, 27 + strut] = -1.0
    return matrix


def _one_machine(run: Simulation, shown: np.ndarray) -> Statement:
    """Compute how well one machine fits all rows of Table 4, and which error bound one machine per row needs."""
    matrices = [_change_matrix(run.geometry, pose) for pose in run.poses]
    one = _least_deviation(np.vstack(matrices), shown.ravel())
    needed = max(_least_bound(matrix, row) for matrix, row in zip(matrices, shown, strict=True))
    return Statement(
        "errors that give Table 4",
        "new ones in each iteration",
        f"one machine for all rows: off by {one:.2f} µm; one machine per row: exact with errors of ±{needed:.1f} µm",
        within(one > 0.5 and needed <= BOUND * 1e6),
        "Computed by linear programming. So the errors changed from row to row, as the paper says. Several sets of "
        "errors give the same row.",
    )


def _least_deviation(matrix: np.ndarray, changes: np.ndarray) -> float:
    """Fit errors within ±10 µm to `changes` by least maximum deviation; return this deviation, µm."""
    from scipy.optimize import linprog

    ones = np.ones((len(changes), 1))
    rows = np.block([[matrix, -ones], [-matrix, -ones]])
    limits = [(-BOUND * 1e6, BOUND * 1e6)] * matrix.shape[1] + [(0.0, None)]
    cost = np.append(np.zeros(matrix.shape[1]), 1.0)
    return float(linprog(cost, rows, np.concatenate([changes, -changes]), bounds=limits).fun)


def _least_bound(matrix: np.ndarray, changes: np.ndarray) -> float:
    """Return the smallest bound of errors, µm, that reproduce `changes` within the rounding of 0.5 µm."""
    from scipy.optimize import linprog

    size = matrix.shape[1]
    ones, none = np.ones((size, 1)), np.zeros((len(changes), 1))
    rows = np.block([[matrix, none], [-matrix, none], [np.eye(size), -ones], [-np.eye(size), -ones]])
    right = np.concatenate([changes + 0.5, 0.5 - changes, np.zeros(2 * size)])
    cost = np.append(np.zeros(size), 1.0)
    return float(linprog(cost, rows, right, bounds=[(None, None)] * size + [(0.0, None)]).fun)


def table_5(run: Simulation) -> Exhibit:
    """Return the comparison of Table 5, poses computed from real lengths: by the real and by the ideal structure."""
    trip = max(float(one.round_trip[..., 0].max()) for one in run.drawn)
    off = values(5) - values(1)
    statements = (
        Statement(
            "largest difference between Table 5 and Table 1",
            "consistency of about 0.1 µm",
            f"{np.abs(off[:, 3:]).max() * 1e3:.1f} µm, {np.abs(off[:, :3]).max():.1e}°",
            WRONG,
            "Computed from the printed numbers alone.",
        ),
        Statement(
            f"round trip of {sum(len(one.seeds) for one in run.drawn)} machines, each at its pose",
            "about 0.1 µm",
            f"{trip * 1e6:.0e} µm",
            within(trip * 1e3 <= REAL_MM),
            "Newton's method starts 1 mm from the pose.",
        ),
    )
    tables = _as_described(run), _as_made(run)
    text = "Computed in two ways: as the paper describes, and as the printed numbers suggest."
    return Exhibit("Table 5: the round trip of real structures", text, tables, statements)


def _as_described(run: Simulation) -> NumberTable:
    """Compare Table 5 with the round trip through the real structures."""
    computed = _rows(_through_real(run))
    stated = np.maximum(roundings(table(5)), [_stated_angle(REAL_MM)] * 3 + [REAL_MM] * 3)
    closed = np.abs(computed - values(1)) <= 1e-9
    return NumberTable(
        "Table 5 as the paper describes it",
        "Computed: the lengths of each pose's machine of Table 4, and from them the pose of the same machine. The "
        "exact solution of the loop closures is Table 1.",
        *(POSES, ROWS, table(5), computed),
        judged(np.abs(computed - values(5)) <= stated, np.where(closed, WRONG, MISSED)),
    )


def _as_made(run: Simulation) -> NumberTable:
    """Compare Table 5 with the poses of the ideal structure for the lengths of Table 4, with angles by tanh."""
    computed = _rows_by_tanh(run, _solved(run, values(4) * 1e-3))
    met = np.abs(computed - values(5)) <= roundings(table(5)) + _rounding_of_4(run)
    return NumberTable(
        "Table 5 as it was probably computed",
        "Computed: poses of the ideal structure for the printed lengths of Table 4, with angles by tanh as in Table 3. "
        "The result is the printed table: it does not account for the errors of joints and struts.",
        *(POSES, ROWS, table(5), computed, judged(met, MISSED)),
    )


def _through_real(run: Simulation) -> list[Pose]:
    """Return the pose of each pose's first machine for its own real lengths; Newton's method starts at home."""
    machines = [RealMachine(run.geometry, draw_model(run.geometry, BOUNDS, one.seeds[0])) for one in run.drawn]
    return [machine.pose_for(one.real_lengths[0, 0])[0] for machine, one in zip(machines, run.drawn, strict=True)]


def _rounding_of_4(run: Simulation) -> np.ndarray:
    """Return the largest pose errors by the rounding of Table 4, 0.5 µm per strut, shape (10, 6), ° and mm.

    To first order each angle may change by the bound of the whole rotation.
    """
    allowed = []
    for pose in run.poses:
        turned = np.abs(np.linalg.inv(jacobian(run.geometry, pose))).sum(axis=1) * 0.5e-6
        largest = np.degrees(np.linalg.norm(turned[3:]))
        allowed.append([*[largest] * 3, *(turned[:3] * 1e3)])
    return np.array(allowed)


def random_poses(run: Simulation, seed: int = 1) -> Exhibit:
    """Return the round trip at random poses: of the ideal structure, and of real structures with new errors at each."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(RANDOM_BOX[0], RANDOM_BOX[1], (RANDOM_POSES, 3))
    rotations = rotation_from_angles(rng.uniform(-RANDOM_TILT, RANDOM_TILT, (RANDOM_POSES, 3)))
    structure = Structure.of(run.geometry)
    lengths = strut_lengths_batch(structure, positions, rotations)
    solved = solve_poses(structure, lengths, run.geometry.home)
    place = float(np.linalg.norm(solved.positions - positions, axis=1).max())
    trips = [
        assess(run.geometry, [Pose(position, rotation)], BOUNDS, seed + n).round_trip[0, 0, 0]
        for n, (position, rotation) in enumerate(zip(positions[:REAL_POSES], rotations[:REAL_POSES], strict=True))
    ]
    where = "in Mou & King's box of 16 × 16 × 8 inches, angles up to ±10°"
    statements = (
        Statement(
            f"ideal structure, {RANDOM_POSES} random poses",
            "about 0.01 µm",
            f"{place * 1e6:.0e} µm",
            within(place * 1e3 <= IDEAL_MM),
            f"Poses {where}; Newton's method starts at home.",
        ),
        Statement(
            f"real structures, {len(trips)} random poses, new errors at each pose",
            "about 0.1 µm",
            f"{max(trips) * 1e6:.0e} µm",
            within(max(trips) * 1e3 <= REAL_MM),
        ),
    )
    text = "The paper uses ten random poses. Here the round trip is computed at more poses, in a larger space."
    return Exhibit("Random poses", text, (), statements)


def wrong() -> Exhibit:
    """Return the misprints in the formulas, with the error that each causes."""
    statements = []
    for misprint in misprints.MISPRINTS:
        printed, corrected = misprint.worst()
        statements.append(
            Statement(
                misprint.name,
                misprint.printed,
                misprint.corrected,
                WRONG if corrected < 1e-9 < printed else MISSED,
                f"Error as printed {printed:.4g} {misprint.unit}, as corrected {small(corrected)}.",
            )
        )
    text = (
        "Each formula was evaluated as printed and as corrected at the ten poses of Table 1, with the paper's drawing. "
        "The package uses none of these formulas: it solves the six loop closures."
    )
    return Exhibit("Misprints in the formulas", text, (), tuple(statements))
