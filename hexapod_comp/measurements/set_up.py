"""Is the instrument set up right? First readings are compared with the commands, before hours are spent on more.

The tolerances are larger than any machine's error: a reading outside them has another unit, sign, channel, frame or
target.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import HexapodError
from ..pose import Pose, attitude_error, best_motion, rotation_from_vector
from .readings import ANGULAR_KINDS

FREE, KNOWN = FRAMES = ("free", "known")  # Where a tracker stands: anywhere; or its frame is the base

LEAST_WAY = 5e-3  # Root of the summed squared ways, or a way along a line, from which ways are compared, m
LARGEST_ERROR = 0.5e-3  # Errors of a machine before its calibration differ by no more from stop to stop, m
LARGEST_SCALE_ERROR = 0.01  # Ways longer or shorter by this share and that: another unit
LARGEST_TURN = math.radians(2.0)  # Ways turned by this and that: another frame
LARGEST_OFFSET = 0.01  # Poses beside the commanded ones by this, m: another origin or target
LARGEST_STEP = {"length": 1e-3, "angle": 5e-3}  # Errors that change by more from stop to stop, m, rad: a lost zero
OFF_CENTRE = 0.01  # And of lengths, m: their centre is known to some millimetres
NUDGE = {"length": 0.5e-3, "angle": 2e-3}  # Moves that each channel must follow, m, rad: every instrument reads so far
NUDGE_TOLERANCE = 0.15  # By how much of a nudge a reading may differ: backlash, a centre that is known to 5 mm
LARGEST_ARM = 0.025  # Displacement per turn of the tool about its tip, m: the target is elsewhere
FRAME_STATIONS = 4  # from which a tracker's frame is estimated: the least that say more than three would

UNITS = {
    "length": {1e3: "mm read as m", 1e-3: "m read as mm", 25.4: "inches read as mm", 1 / 25.4: "mm read as inches",
               1e6: "µm read as m", 1e9: "nm read as m", 1 / 0.0254: "inches read as m", 0.5: "half the way, as with "
               "optics that double it", 2.0: "twice the way, as with optics that double it"},
    "angle": {math.degrees(1.0): "degrees read as rad", 3600.0 * math.degrees(1.0): "arcsec read as rad",
              1e3: "mrad read as rad", 1e6: "µrad read as rad", 1e-3: "rad read as mrad"},
}  # fmt: skip


class SetUpError(HexapodError):
    """The first readings show a mistake in sign, unit, channel, frame or target."""

    reason = "set_up"


def dimension(channel: str) -> str:
    """Return whether a channel reads a length or an angle."""
    return "angle" if channel.partition("_")[0] in ANGULAR_KINDS else "length"


def _unit(scale: float, units: Mapping[float, str], tolerance: float) -> str:
    """Return which unit explains that readings are `scale` times what they should be; empty: none that is known."""
    near = min(units, key=lambda size: abs(math.log(max(abs(scale), 1e-12) / size)))
    return units[near] if abs(abs(scale) / near - 1.0) < tolerance else ""


class PoseCheck:
    """Compares measured poses with the commanded ones, in the base or in a frame that is estimated from both."""

    def __init__(self, size: float, frame: str = KNOWN, with_attitude: bool = True) -> None:
        if frame not in FRAMES:
            raise SetUpError(f"the tracker's frame must be one of {', '.join(FRAMES)}, not {frame!r}")
        self._size, self.free, self._with_attitude = size, frame == FREE, with_attitude
        self._meant, self._seen = list[Pose](), list[Pose]()

    def frame(self) -> Pose | None:
        """Return the instrument's frame in the base as far as the stations determine it; None if they do not."""
        if not self.free or not self._meant:
            return None if self.free else Pose.identity()
        meant, seen = (np.concatenate([self._points(pose) for pose in poses]) for poses in (self._meant, self._seen))
        spread = np.linalg.norm(self._ways([pose.position for pose in self._meant]))
        return None if len(self._meant) < FRAME_STATIONS or spread < LEAST_WAY else best_motion(seen, meant)

    def _points(self, pose: Pose) -> np.ndarray:
        """Return the points of a pose that a frame must fit, (n, 3): three aside where its attitude is measured."""
        return pose.position[None] + (self._size * pose.rotation.T if self._with_attitude else 0.0)

    def plausible(self, meant: Pose, seen: Pose) -> bool:
        """Add a stop's poses, commanded in the base and as measured, and return whether a machine can have such errors;
        a SetUpError as soon as the ways between the stops show why not."""
        self._meant.append(meant)
        self._seen.append(seen)
        if self._with_attitude and not self.free:
            self._check_attitude(meant, seen)
        gone, read = (self._ways([pose.position for pose in poses]) for poses in (self._meant, self._seen))
        long = float(np.linalg.norm(gone))
        if long > LEAST_WAY:
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
        """Raise a SetUpError where the measured place is far from the commanded one."""
        offset = self._offset()
        if np.linalg.norm(offset) > LARGEST_OFFSET:
            away = ", ".join(f"{value * 1e3:.1f}" for value in offset)
            text = f"the tool is measured {away} mm away from the commanded place"
            question = "is the target's place the tool's, and the instrument's origin the base's?"
            raise SetUpError(f"{text}: {question}{self._hint()}")

    @staticmethod
    def _ways(places: list[np.ndarray]) -> np.ndarray:
        return np.asarray(np.array(places) - np.mean(places, axis=0))

    def _offset(self) -> np.ndarray:
        """Return measured minus commanded place, (3,), m: the mean of all stops; in a free frame, of the last."""
        if not self._meant or (frame := self.frame()) is None:
            return np.zeros(3)
        off = [(frame @ seen).position - meant.position for meant, seen in zip(self._meant, self._seen, strict=True)]
        return np.asarray(off[-1] if self.free else np.mean(off, axis=0))

    def _hint(self) -> str:
        return "" if self.free else " A tracker that stands anywhere is --tracker-frame free"

    def _check_scale(self, scale: float, slack: float) -> None:
        if abs(scale - 1.0) > LARGEST_SCALE_ERROR + slack:
            unit = _unit(scale, UNITS["length"], LARGEST_SCALE_ERROR + slack)
            hint = f": {unit}?" if unit else ""
            raise SetUpError(f"ways read {scale:.4g} times as long as commanded{hint}")

    def _check_turn(self, gone: np.ndarray, read: np.ndarray, slack: float) -> None:
        cosine = float((gone * read).sum() / (np.linalg.norm(gone) * np.linalg.norm(read)))
        if cosine < -math.cos(LARGEST_TURN + slack):
            raise SetUpError("ways read reversed: the sign of the readings, or of an axis of the instrument's frame")
        if (angle := math.acos(min(cosine, 1.0))) > LARGEST_TURN + slack:
            text = f"ways read turned by about {math.degrees(angle):.1f}° against the commanded ones"
            question = "are the axes of the instrument's frame those of the base, none exchanged?"
            if self.free:
                question = "no place of the tracker explains it: is an axis reversed, or are two exchanged?"
            raise SetUpError(f"{text}: {question}{self._hint()}")

    def _check_attitude(self, meant: Pose, seen: Pose) -> None:
        turned = attitude_error(seen.rotation, meant.rotation)
        if (angle := float(np.linalg.norm(turned))) > LARGEST_TURN:
            about = ", ".join(f"{value:.1f}" for value in np.degrees(turned))
            text = f"the tool reads turned by {math.degrees(angle):.1f}° ({about}° about x, y, z of the base)"
            question = "is the target mounted turned, or are the axes of the instrument's frame others?"
            raise SetUpError(f"{text}: {question}{self._hint()}")


def nudge(pose: Pose, direction: np.ndarray, channel: str, sign: float) -> Pose:
    """Return a pose moved along, or turned about, the direction (6,) in which a channel reads, in the pose's frame."""
    size = sign * NUDGE[dimension(channel)]
    turn = rotation_from_vector(size * direction[3:])
    return Pose(pose.position + size * direction[:3], turn @ pose.rotation)


def nudge_tolerance(channel: str, distance: float) -> float:
    """Return the allowed relative error of a channel's change under a nudge; a length is read at `distance`, m, from a
    centre that may be off."""
    off = min(OFF_CENTRE / distance, 1.0) if channel == "length" else 0.0
    return NUDGE_TOLERANCE + 1.0 - math.sqrt(1.0 - off**2)


def check_nudges(
    channels: Sequence[str], directions: np.ndarray, seen: np.ndarray, tolerances: Sequence[float]
) -> None:
    """Raise a SetUpError where channels do not follow small moves along each one's own direction.

    `directions` (n, 6) are the directions in which channels read, `seen` (n, n) the change of channel i when the tool
    was moved along channel j, `tolerances` the allowed relative errors.
    """
    sizes = np.array([NUDGE[dimension(channel)] for channel in channels])
    for i, channel in enumerate(channels):
        ratios = seen[i] / sizes  # as if it read what another channel should
        own, others = float(ratios[i]), [j for j in range(len(channels)) if j != i]
        if abs(own - 1.0) > tolerances[i]:
            exchanged = [j for j in others if abs(abs(ratios[j]) - 1.0) < NUDGE_TOLERANCE]
            if abs(own) < NUDGE_TOLERANCE and exchanged:
                raise SetUpError(f"{channel} reads what {channels[exchanged[0]]} should: are the channels exchanged?")
            if abs(own + 1.0) < tolerances[i]:
                raise SetUpError(f"{channel} reads with reversed sign: change the sign of this channel")
            size = f"{sizes[i] * 1e3:g} {'mrad' if dimension(channel) == 'angle' else 'mm'}"
            text = f"{channel} reads {own:.4g} times the {size} by which the tool was moved"
            unit = _unit(own, UNITS[dimension(channel)], NUDGE_TOLERANCE)
            hint = (
                f"{unit}{', and reversed' if own < 0.0 else ''}" if unit else "is its beam along the line, is it read"
            )
            raise SetUpError(f"{text}: {hint}?")
        for j in others:
            if dimension(channel) == "angle":
                continue
            if dimension(channels[j]) == "angle":
                if abs(arm := float(seen[i, j] / sizes[j])) > LARGEST_ARM:
                    text = f"{channel} reads a turn of the tool about its tip as if {abs(arm) * 1e3:.0f} mm from it"
                    raise SetUpError(f"{text}: is the target at the tool's tip?")
            elif abs(ratios[j] - directions[i, :3] @ directions[j, :3]) > NUDGE_TOLERANCE:
                text = f"{channel} reads {ratios[j]:.2f} of a move along {channels[j]}"
                raise SetUpError(f"{text}: is the instrument turned against the work frame?")


class WayCheck:
    """Compares how one channel's readings change from stop to stop of a run with the commanded way.

    The way is along the line, or for lengths the distance from the centre. The measured share of it is the median over
    pairs of stops that are far enough apart.
    """

    def __init__(self, channel: str, nudged: bool) -> None:
        self._channel, self._kind, self._nudged = channel, channel.partition("_")[0], nudged
        self._ways, self._read = list[float](), list[float]()

    def jump(self, way: float, read: float) -> float:
        """Add a stop, m or rad, and return by how much more its error changed than any machine's does, else 0.

        A SetUpError where the readings so far show another mistake.
        """
        self._ways.append(way)
        self._read.append(read)
        follows = self._kind in ("linear", "length")
        errors = np.array(self._read) - (np.array(self._ways) if follows else 0.0)
        change = abs(float(errors[-1] - errors[-2])) if len(errors) > 1 else 0.0
        most = OFF_CENTRE if self._kind == "length" else LARGEST_STEP[dimension(self._channel)]
        until = len(errors) - (change > most)
        if self._kind not in ("rotation", "displacement"):
            self._check_slope(np.array(self._ways[:until]), np.array(self._read[:until]), follows)
        return change if change > most and (until > 1 or self._nudged) else 0.0

    def _check_slope(self, ways: np.ndarray, read: np.ndarray, follows: bool) -> None:
        one, other = np.triu_indices(len(ways), 1)
        apart = np.abs(ways[one] - ways[other])
        far = apart >= max(LEAST_WAY, 0.5 * float(apart.max(initial=0.0)))
        if not far.any():
            return
        slope = float(np.median((read[one] - read[other])[far] / (ways[one] - ways[other])[far]))
        slack = (OFF_CENTRE if self._kind == "length" else LARGEST_ERROR) / float(np.median(apart[far]))
        if not follows:
            if abs(slope) > LARGEST_TURN + slack:
                text = f"{self._channel} changes by {slope:.3g} of the way along the line"
                raise SetUpError(f"{text}: is the beam along the line, and are the channels not exchanged?")
            return
        if abs(slope - 1.0) > LARGEST_SCALE_ERROR + slack:
            text = f"{self._channel} reads {slope:.4g} times the commanded way"
            if abs(slope + 1.0) < LARGEST_SCALE_ERROR + slack:
                raise SetUpError(f"{text}: its sign is reversed: change the sign of this channel")
            unit = _unit(slope, UNITS["length"], LARGEST_SCALE_ERROR + slack)
            raise SetUpError(f"{text}: {unit or 'is its beam along the line, is its scale right'}?")
