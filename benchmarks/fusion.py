"""A machine warms by 5 K while an instrument on it measures the tool: what fusion leaves of the drift.

Usage: python -m benchmarks.fusion [--machines 3]; see doc/benchmarks.md. A row misses its bar when fusion leaves more
than 25 % (root mean square) on any machine, or a wild reading counts.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.calibration import LARGE
from benchmarks.drawn import Table, of_zoo, verdict
from benchmarks.thermal import RISE, TAU, of_steel
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.fusion import Fusion, FusionRules, PoseReading
from hexapod_comp.errors import HexapodError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.temperatures import PARTS
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.imperfections import draw_model
from hexapod_comp.virtual.warm_up import WarmUp

GEOMETRIES = ("paper", "example_6_6", "framed", "hanging", "inches")
WARMING = 5.0 / RISE[0] * RISE  # K: struts, base, platform
LASTS, EVERY, READINGS = 10800, 10, 5  # s of warming, s at each pose, readings there
NOISE, TURN_NOISE = 2e-6, 1e-5  # of the instrument, m and rad
WILD, WILD_BY = 0.01, (5e-5, 5e-3)  # share of wild readings, and by how much they are off, m
REACH, TURNS = 0.06, np.radians(2.0)  # how far from home the tool is sent at most, m along each axis, and turned, rad
LEFT = 0.25  # the bar


def geometry_of(name: str) -> HexapodGeometry:
    """Return a machine's geometry."""
    return load_geometry(name) if name == "example_6_6" else of_zoo(name)[0]


def warmed(geometry: HexapodGeometry, seed: int) -> tuple[np.ndarray, np.ndarray, int, int, int]:
    """Return squared errors at each arrival, m², without and with fusion; wild readings, those that counted, and true
    ones that were rejected."""
    rng, model = np.random.default_rng([seed, 31]), of_steel(draw_model(geometry, LARGE, seed), seed)
    hidden, blind, fused = (Compensator(geometry, model, 1.0) for _ in range(3))
    fusion = Fusion(fused, FusionRules(position_deviation=NOISE, rotation_deviation=TURN_NOISE))
    course = WarmUp(np.append(WARMING, 0.0), np.append(TAU, 1.0)).apart(0.1, seed).course(LASTS)
    left: tuple[list[float], list[float]] = ([], [])
    counts = np.zeros(3, dtype=int)
    for second in range(EVERY, LASTS, EVERY):
        for part, value in zip(PARTS, course[second], strict=False):
            hidden.set_temperature(part, float(value))
        turn = Rotation.from_rotvec(TURNS * rng.uniform(-1.0, 1.0, 3) / np.sqrt(3.0)).as_matrix()
        place = geometry.home.position + REACH * rng.uniform(-1.0, 1.0, 3)
        platform = Pose(place, geometry.home.rotation @ turn)
        wanted = platform @ geometry.tool
        for kept, compensator in zip(left, (blind, fused), strict=True):
            compensator.reset()
            try:
                for n in range(2):  # the second takes up what is ramped
                    commands = compensator.correct(geometry.tool_pose(platform), 0.02 * n).command
            except HexapodError:
                break
            hidden.motion.sense[:] = compensator.motion.sense
            real = hidden.estimate(commands)
            kept.append(float(np.square(real[:3] - wanted.position).sum()))
        else:
            tool = Pose(real[:3].copy(), real[3:].reshape(3, 3).copy())
            for n in range(READINGS):
                counts += _measure(fusion, tool, commands, second + 2.0 * n, rng)
            fusion.feed(compensate=True)
    return np.array(left[0]), np.array(left[1]), *counts.tolist()


def _measure(fusion: Fusion, tool: Pose, struts: np.ndarray, at: float, rng: np.random.Generator) -> tuple[int, ...]:
    """Measure once; return whether it was wild, whether it counted all the same, whether a true one was rejected."""
    position, turn = tool.position + NOISE * rng.standard_normal(3), TURN_NOISE * rng.standard_normal(3)
    wild = rng.random() < WILD
    if wild:
        way = rng.standard_normal(3)
        position = position + np.exp(rng.uniform(*np.log(WILD_BY))) * way / np.linalg.norm(way)
    pose = Pose(position, Rotation.from_rotvec(turn).as_matrix() @ tool.rotation)
    fusion.add_struts(struts.tolist(), at - 0.01)
    fusion.add(PoseReading(pose, at, fusion.rules.covariance()))
    rejected = bool(fusion.add_struts(struts.tolist(), at + 0.01))
    return wild, wild and not rejected, rejected and not wild


def show(found: Table, name: str, machines: int) -> None:
    """Judge machines of a geometry; the bar is met on each, and no wild reading counted."""
    geometry = geometry_of(name)
    judged = [warmed(geometry, 100 + seed) for seed in range(machines)]
    blind, fused = (np.sqrt([squares.mean() for squares in one]) for one in list(zip(*judged, strict=True))[:2])
    wild, passed, refused = np.sum([one[2:] for one in judged], axis=0).tolist()
    share = refused / (READINGS * sum(len(one[0]) for one in judged))
    before, after, worst = np.sqrt(np.mean(blind**2)), np.sqrt(np.mean(fused**2)), (fused / blind).max()
    met = bool(worst <= LEFT and not passed)
    cells = [machines, f"{1e6 * before:.2f}", f"{1e6 * after:.2f}", f"{after / before:.1%}", f"{worst:.1%}"]
    found.row(name, *cells, f"{wild}, {passed}", f"{share:.2%}", verdict(LEFT, met), met=met)


def cost() -> tuple[float, float]:
    """Return how long a pose estimate takes, s of processor time, without and with the weighing of fusion."""
    geometry = geometry_of("paper")
    compensator = Compensator(geometry, of_steel(draw_model(geometry, LARGE, 1), 1))
    fusion, times = Fusion(compensator, FusionRules()), []
    fusion.filter.state = np.full(12, 1e-6)
    struts = tuple(compensator.correct(geometry.tool_pose(geometry.home)).command.tolist())
    for weigh in (lambda pose: pose, fusion.weighed):
        began = time.process_time()
        for _ in range(2000):
            weigh(compensator.estimate(struts))
        times.append((time.process_time() - began) / 2000)
    return times[0], times[1]


COLUMNS = ["warm-up of 5 K", "machines", "blind, µm", "fused, µm", "left", "worst", "wild, counted"]


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 1 where a bar is missed."""
    parser = argparse.ArgumentParser(description="Drift of a warm-up with and without a pose instrument.")
    parser.add_argument("--machines", type=int, default=3, help="of each geometry")
    chosen, found = parser.parse_args(arguments), Table([*COLUMNS, "true, rejected", "bar"])
    for name in GEOMETRIES:
        show(found, name, chosen.machines)
    without, weighed = cost()
    print(f"\npose estimate: {1e6 * without:.1f} µs, weighed {1e6 * weighed:.1f} µs of processor time")
    return 0 if found.met else 1


if __name__ == "__main__":
    sys.exit(main())
