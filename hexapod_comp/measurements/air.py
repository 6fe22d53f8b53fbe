"""Refractive index of air by Ciddor's equation, and the correction of laser readings for the air."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

Values: TypeAlias = "float | np.ndarray"  # one number for all readings, or one number per reading

# Vacuum wavelength of helium-neon lasers, m: two lasers differ by 0.1 pm, which changes the index by 1·10⁻¹²
VACUUM_WAVELENGTH = 632.9908e-9
USUAL_CO2_PPM = 450.0  # CO₂ in the air of a workshop, ppm; 100 ppm more raise the index by 1.5·10⁻⁸
ZERO_CELSIUS = 273.15  # K
# Ranges in which Ciddor's equation is valid for air without ice: lowest value, highest value, and the range as text
AIR_RANGES = {
    "temperature": (0.0, 60.0, "0…60 °C"),
    "pressure": (50e3, 120e3, "50…120 kPa"),
}

LARGEST_INDEX = 1.001  # largest index accepted from a file; air within :data:`AIR_RANGES` stays below 1.0004


class Air(NamedTuple):
    """State of the air along a laser's beam, within :data:`AIR_RANGES`; an array has one entry per reading."""

    temperature: Values  # °C
    pressure: Values  # pressure at the machine, not reduced to sea level, Pa
    humidity: Values  # relative humidity, as a fraction 0…1


def ciddor_index(air: Air, vacuum_wavelength: float = VACUUM_WAVELENGTH, co2_ppm: float = USUAL_CO2_PPM) -> np.ndarray:
    """Return the phase refractive index of air by Ciddor's equation; `vacuum_wavelength` in m."""
    vapour = _vapour_fraction(air)
    density = _molar_density(air.pressure, air.temperature, vapour)
    of_dry_air = density * (1.0 - vapour) / _molar_density(101_325.0, 15.0, 0.0)
    of_vapour = density * vapour / _molar_density(1333.0, 20.0, 1.0)
    wavenumber_squared = (1e-6 / vacuum_wavelength) ** 2
    dry_refractivity = _dry_air_refractivity(wavenumber_squared, co2_ppm)
    vapour_refractivity = _vapour_refractivity(wavenumber_squared)
    return np.asarray(1.0 + of_dry_air * dry_refractivity + of_vapour * vapour_refractivity)


def _dry_air_refractivity(wavenumber_squared: float, co2_ppm: float) -> float:
    """Return n − 1 of dry air at 15 °C and 101 325 Pa; `wavenumber_squared` in 1/µm² (Ciddor, eqs. 1 and 2)."""
    of_450_ppm = 5_792_105.0 / (238.0185 - wavenumber_squared) + 167_917.0 / (57.362 - wavenumber_squared)
    return 1e-8 * of_450_ppm * (1.0 + 0.534e-6 * (co2_ppm - 450.0))


def _vapour_refractivity(wavenumber_squared: float) -> float:
    """Return n − 1 of water vapour at 20 °C and 1333 Pa; `wavenumber_squared` in 1/µm² (Ciddor, eq. 3)."""
    return 1.022e-8 * float(np.polyval([0.004028, -0.032380, 2.6422, 295.235], wavenumber_squared))


def _vapour_fraction(air: Air) -> Values:
    """Return the mole fraction of water vapour (Ciddor, appendix A)."""
    kelvin = air.temperature + ZERO_CELSIUS
    saturation = np.exp(1.2378847e-5 * kelvin**2 - 1.9121316e-2 * kelvin + 33.93711047 - 6343.1645 / kelvin)
    enhancement = 1.00062 + 3.14e-8 * air.pressure + 5.6e-7 * air.temperature**2
    return enhancement * air.humidity * saturation / air.pressure


def _molar_density(pressure: Values, temperature: Values, vapour: Values) -> Values:
    """Return p/(Z·T), Pa/K, which is the molar density times the gas constant (Ciddor, eq. 4 and appendix A)."""
    t, ratio = temperature, pressure / (temperature + ZERO_CELSIUS)
    first = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t**2
    first = first + (5.707e-6 - 2.051e-8 * t) * vapour + (1.9898e-4 - 2.376e-6 * t) * vapour**2
    compressibility = 1.0 - ratio * first + ratio**2 * (1.83e-11 - 0.765e-8 * vapour**2)
    return ratio / compressibility


def correct_displacement(raw: Values, air: Air, assumed_index: Values = 1.0) -> np.ndarray:
    """Correct interferometer readings `raw`, for which the instrument assumed the refractive index `assumed_index`."""
    return np.asarray(raw) * (assumed_index / ciddor_index(air))
