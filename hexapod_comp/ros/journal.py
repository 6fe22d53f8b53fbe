"""Publishing the compensator's journal, which makes a recording of a run replayable.

Two topics beside the node's own, both reliable and kept for late subscribers, so that a recorder which joins in
the middle of a motion gets what it needs: ``~/journal``
(std_msgs/String, JSON; see :mod:`hexapod_comp.compensation.journal`) with a page at each tick that has something to
tell, and with each snapshot, and ``~/files`` with the geometry and the
model in use, word for word.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from ..compensation.compensator import Compensator
from ..compensation.journal import Journal, Source, sources_text
from .runtime import ACKNOWLEDGED_WITHIN

JOURNAL_QOS = QoSProfile(
    depth=10,  # a recorder's own queue is no longer than this
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Pages: each counts, and who comes late needs the last snapshot."""


class JournalTopics:
    """The journal of a configured node; arguments are the node, its compensator, files and parameters, frames.

    Nothing is published while a command is handled: what happens is noted, and goes out with :meth:`tick`.
    """

    def __init__(
        self,
        node: LifecycleNode,
        compensator: Compensator,
        sources: dict[str, Source],
        options: dict[str, Any],
        frame_ids: dict[str, str],
    ) -> None:
        self._sources, self._published = sources, dict[str, Source]()
        self._pages = node.create_publisher(String, "~/journal", JOURNAL_QOS)
        self._files = node.create_publisher(String, "~/files", JOURNAL_QOS)
        self._journal = Journal(compensator, sources, frame_ids, options["joint_names"])
        self.answered, self.refused = self._journal.answered, self._journal.refused
        self.tick(time.monotonic())  # so that no command comes before the first page

    @property
    def publishers(self) -> tuple:
        """Both publishers, to be destroyed with the node's own."""
        return self._pages, self._files

    def tick(self, now: float) -> None:
        """Publish what is due at the monotonic time `now`, s: files that are new, then a page."""
        if not self._journal.due(now):
            return
        if self._sources != self._published:
            self._files.publish(String(data=sources_text(self._sources)))
            self._published = dict(self._sources)
        self._pages.publish(String(data=self._journal.page(now)))

    def close(self, now: float) -> None:
        """Publish a last page, with what was answered since the one before, and wait for its arrival."""
        self._pages.publish(String(data=self._journal.page(now)))
        self._pages.wait_for_all_acked(ACKNOWLEDGED_WITHIN)
