"""Refractive index of air against published check values and another equation; readings corrected by counting fringes.

In the tables of papers the index is written as (n − 1)·10⁸, printed to a tenth.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import fixed

from hexapod_comp.measurements.air import VACUUM_WAVELENGTH, Air, ciddor_index, correct_displacement

AT_633 = 633e-9  # The wavelength of the papers' tables, m

PRINTED = 0.05  # Half a unit of the last digit of (n − 1)·10⁸ in Ciddor's tables


def refractivity(air: Air, wavelength: float = AT_633, co2_ppm: float = 450.0) -> np.ndarray:
    return 1e8 * (ciddor_index(air, wavelength, co2_ppm) - 1.0)


@pytest.mark.parametrize(
    ("temperature", "pressure_kpa", "humidity", "printed"),
    [
        (20, 80, 0.0, 21458.0),
        (10, 100, 0.0, 27774.7),
        (30, 100, 0.0, 25937.2),
        (20, 80, 0.75, 21394.0),
        (20, 120, 0.75, 32127.8),
        (40, 80, 0.75, 19896.5),  # printed 19996.5; the table's own column of differences gives 19896.5
        (40, 120, 0.75, 29941.8),
        (50, 120, 1.0, 28792.4),
    ],
)
def test_air_as_printed(temperature: float, pressure_kpa: float, humidity: float, printed: float) -> None:
    """Truth: Ciddor 1996, Table 1 (dry) and Table 3 (633 nm, 450 ppm CO₂), to the printed digit."""
    assert refractivity(Air(temperature, pressure_kpa * 1e3, humidity)) == pytest.approx(printed, abs=PRINTED)


@pytest.mark.parametrize(
    ("temperature", "pressure", "humidity", "wavelength_nm", "printed"),
    [
        (20, 60_000, 0.0, 633, 1.000160924),
        (5, 100_000, 0.0, 633, 1.000282756),
        (50, 120_000, 1.0, 633, 1.000287924),
        (40, 110_000, 1.0, 1700, 1.000270247),
        (20, 101_325, 0.0, 300, 1.000286581),
    ],
)
def test_nist_check_values(
    temperature: float, pressure: float, humidity: float, wavelength_nm: float, printed: float
) -> None:
    """Truth: values of NIST's Engineering Metrology Toolbox (Ciddor equation, 450 ppm CO₂), printed to 10⁻⁹.

    The toolbox takes another formula for saturation pressure (IAPWS), within 0.05 % of Ciddor's.
    """
    index = ciddor_index(Air(temperature, pressure, humidity), wavelength_nm * 1e-9)
    assert index == pytest.approx(printed, abs=1e-9)


workshop_air = st.builds(Air, st.floats(10.0, 35.0), st.floats(80e3, 120e3), st.floats(0.0, 1.0))


# Readings: what a counter of fringes would show, made here from the optics, must come back as the true way.


@fixed
@given(
    way=st.floats(-0.5, 0.5),
    assumed=st.sampled_from([1.0, 1.000271]),
    now=workshop_air,
    sense=st.sampled_from([1.0, -1.0]),
)
def test_counted_fringes_give_the_way_back(way: float, assumed: float, now: Air, sense: float) -> None:
    """Truth: fringes in a path of L, times the wavelength that it assumes.

    Towards the interferometer (sense −1) the counter runs backwards, and is shown reversed.
    Tolerance: rounding of a metre.
    """
    half_wave = VACUUM_WAVELENGTH / 2.0
    fringes = ciddor_index(now) * sense * way / half_wave
    shown = sense * fringes * half_wave / assumed
    corrected = correct_displacement(shown, now, assumed)
    assert corrected == pytest.approx(way, abs=3e-15)
