"""CSV files of poses and lengths: values are read exactly, and messages state file, line and column."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import beside
from scipy.spatial.transform import Rotation

from hexapod_comp.errors import InputFileError
from hexapod_comp.formats.texts import relative_change
from hexapod_comp.machine.pose_files import length_values, read_lengths, read_pose_arrays, read_poses
from hexapod_comp.pose import Pose

TEXTS = beside(__file__)
HEADER = "name,x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg\n"


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "poses.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_mm_and_degrees_become_m_and_rotations(tmp_path: Path) -> None:
    """The truth is scipy's rotation by the paper's definition R = Ry(β)·Rx(α)·Rz(γ)."""
    rows, poses = read_poses(written(tmp_path, HEADER + "a,1,-2,400,10,20,30\n"))
    assert (rows[0].line, rows[0].label) == (2, "a")
    np.testing.assert_allclose(poses[0].position, [1e-3, -2e-3, 0.4], rtol=1e-15)
    turns = [Rotation.from_euler(axis, angle, degrees=True) for axis, angle in (("y", 20), ("x", 10), ("z", 30))]
    expected = turns[0] * turns[1] * turns[2]
    np.testing.assert_allclose(poses[0].rotation, expected.as_matrix(), atol=1e-15)
    quaternion = ",".join(map(repr, expected.as_quat().tolist()))
    _, poses = read_poses(written(tmp_path, f"x_m,y_m,z_m,qx,qy,qz,qw\n0,0,0.4,{quaternion}\n"))
    np.testing.assert_allclose(poses[0].rotation, expected.as_matrix(), atol=1e-15)


def test_comments_blank_lines_spaces_bom_and_windows_line_ends(tmp_path: Path) -> None:
    """Comments and blank lines count as lines, as in an editor."""
    text = "\ufeff# a comment\r\nx_mm, y_mm, z_mm\r\n\r\n# more\r\n763.2, 76.32e1, 3\r\n"
    rows, poses = read_poses(written(tmp_path, text))
    assert rows[0].line == 5
    assert poses[0].position.tolist() == [0.7632, 0.7632, 0.003], "763.2 times 0.001 is another float"


MALFORMED = TEXTS["malformed"] | {
    "huge field": (HEADER + "a" * 200_000, "is not CSV: field larger than field limit"),
    "long line": (HEADER + "," * 1_000_001, "line 2: is longer than the allowed 1000000 characters"),
}


@pytest.mark.parametrize(("text", "complaint"), MALFORMED.values(), ids=MALFORMED.keys())
def test_malformed_poses_are_refused_with_file_line_and_column(
    tmp_path: Path, text: str | bytes, complaint: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputFileError) as caught:
        read_poses(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert complaint in str(caught.value)


def test_a_missing_file_lists_those_of_its_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message lists files of the same kind in that folder and among the shipped ones: poses, or lengths."""
    monkeypatch.chdir(tmp_path)
    Path("lengths.csv").write_text("sequence;L1_mm\n")
    Path("notes.txt").write_text("x_mm\n")
    Path("mine.csv").write_text("# by hand\n x_mm,y_mm,z_mm\n")
    for read, asked, said in (
        (read_poses, "none/gone.csv", r"there is no such file, and its folder does not exist"),
        (
            read_poses,
            "mien.csv",
            r"beside it: mine.csv; shipped: table1.csv, table3.csv, table5.csv; did you mean mine",
        ),
        (read_lengths, "x.csv", r"files beside it: lengths.csv; shipped: table2.csv"),
    ):
        with pytest.raises(InputFileError, match=said):
            read(asked)
    for n in range(12):
        Path(f"{n:02}.csv").write_text("x_mm,y_mm,z_mm\n")
    with pytest.raises(InputFileError, match=r"10.csv, 11.csv and 1 more; shipped"):
        read_poses("x.csv")


# Files of spreadsheets

POSE = Pose([0.0015, -0.002, 0.4], np.eye(3))


@pytest.mark.parametrize("text", [*TEXTS["spreadsheets"], "x_µm,y_µm,z_m\n1500,-2000,0.4\n".encode("cp1252")])
def test_semicolons_tabs_decimal_commas_and_micro_signs(tmp_path: Path, text: str | bytes) -> None:
    """Files as spreadsheets of many countries save them give the same floats as files with decimal points."""
    (pose,) = read_poses(written(tmp_path, text))[1]
    np.testing.assert_array_equal(pose.position, POSE.position)


@pytest.mark.parametrize(("text", "complaint"), TEXTS["ambiguous"])
def test_what_may_mean_two_things_is_refused(tmp_path: Path, text: str | bytes, complaint: str) -> None:
    with pytest.raises(InputFileError) as caught:
        read_poses(written(tmp_path, text))
    assert complaint in str(caught.value)


def test_malformed_lengths(tmp_path: Path) -> None:
    five = "L1_mm,L2_mm,L3_mm,L4_mm,L5_mm"
    assert read_lengths(written(tmp_path, f"{five},L6_in\n1,2,3,4,5,6\n"))[1][0, 5] == pytest.approx(6 * 0.0254)
    for text, complaint in (
        (f"{five}\n1,2,3,4,5\n", "header: column L6_m or"),
        (f"{five},L6_mm,correction_L1_um\n1,2,3,4,5,6,7\n", "header: column correction_L2_m or"),
    ):
        with pytest.raises(InputFileError, match=complaint):
            read_lengths(written(tmp_path, text))


def test_what_is_written_reads_back(tmp_path: Path) -> None:
    """Written files read back to 1e-15 m and 2e-15: one rounding each of mm, degrees and the trigonometry."""
    rng = np.random.default_rng(3)
    poses = [
        Pose(p, Rotation.from_rotvec(w).as_matrix())
        for p, w in zip(rng.uniform(-1, 1, (50, 3)), rng.uniform(-1, 1, (50, 3)), strict=True)
    ]
    lines = [",".join(poses[0].as_columns()), *(",".join(map(repr, p.as_columns().values())) for p in poses)]
    rows, positions, rotations = read_pose_arrays(written(tmp_path, "\n".join(lines)))
    assert [row.line for row in rows] == list(range(2, 52))
    np.testing.assert_allclose(positions, [p.position for p in poses], atol=1e-15)
    np.testing.assert_allclose(rotations, [p.rotation for p in poses], atol=2e-15)
    lengths = rng.uniform(0.3, 0.9, 6)
    text = ",".join(length_values(lengths)) + "\n" + ",".join(map(repr, length_values(lengths).values()))
    np.testing.assert_allclose(read_lengths(written(tmp_path, text))[1][0], lengths, rtol=1e-15)


def test_a_change_is_stated_without_a_sign() -> None:
    assert relative_change(80.0, 4.0) == "95.0 % less"
    assert relative_change(0.5, 0.6, 0) == "20 % more"
    assert relative_change(2.0, 2.0) == "0.0 % less"
