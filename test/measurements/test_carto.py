"""Files of laser software, built here as carto_files.py describes them: no real one is at hand.

The header of the .rtx is that of a capture by CARTO 4.13 (TanmayPani/rtx2csv, its test's header.json).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from strategies import fixed, paper_geometry
from test_measurement_csv import edits, mutated

from hexapod_comp.errors import HexapodError, InputFileError
from hexapod_comp.measurements.carto import load_line, read_carto
from hexapod_comp.measurements.carto_files import read_rtl, read_rtx, read_sections
from hexapod_comp.measurements.readings import BACKWARD, CHANNELS, FORWARD
from hexapod_comp.measurements.standards import linear_runs

RATE, SPEED = 100.0, 5.0  # 1/s, mm/s


def rtx(samples: np.ndarray, count: int | None = None, end: bytes = b"EOF::\r\n", rate: float = RATE) -> bytes:
    header = (
        "HEADER::\r\nFile Type: rtx\r\nOwner: CARTO-Dynamic\r\nVersion no: 4.13.9237.28405\r\nVelocity: 0\r\n"
        f"Sample rate: {rate}\r\nSample no: {len(samples) if count is None else count}\r\nTrigger point: 0\r\n"
        f"Trigger interval: {1 / rate}\r\nActual sample rate: {rate}\r\nFlags: 0 1 2 0 2\r\n\r\nUSER-TEXT::\r\n"
        "Machine: \r\nSerial No: \r\nDate: 10/02/2025 12:58:22\r\nBy: User\r\nAxis: X\r\nLocation: \r\n"
        "Wholly new: 17\r\n\r\nData:\r\n"
    )
    return header.encode() + np.asarray(samples, "<f8").tobytes() + end


RTX_LINE = """format: hexapod_comp/line
version: 1
run: x at y 10, z 450
axis: x
across_mm: [10, 450]
channel: linear
unit: mm
start_mm: -100
speed_mm_s: 5
from_s: 1
to_s: 41
every_mm: 20
"""

RTL = """HEADER::
File type  : rtl
Owner      : LASER10
Version no : 20.02.02

TARGET DATA::
Filetype  : ISO
Target-count: 6
Targets :
-100.000000  -60.000000  -20.000000
20.000000   60.000000  100.000000
Flags: 0 0 2 0

USER-TEXT::
Machine: hexapod
Date:2024-05-06 12:34:56
Axis:X

RUNS::
Run-count: 4

DEVIATIONS::
Run Target Data:
"""

TARGETS = (-100, -60, -20, 20, 60, 100)


def rtl(runs: int = 4) -> str:
    """Return a file whose deviation is 1000·run + target number, µm; even runs come back."""
    rows = ""
    for run in range(1, runs + 1):
        order = range(1, 7) if run % 2 else range(6, 0, -1)
        rows += "".join(f"{run}   {target}      {1000 * run + target}.000\n" for target in order)
    return RTL + rows + "\nENVIRONMENT::\nAir temp   : 20.1\nAir Press  : 1013\n\nEOF::\n"


RTL_LINE = """format: hexapod_comp/line
version: 1
run: x static
axis: x
across_mm: [10, 450]
channel: linear
unit: um
"""


def write(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_rtx_header_and_samples(tmp_path: Path) -> None:
    """Truth: struct's little-endian doubles. Lines nobody knows are kept; both known endings are read."""
    samples = np.random.default_rng(0).normal(size=1001)
    for end in (b"EOF::\r\n", b"\r\nEOF::\r\n", b"\r\nEOF::"):
        path = write(tmp_path, "a.rtx", rtx(samples, end=end))
        found = read_rtx(path)
        np.testing.assert_array_equal(found.samples, samples)
        assert found.rate == RATE
        assert found.header["Date"] == "10/02/2025 12:58:22"
        assert found.header["Wholly new"] == "17"
        assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


START = len(rtx(np.zeros(10), end=b"")) - 80

BAD_RTX = {
    "truncated": (rtx(np.zeros(10), end=b"")[:-13], f"byte {START + 67}: is truncated: it ends after 8 of 10 samples"),
    "no end": (rtx(np.zeros(10), end=b""), f"byte {START + 80}: after 10 samples there must be EOF::"),
    "more than said": (rtx(np.zeros(10), count=9), f"byte {START + 71}: after 9 samples"),
    "fewer than said": (rtx(np.zeros(10), count=11), "is truncated: it ends after 10 of 11"),
    "not finite": (rtx(np.array([1.0, np.nan])), "sample 2: must be finite"),
    "other file": (b"PK\3\4 something", "byte 0: an .rtx file starts with HEADER::"),
    "no data": (b"HEADER::\r\nOwner: me\r\n", "has no line Data:"),
    "no count": (rtx(np.zeros(2)).replace(b"Sample no", b"Sample nr"), "has no line 'Sample no'"),
    "half a sample": (rtx(np.zeros(2)).replace(b"Sample no: 2", b"Sample no: 1.5"), "must be a whole number"),
    "no rate": (rtx(np.zeros(2), rate=1.0).replace(b"Actual sample rate: 1.0", b"Actual sample rate: 0"), "above zero"),
    "empty": (b"", "is empty"),
}


@pytest.mark.parametrize("case", BAD_RTX)
def test_bad_rtx(tmp_path: Path, case: str) -> None:
    content, problem = BAD_RTX[case]
    with pytest.raises(InputFileError, match=problem):
        read_rtx(write(tmp_path, "a.rtx", content))


def capture(error: Callable[[np.ndarray], np.ndarray], sense: float = 1.0) -> np.ndarray:
    """Return a capture: a second of rest, then 200 mm at constant speed with an error (mm of x), then rest."""
    time = np.arange(round(45 * RATE)) / RATE
    x = np.clip((time - 1.0) * SPEED, 0.0, 200.0)
    return sense * (7.0 + x + error(x - 100.0))


def test_a_capture_becomes_readings(tmp_path: Path) -> None:
    """20 ppm of x, zeroed at the first reading; means over 20 mm of it stand where their middle is.

    The capture's first 20 mm piece has its middle at −90 mm, half a sample's 0.05 mm short.
    """
    data = write(tmp_path, "a.rtx", rtx(capture(lambda x: 20e-6 * x)))
    found = read_carto([(data, write(tmp_path, "a.yaml", RTX_LINE))], paper_geometry())
    x = found.points()[:, 0]
    np.testing.assert_allclose(x, np.arange(-0.09, 0.1, 0.02) - 0.025e-3, atol=1e-9)
    np.testing.assert_allclose(found.value, 20e-6 * (x - x[0]), atol=1e-12)
    np.testing.assert_array_equal(found.points()[:, 1:], np.tile([0.01, 0.45], (10, 1)))
    assert (found.direction == FORWARD).all()
    assert found.files[0][0] == "a.rtx"


def test_a_capture_of_angles_and_of_the_way_back(tmp_path: Path) -> None:
    line = RTX_LINE.replace("linear", "yaw").replace("unit: mm", "unit: mrad").replace("mm_s: 5", "mm_s: -5")
    line = line.replace("start_mm: -100", "start_mm: 100") + "value_sense: -1\ncycle: 2\n"
    samples = np.where(np.arange(4500) < 2500, 0.0, 1.0)
    data = write(tmp_path, "a.rtx", rtx(samples))
    found = read_carto([(data, write(tmp_path, "a.yaml", line))], paper_geometry())
    assert {CHANNELS[c] for c in found.channel} == {"rotation_z"}
    assert (found.direction == BACKWARD).all()
    assert (found.cycle == 2).all()
    np.testing.assert_allclose(found.value, [0] * 6 + [-1e-3] * 4, atol=1e-15)


BAD_CAPTURES = {
    "other speed": (RTX_LINE.replace("speed_mm_s: 5", "speed_mm_s: 4"), "travels 1.25 times as far"),
    "other sense": (RTX_LINE + "value_sense: -1\n", "travels -1 times as far"),
    "other unit": (RTX_LINE.replace("unit: mm", "unit: um"), "travels 0.001 times as far"),
    "too long": (RTX_LINE.replace("to_s: 41", "to_s: 50"), "lasts 45.000 s"),
    "no speed": (RTX_LINE.replace("start_mm: -100\nspeed_mm_s: 5\nfrom_s: 1\nto_s: 41\nevery_mm: 20\n", ""),
                 "speed: is needed for an .rtx file"),
    "coarse": (RTX_LINE.replace("every_mm: 20", "every_mm: 150"), "every: must give 2…10000 readings"),
    "dense": (RTX_LINE.replace("every_mm: 20", "every_mm: 0.025"), "fewer than one sample per 0.025 mm"),
    "wrong unit": (RTX_LINE.replace("unit: mm", "unit: urad"), "unit: must be one of m, mm"),
    "absolute": (RTX_LINE.replace("linear", "position_x"), "channel: must be one of linear"),
    "unknown": (RTX_LINE + "colour: red\n", "colour: is not a known key"),
    "sense": (RTX_LINE + "value_sense: 2\n", "value_sense: must be 1 or -1"),
    "out of reach": (RTX_LINE.replace("[10, 450]", "[10, 4500]"), "out of the machine's reach"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_CAPTURES)
def test_captures_that_do_not_fit_their_line_are_refused(tmp_path: Path, case: str) -> None:
    line, problem = BAD_CAPTURES[case]
    data = write(tmp_path, "a.rtx", rtx(capture(np.zeros_like)))
    with pytest.raises(InputFileError, match=problem):
        read_carto([(data, write(tmp_path, "a.yaml", line))], paper_geometry())


def test_rtl_becomes_readings_with_cycles_and_directions(tmp_path: Path) -> None:
    """Runs 1 and 3 go up, 2 and 4 come down: two cycles of both directions, ready for ISO 230-2."""
    data = write(tmp_path, "a.rtl", rtl().replace("\n", "\r\n"))
    found = read_carto([(data, write(tmp_path, "a.yaml", RTL_LINE))], paper_geometry())
    run = linear_runs(found)[0]
    np.testing.assert_allclose(run.targets, np.array(TARGETS) * 1e-3, atol=1e-12)
    expected = np.array([[1000, 3000], [2000, 4000]])[..., None] + np.arange(1, 7)
    np.testing.assert_allclose(run.deviations, expected * 1e-6, rtol=1e-12)
    assert found.sources[0].line == 24
    assert "section ENVIRONMENT:: (line 49, 2 lines) was not understood" in found.notes[0]


def test_rtl_targets_against_the_machines_axis(tmp_path: Path) -> None:
    """Targets that count the other way round turn places, directions and the deviations' sign."""
    line = RTL_LINE + "target_sense: -1\ntarget_offset_mm: 5\n"
    data = write(tmp_path, "a.rtl", rtl())
    found = read_carto([(data, write(tmp_path, "a.yaml", line))], paper_geometry())
    assert found.direction[0] == BACKWARD
    np.testing.assert_allclose(found.points()[found.station[0]], [0.105, 0.01, 0.45], atol=1e-12)
    assert found.value[0] == pytest.approx(-1001e-6, rel=1e-12)


BAD_RTL = {
    "no deviations": (RTL.partition("DEVIATIONS")[0], "has no section DEVIATIONS::"),
    "truncated": (rtl()[: rtl().index("4   3")], "must have 4 runs × 6 targets = 24 deviations"),
    "count": (rtl().replace("Target-count: 6", "Target-count: 7"), "Target-count is 7, but there are .found 6"),
    "no count": (rtl().replace("Run-count: 4", "Run-count: four"), "needs Run-count: and a whole number.*four"),
    "target number": (rtl().replace("1   6 ", "1   9 "), "line 29: .*whole numbers, here up to 6 .*'9'"),
    "twice": (rtl().replace("1   6 ", "1   5 "), "line 29: run 1 has target 5 twice"),
    "no number": (rtl().replace("1003.000", "1O03"), "line 26: must be a finite number .*1O03"),
    "four columns": (rtl().replace("1003.000", "1003.000 7"), "line 26: must be run, target and deviation"),
    "mixed order": (rtl().replace("1   1 ", "1   x ").replace("1   2 ", "1   1 ").replace("1   x ", "1   2 "),
                    "line 24: the targets of run 1 must follow each other one way"),
    "section twice": (rtl() + "RUNS::\n", "section RUNS:: is there twice"),
    "no title": ("hello\n" + rtl(), "line 1: a title such as HEADER:: must come first"),
    "target twice": (rtl().replace("-60.000000", "-100.000000"), "each target may be there once"),
    "no table": (rtl().replace("Run Target Data:", "Run Data:"), "must go on with Run Target Data:"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_RTL)
def test_bad_rtl(tmp_path: Path, case: str) -> None:
    content, problem = BAD_RTL[case]
    data = write(tmp_path, "a.rtl", content)
    with pytest.raises(InputFileError, match=problem):
        read_carto([(data, write(tmp_path, "a.yaml", RTL_LINE))], paper_geometry())


def test_notes(tmp_path: Path) -> None:
    """What is odd but usable: no end mark, and runs that all go one way; old code pages are read."""
    one_way = RTL.replace("Run-count: 4", "Run-count: 2").replace("hexapod", "Fräse")
    one_way += "".join(f"{run} {target} 0.5\n" for run in (1, 2) for target in range(1, 7))
    data = write(tmp_path, "a.rtl", one_way.encode("cp1252"))
    assert read_rtl(data).entries["Machine"] == "Fräse"
    notes = read_carto([(data, write(tmp_path, "a.yaml", RTL_LINE))], paper_geometry()).notes
    assert ["no EOF::" in notes[0], "travel one way" in notes[1]] == [True, True]


def test_channels_of_one_run_join_and_the_same_pass_twice_is_refused(tmp_path: Path) -> None:
    data = write(tmp_path, "a.rtl", rtl())
    linear = write(tmp_path, "a.yaml", RTL_LINE)
    pitch = write(tmp_path, "b.yaml", RTL_LINE.replace("linear", "pitch").replace("unit: um", "unit: urad"))
    found = read_carto([(data, linear), (data, pitch)], paper_geometry())
    assert len(found.runs) == 1
    assert {CHANNELS[c] for c in found.channel} == {"linear", "rotation_y"}
    with pytest.raises(InputFileError, match=r"run x static: linear at the same place .* stands in .*line 24 too"):
        read_carto([(data, linear), (data, linear)], paper_geometry())


@given(edits=edits)
@fixed
def test_mutated_files_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, edits) -> None:
    """Never anything but a set or a HexapodError, whichever file is damaged."""
    folder = tmp_path_factory.mktemp("fuzz")
    small = rtx(capture(np.zeros_like)[::50], rate=RATE / 50).decode("latin-1")
    for content, line in ((rtl(), RTL_LINE), (small, RTX_LINE)):
        damaged = mutated(content, edits).encode("latin-1", "replace")
        for data, beside in ((damaged, line), (content.encode("latin-1"), mutated(line, edits))):
            pair = write(folder, "a", data), write(folder, "a.yaml", beside.encode("utf-8", "replace"))
            try:
                read_sections(pair[0])
                load_line(pair[1])
            except HexapodError:
                pass
            try:
                found = read_carto([pair], paper_geometry())
            except HexapodError:
                continue
            assert np.isfinite(found.value).all()
