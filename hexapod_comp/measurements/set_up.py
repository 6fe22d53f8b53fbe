"""Checks of an instrument's set-up: readings are compared with the commanded poses.

The tolerances exceed the errors of any uncalibrated machine, so a larger deviation is a mistake in the set-up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import HexapodError
from ..pose import Pose, attitude_error, best_motion, rotation_from_vector
from .readings import si_unit

FREE, KNOWN = FRAMES = ("free", "known")  # the tracker's frame is unknown and estimated; it is ``base``

# Shortest compared travel, m: between points of a line; of poses, √Σ (distance from the mean position)²
LEAST_COMPARED = 5e-3
LARGEST_ERROR = 0.5e-3  # largest error of a travel on an uncalibrated machine, m
LARGEST_SCALE_ERROR = 0.01  # largest relative error of a travel, in addition to LARGEST_ERROR; more: a wrong unit
LARGEST_TURN = math.radians(2.0)  # largest angle between measured and commanded travel, likewise; more: a wrong frame
LARGEST_OFFSET = 0.01  # largest distance of measured from commanded position, m; more: a wrong origin or target
LARGEST_STEP = {"m": 1e-3, "rad": 5e-3}  # largest change of a reading's error between stops, m, rad; more: a lost zero
OFF_CENTRE = 0.01  # distances: largest error of a stated centre, m; replaces LARGEST_ERROR and LARGEST_STEP
NUDGE = {"m": 0.5e-3, "rad": 2e-3}  # size of small moves that check each channel, m, rad
NUDGE_TOLERANCE = 0.15  # largest relative error of the reading of a small move; causes: backlash, inexact centres
LARGEST_ARM = 0.025  # largest displacement of the target when the tool turns about its tip, m/rad; more: wrong target
FRAME_STATIONS = 4  # stations that determine a tracker's frame: three, and a fourth as a check

WRONG_UNITS = {
    "m": {1e3: "mm read as m", 1e-3: "m read as mm", 25.4: "inches read as mm", 1 / 25.4: "mm read as inches",
               1e6: "µm read as m", 1e9: "nm read as m", 1 / 0.0254: "inches read as m", 0.5: "laser wrongly "
               "set for double-pass optics", 2.0: "laser not set for its double-pass optics"},
    "rad": {math.degrees(1.0): "degrees read as rad", 3600.0 * math.degrees(1.0): "arcsec read as rad",
              1e3: "mrad read as rad", 1e6: "µrad read as rad", 1e-3: "rad read as mrad"},
}  # fmt: skip


class SetUpError(HexapodError):
    """Readings show a mistake in the instrument's set-up: in sign, unit, channel, frame or target."""

    reason = "set_up"


def _unit(scale: float, units: Mapping[float, str], tolerance: float) -> str:
    """Return the mistake in `units` that explains readings about `scale` times too large; "" if none does."""
    near = min(units, key=lambda size: abs(math.log(max(abs(scale), 1e-12) / size)))
    return units[near] if abs(abs(scale) / near - 1.0) < tolerance else ""


class PoseCheck:
    """Compares measured with commanded poses; a free tracker frame is first fitted to the commanded poses."""

    def __init__(self, size: float, frame: str = KNOWN, with_attitude: bool = True) -> None:
        if frame not in FRAMES:
            raise SetUpError(f"the tracker's frame must be one of {', '.join(FRAMES)}, not {frame!r}")
        self._size, self.free, self._with_attitude = size, frame == FREE, with_attitude
        self._meant, self._seen = list[Pose](), list[Pose]()

    def frame(self) -> Pose | None:
        """Return the instrument's frame in ``base``; None if the stops added so far do not determine it."""
        if not self.free or not self._meant:
            return None if self.free else Pose.identity()
        meant, seen = (np.concatenate([self._points(pose) for pose in poses]) for poses in (self._meant, self._seen))
        spread = np.linalg.norm(self._travels([pose.position for pose in self._meant]))
        return None if len(self._meant) < FRAME_STATIONS or spread < LEAST_COMPARED else best_motion(seen, meant)

    def _points(self, pose: Pose) -> np.ndarray:
        """Return points, (n, 3), m, that represent a pose: its position, or three points if attitudes are read."""
        return pose.position[None] + (self._size * pose.rotation.T if self._with_attitude else 0.0)

    def plausible(self, meant: Pose, seen: Pose) -> bool:
        """Add the reading of a pose; return whether its position error is allowed.

        Raise a SetUpError if the travel from earlier poses, or the attitude, differs too much from the commanded one.
        """
        self._meant.append(meant)
        self._seen.append(seen)
        if self._with_attitude and not self.free:
            self._check_attitude(meant, seen)
        gone, read = (self._travels([pose.position for pose in poses]) for poses in (self._meant, self._seen))
        long = float(np.linalg.norm(gone))
        if long > LEAST_COMPARED:
            slack = LARGEST_ERROR * math.sqrt(len(gone)) / long
            self._check_scale(float(np.linalg.norm(read)) / long, slack)
            if (frame := self.frame()) is None:
                return True
            self._check_turn(gone, read @ frame.rotation.T, slack)
            self.end()
            if self._with_attitude:
                self._check_attitude(meant, frame @ seen)
        return bool(np.linalg.norm(self._offset()) < LARGEST_OFFSET)

    def end(self) -> None:
        """Raise a SetUpError if the measured position is more than `LARGEST_OFFSET` from the commanded position."""
        offset = self._offset()
        if np.linalg.norm(offset) > LARGEST_OFFSET:
            away = ", ".join(f"{value * 1e3:.1f}" for value in offset)
            text = f"measured minus commanded position is {away} mm in base, allowed are {LARGEST_OFFSET * 1e3:g} mm"
            question = "is the target at the tool's tip, and is the instrument's origin at the base's origin?"
            raise SetUpError(f"{text}: {question}{self._hint()}")

    @staticmethod
    def _travels(places: list[np.ndarray]) -> np.ndarray:
        return np.asarray(np.array(places) - np.mean(places, axis=0))

    def _offset(self) -> np.ndarray:
        """Return measured − commanded position, m: at the last stop if the frame is free, otherwise the stops' mean."""
        if not self._meant or (frame := self.frame()) is None:
            return np.zeros(3)
        meant, seen = (np.array([pose.position for pose in poses]) for poses in (self._meant, self._seen))
        off = frame.transform(seen) - meant
        return np.asarray(off[-1] if self.free else off.mean(axis=0))

    def _hint(self) -> str:
        return "" if self.free else " If the tracker's frame is not the base's, give --tracker-frame free"

    def _check_scale(self, scale: float, slack: float) -> None:
        if abs(scale - 1.0) > LARGEST_SCALE_ERROR + slack:
            unit = _unit(scale, WRONG_UNITS["m"], LARGEST_SCALE_ERROR + slack)
            hint = f": {unit}?" if unit else ""
            raise SetUpError(f"the measured moves are {scale:.4g} times as long as commanded{hint}")

    def _check_turn(self, gone: np.ndarray, read: np.ndarray, slack: float) -> None:
        cosine = float((gone * read).sum() / (np.linalg.norm(gone) * np.linalg.norm(read)))
        if cosine < -math.cos(LARGEST_TURN + slack):
            problem = "is the sign of the readings, or of an axis of the instrument's frame, reversed?"
            raise SetUpError(f"the measured moves are opposite to the commanded moves: {problem}")
        if (angle := math.acos(min(cosine, 1.0))) > LARGEST_TURN + slack:
            text = f"the measured moves are turned by about {math.degrees(angle):.1f}° from the commanded moves"
            question = "does each axis of the instrument's frame point along the same axis of the base?"
            if self.free:
                question = "no place of the tracker causes this; is an axis reversed, or are two axes exchanged?"
            raise SetUpError(f"{text}: {question}{self._hint()}")

    def _check_attitude(self, meant: Pose, seen: Pose) -> None:
        turned = attitude_error(seen.rotation, meant.rotation)
        if (angle := float(np.linalg.norm(turned))) > LARGEST_TURN:
            about = ", ".join(f"{value:.1f}" for value in np.degrees(turned))
            text = f"the tool's measured attitude is turned by {math.degrees(angle):.1f}° from the command ({about}°"
            text += f" about x, y, z of the base; at most {math.degrees(LARGEST_TURN):g}° are allowed)"
            question = "is the target mounted turned, or are the instrument's axes not parallel to the base's?"
            raise SetUpError(f"{text}: {question}{self._hint()}")


def nudge(pose: Pose, direction: np.ndarray, channel: str, sign: float) -> Pose:
    """Return the pose after a small move along or about a channel's `direction`, (6,); `sign` −1: opposite to it."""
    size = sign * NUDGE[si_unit(channel)]
    turn = rotation_from_vector(size * direction[3:])
    return Pose(pose.position + size * direction[:3], turn @ pose.rotation)


def nudge_tolerance(channel: str, distance: float) -> float:
    """Return the allowed relative error of the reading of a small move; a length is read at a `distance`, m."""
    off = min(OFF_CENTRE / distance, 1.0) if channel == "length" else 0.0
    return NUDGE_TOLERANCE + 1.0 - math.sqrt(1.0 - off**2)


def check_nudges(
    channels: Sequence[str], directions: np.ndarray, seen: np.ndarray, tolerances: Sequence[float]
) -> None:
    """Raise a SetUpError if the channels' readings do not follow small moves of the tool along their directions.

    Row i of `directions`, (n, 6), is the direction of channel i. Row i, column j of `seen`, (n, n), is the change of
    channel i after a small move along the direction of channel j.
    """
    sizes = np.array([NUDGE[si_unit(channel)] for channel in channels])
    for i, channel in enumerate(channels):
        ratios = seen[i] / sizes  # change of channel i divided by the size of each small move
        own, others = float(ratios[i]), [j for j in range(len(channels)) if j != i]
        if abs(own - 1.0) > tolerances[i]:
            exchanged = [j for j in others if abs(abs(ratios[j]) - 1.0) < NUDGE_TOLERANCE]
            if abs(own) < NUDGE_TOLERANCE and exchanged:
                other = channels[exchanged[0]]
                raise SetUpError(f"{channel} follows a move along {other}: are the two channels exchanged?")
            if abs(own + 1.0) < tolerances[i]:
                raise SetUpError(f"{channel} reads with reversed sign: change the sign of this channel")
            size = f"{sizes[i] * 1e3:g} m{si_unit(channel)}"
            text = f"{channel} reads {own:.4g} times the {size} by which the tool was moved"
            unit = _unit(own, WRONG_UNITS[si_unit(channel)], NUDGE_TOLERANCE)
            hint = "is the beam along the line, and is the instrument switched on"
            if unit:
                hint = f"{unit}{', and reversed' if own < 0.0 else ''}"
            raise SetUpError(f"{text}: {hint}?")
        for j in others:
            if si_unit(channel) == "rad":
                continue
            if si_unit(channels[j]) == "rad":
                if (arm := abs(float(seen[i, j] / sizes[j]))) > LARGEST_ARM:
                    text = f"{channel} changes when the tool turns about its tip"
                    raise SetUpError(f"{text}, as if the target were {arm * 1e3:.0f} mm off: is it at the tip?")
            elif abs(ratios[j] - directions[i, :3] @ directions[j, :3]) > NUDGE_TOLERANCE:
                expected = float(directions[i, :3] @ directions[j, :3])
                text = f"{channel} reads {ratios[j]:.2f} of a move along {channels[j]}, but {expected:.2f} is expected"
                raise SetUpError(f"{text}: is the instrument turned relative to the work frame?")


class TravelCheck:
    """Compares the readings of one channel with commanded coordinates along the line or distances from the centre."""

    def __init__(self, channel: str, nudged: bool) -> None:
        self._channel, self._kind, self._nudged = channel, channel.partition("_")[0], nudged
        self._commanded, self._read = list[float](), list[float]()

    def jump(self, commanded: float, read: float) -> float:
        """Add a stop; return by how much the reading's error has jumped since the stop before, m or rad; 0: no jump.

        Raise a SetUpError for a wrong sign or unit, or a beam that is not along the line.
        """
        self._commanded.append(commanded)
        self._read.append(read)
        follows = self._kind in ("linear", "length")
        errors = np.array(self._read) - (np.array(self._commanded) if follows else 0.0)
        change = abs(float(errors[-1] - errors[-2])) if len(errors) > 1 else 0.0
        most = OFF_CENTRE if self._kind == "length" else LARGEST_STEP[si_unit(self._channel)]
        until = len(errors) - (change > most)
        if self._kind not in ("rotation", "displacement"):
            self._check_slope(np.array(self._commanded[:until]), np.array(self._read[:until]), follows)
        return change if change > most and (until > 1 or self._nudged) else 0.0

    def _check_slope(self, commanded: np.ndarray, read: np.ndarray, follows: bool) -> None:
        one, other = np.triu_indices(len(commanded), 1)
        apart = np.abs(commanded[one] - commanded[other])
        far = apart >= max(LEAST_COMPARED, 0.5 * float(apart.max(initial=0.0)))
        if not far.any():
            return
        # the median limits the influence of single wrong readings
        slope = float(np.median((read[one] - read[other])[far] / (commanded[one] - commanded[other])[far]))
        slack = (OFF_CENTRE if self._kind == "length" else LARGEST_ERROR) / float(np.median(apart[far]))
        if not follows:
            if abs(slope) > LARGEST_TURN + slack:
                text = f"{self._channel} changes by {slope:.3g} m per m of travel"
                question = "is the beam not along the line, or are channels exchanged?"
                raise SetUpError(f"{text}, allowed is ±{LARGEST_TURN + slack:.3g}: {question}")
            return
        if abs(slope - 1.0) > LARGEST_SCALE_ERROR + slack:
            text = f"{self._channel} reads {slope:.4g} times the commanded travel"
            if abs(slope + 1.0) < LARGEST_SCALE_ERROR + slack:
                raise SetUpError(f"{text}: its sign is reversed: change the sign of this channel")
            unit = _unit(slope, WRONG_UNITS["m"], LARGEST_SCALE_ERROR + slack)
            raise SetUpError(f"{text}: {unit or 'is the beam along the line, and is the scale right'}?")
