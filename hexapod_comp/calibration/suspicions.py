"""Another reading of the data: a sign, a unit, an axis, a direction or a machine that would explain readings better.

Each is tried with a plain model, structure and screws, to which it either fits or not; a length map or a field
could describe nearly any readings. Check readings are tried with the model that they check.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product

import numpy as np

from ..errors import HexapodError
from ..formats.paths import config_file
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.model import MachineModel
from ..machine.passes import Passes
from ..measurements.reach import GEOMETRIES, exchanged
from ..measurements.readings import ANGULAR_KINDS, AXES, CHANNELS, KINDS, LINE_KINDS, MeasurementSet, Stations
from ..virtual.instruments import compensated
from .blocks import WAVES
from .estimator import Estimation, LinearProblem, Posterior, physical_covariance, solve
from .misfit import FAMILIES, family_of_run
from .parameters import FitSettings, ParameterSpace
from .sensitivity import Prediction, predict

PLAIN = ("pitch", *WAVES, "backlash")
"""Blocks beside the structure: of the struts alone, and enough to tell one reading of the data from another."""

BETTER, SURELY, HALF = 3.0, 1.2, 0.5
"""Another reading is named when some kind of channel fits so many times better, all together so many times, and none
less well than so many times."""

RIGHTLY = 1.05
"""What leaves nothing to choose, no unit and no set of runs, is named too where all together fit so many times better:
readings that were taken rightly fit no better in any such way, whatever else is wrong with them."""

SCATTERED, AS_STATED, ODDS = 1.5, 1.15, 25.0
"""Causes are sought where a fit leaves so many times what is stated, or a plain model so many times what the fit does.
What brings all that it changes down to so many times their stated noise, and makes none worse, is named too: nothing
but the truth does that. Log odds of this and of the above are above the last."""

AS_GOOD = 1.05
"""Others that fit all together as well, to this factor, are named too."""

ENOUGH = 1500
"""So many readings, at random, tell."""

UNITS = {
    "length": (("µinch", 0.0254), ("0.1 µm", 0.1), ("0.01 mm", 10.0), ("mm", 1e3), ("nm", 1e-3)),
    "angle": (("arcsec", np.pi / 0.648), ("mrad", 1e3), ("mdeg", np.pi / 0.18)),
}
"""Units in which readings may stand that are said to be µm or µrad."""

SURE = 4.0
"""Backlash so many standard deviations below zero is no noise."""

SWAPPED = "forward and backward look swapped, or the sign of all readings reversed"

STRANGE, PLAUSIBLE = 100.0, 10.0
"""χ² per number above which check readings may have been taken for something else, and that of what they then are: of
ten and of three times the noise to expect."""

FAINT = 1e3
"""Factor on the uncertainty of readings that a fit is not to see."""

ROUNDS = 3
"""Rounds in which each run's sign is looked at with the others' as they are."""


@dataclass(frozen=True)
class Reinterpretation:
    """Readings read differently.

    Attributes
    ----------
    name : str
        As "x lines, linear: sign reversed".
    measurements : MeasurementSet
        As they would then be.
    scale : ndarray, shape (kinds,)
        By what the values of each kind were multiplied.
    chosen : bool
        A fit has chosen what was changed.
    """

    name: str
    measurements: MeasurementSet
    scale: np.ndarray
    chosen: bool = False


def suspicions(
    measurements: MeasurementSet,
    settings: FitSettings,
    progress: Callable[[str], object] = lambda text: None,
    left: Mapping[int, float] | None = None,
) -> list[str]:
    """Return by name what would explain the readings far better than taking them as they are; the best, or none.

    Parameters
    ----------
    measurements : MeasurementSet
        As they are.
    settings : FitSettings
        Of their fit.
    progress : callable
        Called with what is tried.
    left : mapping of int to float, optional
        Standard deviation that a fit beyond doubt leaves of each kind, m or rad. Where that is as stated, and a plain
        model leaves little more, nothing could be far better, and nothing is tried.
    """
    measurements, plain = _thinned(measurements), _Plain(settings)
    present = np.unique(measurements.kind)
    stated = np.array([measurements.stated_of(k) for k in present])
    as_they_are = plain.noise(Reinterpretation("", measurements, np.ones(len(KINDS))))
    if as_they_are is None:
        return []
    if left is not None:
        by_fit = np.array([left[k] for k in present])
        if (by_fit < SCATTERED * stated).all() and (as_they_are[present] < SCATTERED * by_fit).all():
            return []
    shares = np.bincount(measurements.kind)[present] / len(measurements)
    clear = []
    for other in _others(measurements, plain):
        progress(f"trying {other.name}")
        noise = plain.noise(other)
        if noise is None:
            continue
        gains = as_they_are[present] / noise[present]
        total = float(np.exp(shares @ np.log(gains)))
        if _convinces(other, gains, total, noise[present] < AS_STATED * stated, len(measurements)):
            clear.append((total, float(gains.max()), other.name))
    clear.sort(reverse=True)
    return [f"{name} fits {best:.3g} times better" for total, best, name in clear if total > clear[0][0] / AS_GOOD]


def _convinces(other: Reinterpretation, gains: np.ndarray, total: float, as_stated: np.ndarray, count: int) -> bool:
    """Return whether another reading of `count` readings is the right one.

    By how many times better it fits, each kind that there is and all together, and which kinds then scatter as stated.
    """
    if total > SURELY and gains.max() > BETTER and gains.min() > HALF:
        return True
    changed = gains > SURELY
    restored = changed.any() and as_stated[changed].all() and (gains > 1.0 / AS_GOOD).all()
    rightly = total > RIGHTLY and not other.chosen and (other.scale == 1.0).all()
    return bool((restored or rightly) and count * np.log(total) > ODDS)


def misread(
    m: MeasurementSet, model: MachineModel, as_they_are: float, chi_square: Callable[[MeasurementSet], float]
) -> list[str]:
    """Return by name how check readings must be taken to be those of a machine that has not changed; the best, or none.

    Parameters
    ----------
    m : MeasurementSet
        The readings as they are.
    model : MachineModel
        The model that they check.
    as_they_are : float
        Their χ² per number.
    chi_square : callable
        Returns χ² per number of readings against the model and what its fit knows.
    """
    if as_they_are < STRANGE:
        return []
    clear = []
    for name, tried in _check_otherwise(m, model):
        try:
            value = chi_square(tried())
        except HexapodError:  # out of reach that way
            continue
        if value < PLAUSIBLE:
            clear.append((value, name))
    best = min(clear, default=(0.0, ""))[0]
    times = [(value, f"{name} fits {np.sqrt(as_they_are / value):.3g} times better") for value, name in sorted(clear)]
    return [text for value, text in times if value <= BETTER * best]


def _check_otherwise(m: MeasurementSet, model: MachineModel) -> Iterator[tuple[str, Callable[[], MeasurementSet]]]:
    """Yield other ways to take check readings."""
    if np.allclose(m.stations.commands, _nominal(m.geometry, m), rtol=0.0, atol=1e-9):
        yield "taken with this model running (--compensated)", lambda: compensated(m, model)
        for a, b in combinations(range(3), 2):
            yield f"{AXES[a]} and {AXES[b]}: exchanged", partial(_exchanged_axes, m, a, b)
    else:
        off = replace(m, stations=replace(m.stations, commands=_nominal(m.geometry, m)))
        yield "taken with the compensation off", lambda: off
    yield "all readings: sign reversed", lambda: m.with_values(-m.value)
    parts = (_multiplied(m, f"{name}: sign reversed", members, -1.0) for name, members in _parts(m))
    for other in (*parts, *_in_other_units(m), *_exchanged_channels(m)):
        yield other.name, partial(_measured, other)


def _measured(other: Reinterpretation) -> MeasurementSet:
    return other.measurements


def causes(
    measurements: MeasurementSet, settings: FitSettings, progress: Callable[[str], object] = lambda text: None
) -> list[str]:
    """Return by name what may be why no machine could be fitted: as :func:`suspicions`, and a backlash below zero.

    Which way is forward, and the sign of everything, only backlash tells: no nut leads its screw.
    """
    backlash, deviation = _Plain(settings).backlash(_thinned(measurements))
    swapped = (backlash < -SURE * deviation).sum() > len(backlash) // 2
    return [*suspicions(measurements, settings, progress), *([SWAPPED] if swapped else [])]


def _thinned(m: MeasurementSet) -> MeasurementSet:
    """Return so many readings, drawn at random, that they tell."""
    if len(m) <= ENOUGH:
        return m
    chosen = np.zeros(len(m), dtype=bool)
    chosen[np.random.default_rng(0).choice(len(m), ENOUGH, replace=False)] = True
    return m.select(chosen)


_Fitted = tuple[Estimation, LinearProblem, Posterior] | None


class _Plain:
    """Plain fits; the nominal machine is sent once where readings of the same stations are read differently."""

    def __init__(self, settings: FitSettings) -> None:
        self._settings = replace(settings, blocks=PLAIN)
        self._sent: dict[int, tuple[Stations, Prediction]] = {}
        self._last: tuple[MeasurementSet, _Fitted] | None = None

    def _fitted(self, m: MeasurementSet) -> _Fitted:
        """Return readings, their problem at the nominal machine and its solution; None where it cannot be."""
        if self._last is None or self._last[0] is not m:
            self._last = m, self._fit(m)
        return self._last[1]

    def _fit(self, m: MeasurementSet) -> _Fitted:
        """Return the same, fitted anew."""
        try:
            space = ParameterSpace(m, self._settings)
            estimation, x = Estimation(m, space, alone=False), np.zeros(space.size)
            if id(m.stations) not in self._sent:
                self._sent[id(m.stations)] = m.stations, predict(space, x, m.stations)
            problem, _ = estimation.linearise(x, np.ones(len(m)), self._sent[id(m.stations)][1])
            return estimation, problem, solve(space, problem, space.start_tolerances(), np.ones(len(KINDS)))
        except (HexapodError, np.linalg.LinAlgError):
            return None

    def noise(self, tried: Reinterpretation) -> np.ndarray | None:
        """Return what a plain model leaves of each kind, (kinds,), in the values' own scale; None if it cannot be."""
        fitted = self._fitted(tried.measurements)
        if fitted is None:
            return None
        stated = np.array([tried.measurements.stated_of(k) for k in range(len(KINDS))])
        return fitted[-1].noise * stated / tried.scale

    def backlash(self, m: MeasurementSet) -> tuple[np.ndarray, np.ndarray]:
        """Return the struts' backlash and its standard deviation, (6,) each, m; (0,) where it cannot be."""
        fitted = self._fitted(m)
        if fitted is None or (block := fitted[0].space.block("backlash")) is None:
            return np.zeros(0), np.zeros(0)
        space, posterior = fitted[0].space, fitted[-1]
        deviation = np.sqrt(np.diag(physical_covariance(space, posterior))[block.part])
        return space.physical(posterior.y)[block.part], deviation

    def unlike(self, m: MeasurementSet, members: np.ndarray, blind: bool = False) -> np.ndarray:
        """Return in which runs members (N,) are rather the opposite of what a plain fit says, shape (runs,).

        The fit is to all readings; a blind one to all but members, with the noise and the tolerances of the other.
        """
        fitted = self._fitted(m)
        if fitted is None:
            return np.zeros(len(m.runs), dtype=bool)
        estimation, problem, posterior = fitted
        if blind:
            space, stated = estimation.space, np.where(members, FAINT * m.stated, m.stated)
            estimation = Estimation(replace(m, uncertainty=stated), space, alone=False)
            problem, _ = estimation.linearise(np.zeros(space.size), np.ones(len(m)), self._sent[id(m.stations)][1])
            posterior = solve(space, problem, posterior.tolerances, posterior.noise, rounds=0)
        cells, weights = estimation.cells, estimation.uncertainty**-2
        values = np.bincount(cells.of_reading, weights * m.value) / np.bincount(cells.of_reading, weights)
        values = members[cells.first] * estimation.free_of_nuisance(values[:, None])[:, 0]
        # A nominal machine whose screws turn errs too: what is fitted is not all that should have been read.
        expected = values - (problem.target - problem.rows.times(posterior.y))
        return np.bincount(m.run[cells.first], values * expected, len(m.runs)) < 0.0


def _others(m: MeasurementSet, plain: _Plain) -> Iterator[Reinterpretation]:
    """Yield other readings of the same data."""
    for name, members in _parts(m):
        yield _multiplied(m, f"{name}: sign reversed", members, -1.0)
    yield from _in_other_units(m)
    yield from _exchanged_channels(m)
    as_it_is = np.ones(len(KINDS))
    swapped = replace(m, direction=-m.direction, stations=replace(m.stations, sense=-m.stations.sense))
    yield Reinterpretation("forward and backward: swapped", swapped, as_it_is)
    yield from _reversed_runs(m, plain)
    if np.allclose(m.stations.commands, _nominal(m.geometry, m), rtol=0.0, atol=1e-9):
        for a, b in combinations(range(3), 2):
            yield Reinterpretation(f"{AXES[a]} and {AXES[b]}: exchanged", _exchanged_axes(m, a, b), as_it_is)
        for name in GEOMETRIES:
            geometry = load_geometry(config_file(name))
            if geometry.name != m.geometry.name:
                yield Reinterpretation(f"the geometry of {geometry.name}", _elsewhere(m, geometry), as_it_is)


def _parts(m: MeasurementSet) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and mask of parts whose sign somebody may have reversed: families, their kinds, and channels."""
    family = family_of_run(m)[m.run]
    for number, name in enumerate(FAMILIES):
        members = family == number
        kinds = np.unique(m.kind[members])
        if members.any() and not members.all():
            yield name, members
        if len(kinds) > 1:
            for k in kinds:
                yield f"{name}, {KINDS[k]}", members & (m.kind == k)
    for channel in np.unique(m.channel):
        members = m.channel == channel
        if not members.all():
            yield CHANNELS[channel], members
        for number in np.unique(family[members]):
            if KINDS[m.kind[members][0]] != "linear":
                yield f"{FAMILIES[number]}, {CHANNELS[channel]}", members & (family == number)


def _multiplied(m: MeasurementSet, name: str, members: np.ndarray, factor: float) -> Reinterpretation:
    scale = np.ones(len(KINDS))
    if factor > 0.0:
        scale[np.unique(m.kind[members])] = factor
    return Reinterpretation(name, m.with_values(np.where(members, factor * m.value, m.value)), scale)


def _in_other_units(m: MeasurementSet) -> Iterator[Reinterpretation]:
    """Yield each kind of channel in each other unit, those of lines together, and all lengths or angles."""
    present = np.unique(m.kind)
    angular = np.array([KINDS[k] in ANGULAR_KINDS for k in present])
    for which, meant, kinds in (("length", "µm", present[~angular]), ("angle", "µrad", present[angular])):
        together = [(f"all {which}s", kinds)] if len(kinds) > 1 else []
        of_lines = [k for k in kinds if KINDS[k] in LINE_KINDS]
        if 1 < len(of_lines) < len(kinds):
            together.append((" and ".join(KINDS[k] for k in of_lines), np.array(of_lines)))
        for (name, members), (unit, factor) in product([*together, *((KINDS[k], k) for k in kinds)], UNITS[which]):
            yield _multiplied(m, f"{name}: {unit} in place of {meant}", np.isin(m.kind, members), factor)


def _exchanged_channels(m: MeasurementSet) -> Iterator[Reinterpretation]:
    """Yield two channels of a kind exchanged, everywhere and in one family of runs."""
    family, present = family_of_run(m)[m.run], np.unique(m.channel)
    for a, b in combinations(present, 2):
        if CHANNELS[a].partition("_")[0] != CHANNELS[b].partition("_")[0]:
            continue
        both = (m.channel == a) | (m.channel == b)
        common = [n for n in np.unique(family[both]) if {a, b} <= set(m.channel[family == n].tolist())]
        for name, where in [("", both), *((f"{FAMILIES[n]}, ", both & (family == n)) for n in common)]:
            channel = np.where(where, a + b - m.channel, m.channel)
            if where is both and CHANNELS[a].startswith("straightness") and (family[both] < 3).any():
                continue  # along its own line it is none
            title = f"{name}{CHANNELS[a]} and {CHANNELS[b]}: exchanged"
            yield Reinterpretation(title, replace(m, channel=channel), np.ones(len(KINDS)))


def _reversed_runs(m: MeasurementSet, plain: _Plain) -> Iterator[Reinterpretation]:
    """Yield sets with the signs of some runs reversed, of all channels or of one, where runs of a family differ."""
    family, slopes = family_of_run(m), _slopes(m)
    present, everything = np.unique(family), np.ones(len(m), dtype=bool)
    for ways in product((1.0, -1.0), repeat=len(present)):
        way = dict(zip(present.tolist(), ways, strict=True))
        signs = np.where(slopes < 0.0, -1.0, 1.0) * [way[n] for n in family.tolist()]
        yield from _with_signs("", m, everything, signs, plain)
    channels = np.unique(m.channel)
    for channel in channels if len(channels) > 1 else ():  # the others tell what one should have been
        members = m.channel == channel
        signs = np.where(plain.unlike(m, members, blind=True), -1.0, 1.0)
        yield from _with_signs(f"{CHANNELS[channel]} of ", m, members, signs, plain)


def _with_signs(
    what: str, m: MeasurementSet, members: np.ndarray, signs: np.ndarray, plain: _Plain
) -> Iterator[Reinterpretation]:
    """Yield a set whose members (N,) are reversed in those runs where a plain fit says so, from signs (runs,) on."""

    def signed() -> MeasurementSet:
        if (signs > 0.0).all():
            return m
        return m.with_values(np.where(members, m.value * signs[m.run], m.value))

    for _ in range(ROUNDS):
        unlike = plain.unlike(signed(), members)
        signs = np.where(unlike, -signs, signs)
        if not unlike.any():
            break
    family, runs = family_of_run(m), np.unique(m.run[members])
    names = [m.runs[n].name for n in runs if signs[n] < 0.0]
    mixed = any(len(np.unique(signs[runs[family[runs] == n]])) > 1 for n in np.unique(family[runs]))
    if mixed and (what or 2 * len(names) <= len(runs)):  # all channels may as well be reversed in the others
        listed = ", ".join(names[:3]) + (", …" if len(names) > 3 else "")
        title = f"{what}{len(names)} of {len(runs)} runs ({listed}): sign reversed"
        yield Reinterpretation(title, signed(), np.ones(len(KINDS)), chosen=True)


def _slopes(m: MeasurementSet) -> np.ndarray:
    """Return the slope of each run's linear readings along its line, shape (runs,); 0 where there are none."""
    along, linear = m.along(), m.kind == KINDS.index("linear")
    slopes = np.zeros(len(m.runs))
    for run in np.unique(m.run[linear]):
        members = linear & (m.run == run)
        if members.sum() > 2 and np.ptp(along[members]) > 0.0:
            slopes[run] = np.polyfit(along[members], m.value[members], 1)[0]
    return slopes


def _nominal(geometry: HexapodGeometry, m: MeasurementSet) -> np.ndarray:
    return strut_lengths_batch(Structure.of(geometry), m.stations.positions, m.stations.rotations)


def _exchanged_axes(m: MeasurementSet, a: int, b: int) -> MeasurementSet:
    """Return a set whose commanded positions, lines and channels have two axes of the work frame exchanged."""
    order = np.arange(3)
    order[[a, b]] = b, a
    work = m.geometry.work
    turn = work.rotation @ np.eye(3)[order] @ work.rotation.T
    poses = exchanged(m.geometry, (m.stations.positions, m.stations.rotations), a, b)
    runs = tuple(replace(run, axis=turn @ run.axis) for run in m.runs)
    channels = [CHANNELS.index(_renamed(name, a, b)) for name in CHANNELS]
    renamed = replace(m, runs=runs, channel=np.array(channels)[m.channel])
    return _sent(renamed, m.geometry, *poses, turn)


def _renamed(channel: str, a: int, b: int) -> str:
    kind, _, axis = channel.partition("_")
    other = {AXES[a]: AXES[b], AXES[b]: AXES[a]}.get(axis, axis)
    return f"{kind}_{other}" if axis else channel


def _elsewhere(m: MeasurementSet, geometry: HexapodGeometry) -> MeasurementSet:
    """Return a set as if another machine's tool had gone the same way in its work frame."""
    tips, tools = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)
    turn = geometry.work.rotation @ m.geometry.work.rotation.T
    runs = tuple(replace(run, axis=turn @ run.axis) for run in m.runs)
    moved = replace(m, runs=runs, geometry=geometry, probe=geometry.tool.position)
    return _sent(moved, geometry, *geometry.platform_poses(tips, tools), turn)


def _sent(
    m: MeasurementSet, geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray, turn: np.ndarray
) -> MeasurementSet:
    """Return a set with other poses, the lengths that its machine is sent there with, and directions turned alike."""
    moving = Passes(geometry, positions, rotations, m.stations.sense[:, :3] @ turn.T)
    stations = replace(
        m.stations, positions=positions, rotations=rotations, commands=moving.nominal_commands(), sense=moving.senses()
    )
    return replace(m, stations=stations)
