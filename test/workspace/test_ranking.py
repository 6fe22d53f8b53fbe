"""The ranking beside v. Daake et al.'s Table 1; combined budgets against enumeration and closed-form distributions."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import calibration_helpers as small
import numpy as np
import pytest
from helpers import assert_defaults, poses_about
from scipy import stats

from hexapod_comp.errors import CalibrationError, InputFileError, ModelError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.workspace.budget import Budget, SingleErrors, load_budget
from hexapod_comp.workspace.combined import (
    _ranks,
    allocate,
    covariance_factor,
    monte_carlo,
    root_sum_of_squares,
    worst_case,
)
from hexapod_comp.workspace.effects import LINEAR, Extremes, effect_vectors, effects, extremes
from hexapod_comp.workspace.ranking import JOINED, Extreme, RankingRow, ranked, ranking_rows, ranking_text
from hexapod_comp.workspace.reach import poses_at, reach
from hexapod_comp.workspace.shells import ROTATION, TRANSLATION, shell
from hexapod_comp.workspace.study import classify, mesh_effects, report

PAPER_SIZES = {
    "screw_pitch": 20e-6,
    "quantisation": 7e-6,
    "base_joint_xy": 10e-6,
    "base_joint_z": 10e-6,
    "platform_joint_xy": 10e-6,
    "platform_joint_z": 10e-6,
}
MIXED = {"strut_length": 8e-6, "base_joint_xy": 10e-6, "platform_joint_z": 12e-6, "tool_offset": 5e-6}


def unit() -> HexapodGeometry:
    return load_geometry("positioning_unit")


def tooled() -> HexapodGeometry:
    return small.framed(unit())


def over(geometry: HexapodGeometry, sizes: dict[str, float], count: int = 500) -> Extremes:
    positions, rotations = poses_about(geometry.home, count, seed=1, reach=0.02, tilt_deg=3.0)
    return extremes(geometry, Budget(geometry.name, sizes).single_errors(geometry), positions, rotations)


def linear(sizes: dict[str, float], count: int = 3) -> tuple[SingleErrors, np.ndarray]:
    """Return errors and their effects on the tooled unit, (count, E, 6)."""
    geometry = tooled()
    errors = Budget(geometry.name, sizes).single_errors(geometry)
    positions, rotations = poses_about(geometry.home, count, seed=2, reach=0.02, tilt_deg=5.0)
    return errors, effect_vectors(geometry, errors, positions, rotations, LINEAR)


def test_screw_pitch_comes_first_as_in_the_paper():
    """The paper's machine is not printed; effects scale with the input error, except for 20 µm / 250 mm."""
    geometry = unit()
    rows = ranked(over(geometry, PAPER_SIZES), geometry)
    assert rows[0].title == "screw pitch"
    largest = [row.figures()[0] for row in rows]
    assert largest == sorted(largest, reverse=True)
    assert largest[0] > 1.9 * largest[1]
    by_title = {row.title: row.figures() for row in rows}
    pitch, step, joints, _ = (by_title.pop(title) for title in ("screw pitch", "quantisation", *JOINED))
    assert not by_title
    np.testing.assert_allclose(step / pitch, 7.0 / 20.0, rtol=1e-3)
    assert joints[1] < 0.05e-6  # a joint error across its strut moves nothing: "≈ 0" in the paper
    records = json.loads(json.dumps(ranking_rows(rows)))
    assert [record["rank"] for record in records] == [1, 2, 3, 4]
    assert records[0]["translation_max_um"] == pytest.approx(largest[0] * 1e6)
    assert records[0]["rotation_min_mdeg"] == pytest.approx(np.degrees(rows[0].figures()[3]) * 1e3)


def test_a_row_of_the_ranking_as_text_and_as_a_record():
    """The truth is a row by hand: 0.001 rad are 57.30 m°."""
    places = [[0.1, 0.0, -0.05], [0.0, 0.0025, 0.4], [0.0, 0.0, 0.4], [0.0, 0.0, 0.4]]
    angles = np.radians([[10.0, 0.0, -20.0], *np.zeros((3, 3))])
    values = zip((12.34e-6, 1e-6, 1e-3, 1e-5), places, angles, strict=True)
    extremes = [Extreme(v, f"strut_{n}", np.array(p), a) for n, (v, p, a) in enumerate(values, 1)]
    row = RankingRow("backlash", tuple(extremes), 3)
    assert f"{ranking_text([row])}\n" == small.recorded("ranking")
    (record,) = ranking_rows([row])
    assert list(record.values())[:3] == [1, "backlash", "work"]
    first = {"um": 12.34, "error": "strut_1", "x_mm": 100, "y_mm": 0, "z_mm": -50, "alpha_deg": 10, "beta_deg": 0}
    for key, value in (first | {"gamma_deg": -20}).items():
        assert record[f"translation_max_{key}"] == (value if key == "error" else pytest.approx(value))
    assert (record["rotation_max_mdeg"], record["failed"]) == (pytest.approx(57.29578), 3)


def test_joined_rows_hold_the_larger_and_the_smaller_of_their_types():
    geometry = unit()
    found = over(geometry, PAPER_SIZES, count=50)
    single = over(geometry, {"base_joint_xy": 10e-6}, 50), over(geometry, {"platform_joint_xy": 10e-6}, 50)
    joined = {row.title: row.figures() for row in ranked(found, geometry)}
    both = np.array([ranked(one, geometry)[0].figures() for one in single])
    expected = np.where([True, False, True, False], both.max(axis=0), both.min(axis=0))
    np.testing.assert_array_equal(joined["base-/platform joint (x/y)"], expected)
    only_base = over(geometry, {"base_joint_xy": 1e-5}, count=5)
    assert [row.title for row in ranked(only_base, geometry)] == ["base joint x/y"]


SHARED = {"platform_joint_xy": 10e-6, "platform_joint_z": 8e-6, "strut_length": 5e-6}


@pytest.mark.parametrize(
    ("make", "sizes", "chosen"),
    [(small.paper, SHARED, range(12)), (tooled, MIXED, [0, 1, 6, 7, 9, 12, 19, 20, 22, 24, 26])],
    ids=["shared joints", "tool"],
)
def test_the_worst_case_is_the_largest_over_all_signs(make, sizes, chosen):
    # All 2^12 combinations; a shared joint's three errors have separate directions. At home the paper's machine is so
    # symmetrical that directions are in common planes. On the tooled unit two errors are the tool's.
    geometry = make()
    errors = Budget(geometry.name, sizes).single_errors(geometry)
    errors = errors.select(np.isin(np.arange(len(errors)), chosen))
    positions, rotations = poses_about(geometry.home, 4, seed=2, reach=0.05, tilt_deg=10.0)
    positions[0], rotations[0] = geometry.home.position, np.eye(3)
    vectors = effect_vectors(geometry, errors, positions, rotations, LINEAR)
    signs = np.array(list(product([-1.0, 1.0], repeat=len(errors))))
    sums = np.einsum("se,nec->nsc", signs, vectors)
    expected = np.stack([np.linalg.norm(sums[..., :3], axis=2).max(axis=1), np.abs(sums[..., 3:]).max(axis=(1, 2))])
    np.testing.assert_allclose(worst_case(errors, vectors), expected.T, rtol=1e-9)


def test_monte_carlo_finds_known_percentiles():
    # One uniform error: |u| is uniform, so the p-th percentile is p. Three perpendicular normal errors: chi with 3
    # degrees of freedom. The tool's errors are the same everywhere. 20,000 draws give a median to 0.4 %.
    _, vectors = linear({"tool_offset": 5e-6})
    alone = monte_carlo(vectors[:, :1], draws=20_000, percentiles=(50.0, 90.0, 99.0))
    np.testing.assert_allclose(alone.values[:, 0], 5e-6 * np.array([0.5, 0.9, 0.99]), rtol=0.03)
    normal = monte_carlo(vectors, draws=20_000, percentiles=(50.0, 95.0), normal=True, seed=4)
    np.testing.assert_allclose(normal.values[:, 0], 5e-6 * stats.chi(3).ppf([0.5, 0.95]), rtol=0.03)
    assert (normal.low <= normal.values).all()
    assert (normal.values <= normal.high).all()
    with pytest.raises(ModelError, match="draws: are too few for bounds of the 95th percentile with 95% confidence"):
        monte_carlo(vectors, draws=50)


@pytest.mark.parametrize("percentile", [50.0, 95.0, 99.0])
def test_ranks_of_a_percentile_bound_it_with_95_percent(percentile: float):
    """The number of 1000 draws below the percentile is binomial; either bound one rank closer would be too close."""
    rank, low, high = _ranks(1000, percentile)
    below = stats.binom(1000, 0.01 * percentile)
    assert rank == 10 * percentile - 1
    assert below.cdf(low) <= 0.025 <= below.cdf(low + 1)
    assert below.sf(high) <= 0.025 <= below.sf(high - 1)


def test_allocated_errors_use_up_what_is_allowed():
    # The machine with the allocated sizes, evaluated again, must have the allowed error
    errors, vectors = linear(MIXED, count=15)
    allowed = 2e-4
    found = allocate(errors, vectors, allowed)

    def largest(factors: np.ndarray) -> float:
        return float(worst_case(errors, vectors * factors[errors.kind][:, None])[:, 0].max())

    ones = np.ones(len(errors.kinds))
    assert found.combined == pytest.approx(largest(ones), rel=1e-12)
    assert largest(found.scale * ones) == pytest.approx(allowed, rel=1e-9)
    for kind, factor in enumerate(found.alone):
        alone = ones.copy()
        alone[kind] = factor
        assert factor > found.scale
        assert largest(alone) == pytest.approx(allowed, rel=1e-8)
        assert found.only[kind] == pytest.approx(largest(np.eye(len(ones))[kind]), rel=1e-12)
        assert found.without[kind] == pytest.approx(largest(ones - np.eye(len(ones))[kind]), rel=1e-12)
    acting = np.isfinite(found.equal)
    assert largest(np.where(acting, found.equal, 0.0)) <= allowed * (1 + 1e-9)  # equal parts together do not exceed it
    used = [largest(np.where(np.arange(len(ones)) == kind, found.equal, 0.0)) for kind in np.flatnonzero(acting)]
    np.testing.assert_allclose(used, used[0], rtol=1e-9)
    none = allocate(errors, 0.0 * vectors, allowed)
    assert np.isinf([none.scale, *none.alone, *none.equal]).all()


def test_nothing_is_left_for_a_source_when_the_others_are_too_much():
    errors, vectors = linear({"strut_length": 50e-6, "tool_offset": 1e-6})
    found = allocate(errors, vectors, allowed=20e-6)
    assert np.isnan(found.alone[1])
    assert 0.0 < found.alone[0] < 1.0
    for wrong in (0.0, -1e-6, np.inf, np.nan):
        with pytest.raises(ModelError, match="allowed"):
            allocate(errors, vectors, allowed=wrong)
    with pytest.raises(ModelError, match="empty"):
        allocate(errors, vectors[:0], 1e-5)


def test_the_report_of_a_study():
    """The truth is the text of a file, read by a person: 3.46 µm are √3·2 µm, 14.43 is 2·25/3.46. The ranking has its
    own test.
    """
    budget = Budget("positioning_unit", {"strut_length": 8e-6, "thermal_growth": 100e-6, "tool_offset": 2e-6})
    study = classify(unit(), budget, (reach(unit(), cells=6),), allowed=75e-6)
    found = report(study, ["level"]).replace(ranking_text(study.rows), "RANKING")
    assert found == Path(__file__).with_name("study.txt").read_text("utf-8")
    assert (TRANSLATION.factor, ROTATION.factor) == (1e6, pytest.approx(1e3 * np.degrees(1.0)))
    body = shell(study.reaches[0], 3, 4)
    points, values = mesh_effects(study, body)  # scaled about the centre, from the inside to the boundary
    wanted = body.centre + np.multiply.outer([0.4, 0.7, 1.0], body.points - body.centre)
    np.testing.assert_allclose(points, wanted, atol=1e-12)
    alone = effects(study.geometry, study.errors, *poses_at(study.geometry, points[1, 1, :1], np.eye(3)), "exact")[0]
    np.testing.assert_allclose(values[:, :, 1, 1, 0], alone, rtol=1e-9)


# --- after compensation ------------------------------------------------------------------------------------


def test_independent_errors_add_up_by_their_squares():
    """Perpendicular displacements of two errors add as 5² + 12² = 13²; of rotations the largest axis counts."""
    vectors = np.array([[[3.0, 4.0, 0.0, 0.3, 0.0, 0.1], [0.0, 0.0, 12.0, 0.4, 0.2, 0.0]]])
    np.testing.assert_allclose(root_sum_of_squares(vectors), [[13.0, 0.5]], rtol=1e-15)
    covariance = np.array([[4.0, 2.0e6], [2.0e6, 9.0e12]])  # of parameters in very different units
    factor = covariance_factor(covariance)
    np.testing.assert_allclose(factor @ factor.T, covariance, rtol=1e-12)


def test_a_matrix_that_is_no_covariance_is_refused():
    for wrong, match in (
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "negative"),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), "finite"),
    ):
        with pytest.raises(CalibrationError, match=match):
            covariance_factor(wrong)
    assert not covariance_factor(np.zeros((2, 2))).any()


HEAD = "format: hexapod_comp/error_budget\nversion: 1\nmachine: positioning_unit\n"


def read(folder: Path, text: str) -> Budget:
    path = folder / "budget.yaml"
    path.write_text(text, encoding="utf-8")
    return load_budget(path)


def test_the_shipped_budget_has_the_papers_sizes() -> None:
    """v. Daake et al., chapter 3: six pitches of ±20 µm, 36 coordinates of ±10 µm, six quantisations of ±7 µm."""
    budget = load_budget(config_file("error_budget"))
    errors = budget.single_errors(unit())
    assert len(errors) == 48
    assert len(set(zip(errors.kind, errors.labels, strict=True))) == 48  # type and label identify one error
    assert np.bincount(errors.kind).tolist() == [6, 6, 12, 6, 12, 6]
    sizes = {title: np.linalg.norm(errors.vector[errors.kind == k], axis=1) for k, title in enumerate(errors.kinds)}
    np.testing.assert_allclose(sizes.pop("screw pitch"), 20e-6, rtol=1e-12)
    np.testing.assert_allclose(sizes.pop("quantisation"), 7e-6, rtol=1e-12)
    for size in sizes.values():
        np.testing.assert_allclose(size, 10e-6, rtol=1e-12)


def test_a_strut_is_off_by_half_its_backlash() -> None:
    """With backlash b a strut is b/2 to either side of the middle; v. Daake et al. have no row for backlash."""
    whole, half = (
        Budget("positioning_unit", sizes).single_errors(unit())
        for sizes in ({"backlash": 8e-6}, {"strut_length": 4e-6})
    )
    np.testing.assert_allclose(whole.vector, half.vector, rtol=1e-12)


def test_units_are_read_from_the_keys(tmp_path: Path) -> None:
    """1 ppm is 1e-6, 0.5 % is 5e-3, 0.0004 in is 10.16 µm. Types are in the order of the code."""
    sizes = "tool_offset_um: 5, thermal_growth_ppm: 120, screw_pitch_slope_percent: 0.5, strut_length_in: 0.0004"
    budget = read(tmp_path, f"{HEAD}errors: {{{sizes}}}\n")
    assert list(budget.sizes) == ["strut_length", "screw_pitch_slope", "thermal_growth", "tool_offset"]
    np.testing.assert_allclose(list(budget.sizes.values()), [10.16e-6, 5e-3, 120e-6, 5e-6], rtol=1e-12)


def test_a_budget_that_is_none_is_refused(tmp_path: Path) -> None:
    for text, complaint in (
        (HEAD, "errors: is missing"),
        (f"{HEAD}errors: {{screw_pitch_um: 20}}\nnote: x\n", "note"),
        (f"{HEAD}errors: {{screw_pitch_um: 20, wobble_um: 1}}\n", "errors.wobble_um: is not an error type followed by"),
    ):
        with pytest.raises(InputFileError, match=rf"budget\.yaml: .*{complaint}"):
            read(tmp_path, text)
    wrong = [({"backlash": size}, "errors.backlash") for size in (np.nan, 0.0, 0.1)]
    for sizes, key in (({}, "errors"), ({"wobble": 1e-6}, "errors.wobble"), *wrong):
        with pytest.raises(ModelError) as caught:
            Budget("positioning_unit", sizes)
        assert caught.value.key == key


def test_defaults():
    assert_defaults(__file__)
