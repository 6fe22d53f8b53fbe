"""Random imperfections within bounds: the hidden errors of a virtual machine.

Every quantity is drawn, also with a bound of zero, so that a change of one bound changes no other quantity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from ..core import MOST_HARMONICS
from ..errors import ModelError
from ..machine.field import CROSS_AXES, GridField, no_field
from ..machine.geometry import HexapodGeometry, first_of_same
from ..machine.kinematics import Structure, strut_lengths
from ..machine.model import MachineModel, ModelOrigin
from ..machine.struts import StrutErrors

FIELD_NODES = 3  # number of nodes of a drawn field along each axis
FIELD_POWERS = 4  # number of coefficients of a drawn field's polynomial along a line: cubic
# A smooth length error is a sum of MAP_WAVES sine waves; its spline has KNOTS_PER_WAVE knots per shortest wavelength
MAP_WAVES, KNOTS_PER_WAVE = 8, 15
# Its shortest and longest wavelength as fractions of the stroke, and their lower limits, m
WAVES_OF_STROKE, LEAST_WAVES = (0.1, 0.35), (0.06, 0.2)
# Wear along a screw is a bell curve, whose standard deviation is drawn between these fractions of the stroke
WORN_PART = (0.1, 0.3)
# Units of the bounds that consist of a lowest and a highest value
SPANS = {"wave": "m", "harmonics": "m", "backlash": "m", "strut_expansion": "1/K", "body_expansion": "1/K"}
# Independent random streams of one seed: a draw from one stream changes no other stream
STREAMS = {"wear": 4, "field": 5, "harmonics": 9, "length map": 10}


@dataclass(frozen=True)
class ImperfectionBounds:
    """Bounds of uniformly distributed imperfections; the defaults are those of Song et al.'s assessment."""

    joint: float = 10e-6  # every joint coordinate, m (±)
    strut_offset: float = 10e-6  # length offset of every strut, m (±)
    pitch: float = 0.0  # relative pitch error of every screw, m per m of length from home (±)
    # lowest and highest amplitude of the periodic screw error, m, whose phase is drawn from a full turn
    wave: tuple[float, float] = (0.0, 0.0)
    wave_period: float = 0.01  # of the periodic screw error, m: the screw's lead
    backlash: tuple[float, float] = (0.0, 0.0)  # lowest and highest backlash of a strut, m
    # largest displacement component, m, and rotation component, rad, of a smooth error field within its box
    field_displacement: float = 0.0
    field_rotation: float = 0.0
    field_reversal: float = 0.1  # share of the field that depends on the direction of motion, 0…1
    # (2, 3): lowest and highest corner of the field's box, m in ``base``; None: no field
    field_box: np.ndarray | None = None
    # RMS over the stroke of every strut's smooth length error, m
    length_map: float = 0.0
    # lowest and highest thermal expansion of a strut, and of base and platform, 1/K
    strut_expansion: tuple[float, float] = (0.0, 0.0)
    body_expansion: tuple[float, float] = (0.0, 0.0)
    # True: nominally coincident platform joints are one ball joint with one deviation. False: each strut has its own.
    shared_platform_joints: bool = True
    # lowest and highest amplitude of each of the second to fourth harmonics of the periodic screw error, m
    harmonics: tuple[float, float] = (0.0, 0.0)
    wear: float = 0.0  # largest additional backlash, m, where a strut's screw is worn most

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name in SPANS:
                low, high = value
                if not 0.0 <= low <= high < math.inf:
                    problem = f"must be two numbers, 0 ≤ lowest ≤ highest, {SPANS[entry.name]}"
                    raise ModelError(f"bounds.{entry.name}", problem, value)
            elif entry.name not in ("field_box", "shared_platform_joints") and not 0.0 <= value < math.inf:
                raise ModelError(f"bounds.{entry.name}", "must be finite and not negative", value)
        if self.wave_period <= 0.0:
            raise ModelError("bounds.wave_period", "must be above zero, m", self.wave_period)
        if self.field_reversal > 1.0:
            raise ModelError("bounds.field_reversal", "must be at most 1", self.field_reversal)
        if self.field_displacement or self.field_rotation:
            box = np.array(self.field_box if self.field_box is not None else np.nan, dtype=float)
            if box.shape != (2, 3) or not np.isfinite(box).all() or (box[1] <= box[0]).any():
                problem = "must be two finite corners, the lower first, m, if a field is drawn"
                raise ModelError("bounds.field_box", problem, self.field_box)


def draw_model(geometry: HexapodGeometry, bounds: ImperfectionBounds, seed: int, name: str = "") -> MachineModel:
    rng = seeded(seed)
    base = bounds.joint * rng.uniform(-1.0, 1.0, (6, 3))
    platform = bounds.joint * rng.uniform(-1.0, 1.0, (6, 3))
    if bounds.shared_platform_joints:
        platform = platform[first_of_same(geometry.platform_joints)]
    struts, field = _draw_struts(geometry, bounds, rng), _draw_field(bounds, rng)
    if any(bounds.harmonics):
        own, shape = seeded(seed, "harmonics"), (6, MOST_HARMONICS - 1)
        amplitude, phase = own.uniform(*bounds.harmonics, shape), own.uniform(0.0, 2.0 * np.pi, shape)
        cosine = np.hstack([struts.cosine, amplitude * np.cos(phase)])
        struts = replace(struts, cosine=cosine, sine=np.hstack([struts.sine, amplitude * np.sin(phase)]))
    expansion, bodies = rng.uniform(*bounds.strut_expansion, 6), rng.uniform(*bounds.body_expansion, 2)
    model = MachineModel(
        machine=geometry.name,
        name=name or f"virtual-{seed}",
        base_deviation=base,
        platform_deviation=platform,
        struts=replace(struts, expansion=expansion),
        field=field,
        base_expansion=float(bodies[0]),
        platform_expansion=float(bodies[1]),
        origin=ModelOrigin(note=f"virtual machine drawn with seed {seed}"),
    )
    if bounds.length_map:
        stroke = float(np.ptp(geometry.limits.stroke))
        shortest, longest = np.maximum(np.multiply(WAVES_OF_STROKE, stroke), LEAST_WAVES).tolist()
        model = with_length_map(model, geometry, seed, bounds.length_map, (shortest, longest))
    return with_wear(model, geometry, seed, bounds.wear) if bounds.wear else model


def with_length_map(
    model: MachineModel,
    geometry: HexapodGeometry,
    seed: int,
    rms: float = 5e-6,
    waves: tuple[float, float] = (0.06, 0.2),
) -> MachineModel:
    """Add a smooth length error to each strut: random sine waves of RMS `rms`, m, and wavelengths within `waves`, m."""
    rng = seeded(seed, "length map")
    knots = _knots(geometry, waves[0])
    lengths, phases = rng.uniform(*waves, (6, MAP_WAVES)), rng.uniform(0.0, 2.0 * np.pi, (6, MAP_WAVES))
    sizes = rng.standard_normal((6, MAP_WAVES))
    values = np.einsum("sw,swk->sk", sizes, np.sin(2.0 * np.pi * knots / lengths[..., None] + phases[..., None]))
    values *= rms / np.sqrt((values**2).mean(axis=1, keepdims=True))
    struts = replace(model.struts, map_knots=knots, map_values=values, map_backlash=np.zeros((6, 0)))
    return replace(model, struts=struts)


def with_wear(model: MachineModel, geometry: HexapodGeometry, seed: int, most: float = 5e-6) -> MachineModel:
    """Add wear: at one place of each screw the backlash grows by up to `most`, m."""
    rng, shortest = seeded(seed, "wear"), geometry.limits.stroke[:, :1]
    stroke = geometry.limits.stroke[:, 1:] - shortest
    struts = model.struts
    if not len(struts.map_knots):
        knots = _knots(geometry, LEAST_WAVES[0])
        struts = replace(struts, map_knots=knots, map_values=np.zeros((6, len(knots))))
    middles = shortest + stroke * rng.uniform(0.3, 0.7, (6, 1))
    widths = stroke * rng.uniform(*WORN_PART, (6, 1))
    sizes = most * rng.uniform(0.5, 1.0, (6, 1))
    wear = sizes * np.exp(-0.5 * ((struts.map_knots - middles) / widths) ** 2)
    return replace(model, struts=replace(struts, map_backlash=wear))


def _knots(geometry: HexapodGeometry, shortest: float) -> np.ndarray:
    """Return equally spaced spline knots, m, over all strokes, KNOTS_PER_WAVE in a wavelength of `shortest`, m."""
    low, high = geometry.limits.stroke[:, 0].min(), geometry.limits.stroke[:, 1].max()
    return np.linspace(low, high, int(np.ceil((high - low) / shortest * KNOTS_PER_WAVE)) + 1)


def seeded(seed: int, stream: str = "") -> np.random.Generator:
    """Return a random generator for `seed`; each key of :data:`STREAMS` gives another, independent generator."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ModelError("seed", "must be a whole number, 0 or above", seed)
    return np.random.default_rng([int(seed), STREAMS[stream]] if stream else int(seed))


def _draw_struts(geometry: HexapodGeometry, bounds: ImperfectionBounds, rng: np.random.Generator) -> StrutErrors:
    offset, pitch = rng.uniform(-1.0, 1.0, (2, 6))
    amplitude = rng.uniform(*bounds.wave, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    return StrutErrors(
        offset=bounds.strut_offset * offset,
        pitch=bounds.pitch * pitch,
        reference_length=strut_lengths(Structure.of(geometry), geometry.home),
        cosine=amplitude * np.cos(phase),
        sine=amplitude * np.sin(phase),
        period=np.full(6, bounds.wave_period),
        backlash=rng.uniform(*bounds.backlash, 6),
    )


def _draw_field(bounds: ImperfectionBounds, rng: np.random.Generator) -> GridField:
    """Draw a field: cubic polynomials along the grid lines, whose coefficients vary bilinearly between the lines."""
    common = _draw_lines(rng, 1)
    difference = _draw_lines(rng, 2)
    if not (bounds.field_displacement or bounds.field_rotation):
        return no_field()
    box = np.array(bounds.field_box, dtype=float)
    x, y, z = (np.linspace(box[0, axis], box[1, axis], FIELD_NODES) for axis in range(3))
    lines = [
        (1.0 - bounds.field_reversal) * whole + bounds.field_reversal * part
        for whole, part in zip(common, difference, strict=True)
    ]
    raw = GridField((x, y, z), (lines[0], lines[1], lines[2]))
    wanted = np.repeat([bounds.field_displacement, bounds.field_rotation], 3)
    scale = (wanted / largest_errors(raw))[:, None]
    return replace(raw, lines=tuple(family * scale for family in raw.lines))


def _draw_lines(rng: np.random.Generator, directions: int) -> list[np.ndarray]:
    """Return random polynomial coefficients of the grid lines along x, y and z, not scaled to the bounds yet."""
    across = np.linspace(-1.0, 1.0, FIELD_NODES)
    terms = np.array([[(1.0, s, t, s * t) for t in across] for s in across])
    weights = rng.uniform(-1.0, 1.0, (len(CROSS_AXES), directions, 4, 6, FIELD_POWERS))
    return [np.einsum("nmk,dkcp->dnmcp", terms, family) for family in weights]


def largest_errors(grid_field: GridField) -> np.ndarray:
    """Return the largest magnitude of each error component, (6,), m and rad, in a field's box, for both directions."""
    samples = [np.linspace(nodes[0], nodes[-1], 9) for nodes in grid_field.grid]
    points = np.stack(np.meshgrid(*samples), axis=-1).reshape(-1, 3)
    values = [grid_field.evaluate(point, np.full(3, direction))[0] for point in points for direction in (1.0, -1.0)]
    return np.abs(values).max(axis=0)
