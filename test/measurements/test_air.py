"""Refractive index of air against published values and another equation; correction of readings in fringes.

Papers print the index as (n − 1)·10⁸, to a tenth.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import fixed

from hexapod_comp.measurements.air import VACUUM_WAVELENGTH, Air, ciddor_index, correct_displacement


@pytest.mark.parametrize(
    ("temperature", "pressure", "humidity", "wavelength_nm", "printed", "tolerance"),
    [
        # Ciddor 1996, Table 1 (dry) and Table 3 (633 nm, 450 ppm CO₂), to half of the printed digit
        (20, 80e3, 0.0, 633, 21458.0, 0.05),
        (10, 100e3, 0.0, 633, 27774.7, 0.05),
        (20, 80e3, 0.75, 633, 21394.0, 0.05),
        (40, 120e3, 0.75, 633, 29941.8, 0.05),
        (50, 120e3, 1.0, 633, 28792.4, 0.05),
        # NIST's Engineering Metrology Toolbox, printed to 0.1; its saturation pressure (IAPWS) is another formula
        (5, 100e3, 0.0, 633, 28275.6, 0.1),
        (40, 110e3, 1.0, 1700, 27024.7, 0.1),
        (20, 101_325, 0.0, 300, 28658.1, 0.1),
    ],
)
def test_air_as_printed(
    temperature: float, pressure: float, humidity: float, wavelength_nm: float, printed: float, tolerance: float
) -> None:
    index = ciddor_index(Air(temperature, pressure, humidity), wavelength_nm * 1e-9)
    assert 1e8 * (index - 1.0) == pytest.approx(printed, abs=tolerance)


def test_carbon_dioxide_raises_the_index() -> None:
    """Ciddor, 1996: relative to 450 ppm by 0.534·10⁻⁶ a ppm of 27 000·10⁻⁸, which is 1.4·10⁻⁸ for 100 ppm."""
    usual, more = (ciddor_index(Air(20.0, 101_325.0, 0.0), co2_ppm=ppm) for ppm in (450.0, 550.0))
    assert more - usual == pytest.approx(1.4e-8, abs=0.1e-8)


workshop_air = st.builds(Air, st.floats(10.0, 35.0), st.floats(80e3, 120e3), st.floats(0.0, 1.0))


# Readings of a fringe counter, computed here from optics, must be corrected to the true displacement


@fixed
@given(
    way=st.floats(-0.5, 0.5),
    assumed=st.sampled_from([1.0, 1.000271]),
    now=workshop_air,
    sense=st.sampled_from([1.0, -1.0]),
)
def test_counted_fringes_give_the_way_back(way: float, assumed: float, now: Air, sense: float) -> None:
    """The counter shows fringes in a path of L times its assumed wavelength.

    Towards the interferometer (sense −1) it counts backwards, and its display is reversed. Tolerance: rounding of a
    metre.
    """
    half_wave = VACUUM_WAVELENGTH / 2.0
    fringes = ciddor_index(now) * sense * way / half_wave
    shown = sense * fringes * half_wave / assumed
    corrected = correct_displacement(shown, now, assumed)
    assert corrected == pytest.approx(way, abs=3e-15)
