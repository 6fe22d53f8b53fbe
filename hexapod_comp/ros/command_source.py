"""Who speaks: only one node may publish on a topic of commands or of readings, and no command goes missing unseen.

The graph tells the publishers' names, but keeps a node that was killed for up to 20 s; two of the same name may
therefore be one and its ghost. Sequence numbers tell them apart: every publisher counts its messages from 1, and
only the living speak.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNode

from ..errors import shorten
from .guarding import described
from .health import Lately

SPEAKERS_WITHIN = 1.0
"""Who speaks again this long after another has taken over is not a predecessor that was stopped, s."""

SPEAKERS_HELD = 2.0
"""Two that spoke in turn count as two for this long after the last turn, s."""

UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
"""What rmw calls a publisher whose node it has not heard of: found a moment ago, or not a ROS node."""


class Sequence:
    """What the sequence numbers of one topic's messages tell.

    Attributes
    ----------
    missed : int
        Messages that were sent and never handled: a newer one had replaced them, or the network lost them.
    counted : bool
        Whether the middleware counts messages at all.
    """

    def __init__(self) -> None:
        self.missed, self.counted = 0, True
        self._turned_at = self._changed_at = -float("inf")
        self._last = self._other = 0
        self._misses = Lately()

    def hear(self, number: int | None, now: float) -> bool:
        """Take the number of a message at the monotonic time `now`; return whether two speak in turn.

        Middleware that does not count gives None.
        """
        self.counted = number is not None
        if number is None or number == self._last + 1:
            self._last = number or 0
            return False
        last, self._last = self._last, number
        if not last:
            return False
        back = number <= last
        returned = now - self._changed_at < SPEAKERS_WITHIN and (back or last < self._other < number)
        if returned:
            self._miss(number - self._other - 1, now)
            self._turned_at = now
        elif not back:
            self._miss(number - last - 1, now)
        if back or returned:
            self._other, self._changed_at = last, now
        return returned

    def _miss(self, count: int, now: float) -> None:
        if count > 0:
            self.missed += count
            self._misses.note(now)

    def missing(self, now: float) -> bool:
        """Return whether messages have gone missing of late."""
        return self._misses.holds(now)

    def two_speak(self, now: float) -> bool:
        """Return whether two publishers have spoken in turn of late."""
        return now - self._turned_at < SPEAKERS_HELD


class Publishers:
    """The nodes that publish on a topic, as the graph tells.

    Parameters
    ----------
    node : LifecycleNode
        Who asks.
    topic : str
        Full name of the topic.
    count : callable
        Returns how many publishers there are: cheap, where the look-up of their names is not.

    Attributes
    ----------
    count : int
        How many there were at the last look, −1 before.
    names : tuple of str
        Full names of their nodes, each once.
    unknown : str
        Why the names cannot be told, empty where they can. Who cannot tell who commands must not obey.
    """

    def __init__(self, node: LifecycleNode, topic: str, count: Callable[[], int]) -> None:
        self._node, self.topic, self._count_now = node, topic, count
        self.count = -1
        self.names: tuple[str, ...] = ()
        self.unknown = ""

    def look(self) -> None:
        """Look again: at the names only when they may have changed, or when they matter."""
        count = self._count_now()
        if count != self.count or count > 1 or self.unknown or UNKNOWN_NAME in self.names:
            self.count = count
            self.names, self.unknown = self._publishers() if count else ((), "")

    @property
    def reason(self) -> str:
        """Name under which refusals are counted."""
        return "unknown_publisher" if self.unknown else "several_publishers"

    def _publishers(self) -> tuple[tuple[str, ...], str]:
        """Return the names, and why there are none: a node's name may be any bytes, which rclpy cannot give."""
        try:
            infos = self._node.get_publishers_info_by_topic(self.topic)
            return tuple(sorted({full_name(info) for info in infos})), ""
        except UnicodeDecodeError as error:
            return (), f"a node's name is not UTF-8: {shorten(error.object)}"
        except Exception as error:  # of many kinds: what the graph holds is others' doing
            return (), described(error)


def full_name(info: Any) -> str:
    """Return the full name of the node at an end of a topic, as the graph tells it."""
    name = info.node_name
    return name if name == UNKNOWN_NAME else f"{info.node_namespace.rstrip('/')}/{name}"


class CommandSource:
    """Guards a subscription of what only one node may say, commands or readings: refuses while several nodes publish.

    Parameters
    ----------
    node : LifecycleNode
        The node that subscribes.
    topic : str
        Full name of the topic.
    count : callable
        Returns how many publishers the subscription has.
    allowed : bool
        Several may speak; they are named all the same.
    """

    def __init__(self, node: LifecycleNode, topic: str, count: Callable[[], int], allowed: bool) -> None:
        self._publishers, self._allowed = Publishers(node, topic, count), allowed
        self.sequence = Sequence()
        self.problem = ""

    @property
    def reason(self) -> str:
        """Name under which refusals are counted."""
        return self._publishers.reason

    @property
    def names(self) -> tuple[str, ...]:
        """Full names of the nodes that publish."""
        return self._publishers.names

    def look(self, now: float) -> None:
        """Look who publishes, at the monotonic time `now`."""
        self._publishers.look()
        self._judge(now)

    def hear(self, number: int | None, now: float) -> bool:
        """Take a message's sequence number; return whether it has shown a second speaker."""
        counted = self.sequence.counted
        if self.sequence.hear(number, now) or (counted and not self.sequence.counted):
            self._judge(now)
            return bool(self.problem)
        return False

    def _judge(self, now: float) -> None:
        names, topic = self.names, self._publishers.topic
        self.problem = ""
        if self._allowed:
            return
        if self._publishers.unknown:
            self.problem = f"who publishes {topic} cannot be told: {self._publishers.unknown}"
        elif len(names) > 1:
            self.problem = f"several publishers of {topic}: {', '.join(names)}"
        elif self._publishers.count > 1 and self.sequence.two_speak(now):
            self.problem = f"two publishers of {topic} speak in turn, both called {', '.join(names) or UNKNOWN_NAME}"
        elif self._publishers.count > 1 and not self.sequence.counted:
            self.problem = (
                f"two publishers of {topic} are called {', '.join(names) or UNKNOWN_NAME}; whether both speak cannot "
                "be told, as this middleware (RMW) does not count messages"
            )


class OwnTopic:
    """Guards a topic on which nobody but this node may publish.

    A second node of the very same name is not seen: it may be this one's predecessor that was killed. Who
    listens finds out, see :class:`CommandSource`.

    Parameters
    ----------
    node : LifecycleNode
        The node that publishes.
    topic : str
        Full name of the topic.
    allowed : bool
        Others may publish; they are named all the same.
    """

    def __init__(self, node: LifecycleNode, topic: str, allowed: bool) -> None:
        self._own = node.get_fully_qualified_name()
        self._publishers = Publishers(node, topic, lambda: node.count_publishers(topic))
        self._allowed = allowed
        self.names: tuple[str, ...] = ()
        self.problem = ""

    @property
    def reason(self) -> str:
        """Name under which refusals are counted."""
        return self._publishers.reason

    def look(self, now: float) -> None:
        """Look who publishes."""
        self._publishers.look()
        self.names = tuple(name for name in self._publishers.names if name != self._own)
        others = ", ".join(self.names) or self._publishers.unknown
        disturbed = others and not self._allowed
        self.problem = f"{self._publishers.topic} is also published by {others}" if disturbed else ""
