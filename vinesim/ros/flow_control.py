"""Flow control of the topics that every step publishes: the next step waits until their subscribers keep up.

A subscriber of rclpy keeps the last ten messages of a topic, and overwrites them when more come before it gets a
processor. So no more than a few are on their way at once. Fast DDS tells only whether all subscribers have acknowledged
all messages of a topic; they do when the publisher asks them (``heartbeatPeriod`` of ``udp.xml``). Nothing is known of
subscribers that ask for best effort.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

from vinesim.ros.topic import HISTORY, Topic

log = logging.getLogger(__name__)

SUBSCRIBER_TIMEOUT = 3.0
"""Subscribers that have not acknowledged all for so long are waited for no longer, until they do [s]."""
WINDOW = 5
"""Messages of a topic that may be on their way to subscribers on this machine."""
WIDE_WINDOW = HISTORY // 2
"""The same if one is on another machine: a network may take long to acknowledge, and the world should not slow down."""
FIRST_LOOK = 3
"""Messages after which acknowledgements are looked at."""


class FlowControl:
    """Looks at acknowledgements; for the thread that publishes."""

    def __init__(self) -> None:
        self._acknowledged: dict[Topic, int] = {}
        """Messages sent when all were acknowledged last."""
        self._waits_since: float | None = None
        """Since when subscribers are waited for [s]; None: they are not."""
        self._given_up: set[Topic] = set()
        """Topics with a subscriber that is waited for no longer."""

    def must_wait(self, topics: Sequence[Topic], now: float) -> bool:
        """Whether nothing more shall be sent on ``topics`` at ``now`` [s]; to be called before every step, and many
        times a second meanwhile."""
        if not any(map(self._is_behind, topics)):
            self._waits_since = None
            return False
        if self._waits_since is None:
            self._waits_since = now
        if now - self._waits_since < SUBSCRIBER_TIMEOUT:
            return True
        behind = [topic for topic in topics if self._is_behind(topic)]
        log.warning(
            "a subscriber of %s does not answer for %.0f s: it is waited for no longer, and when it comes back it gets "
            "the last %d messages",
            ", ".join(topic.name for topic in behind),
            SUBSCRIBER_TIMEOUT,
            HISTORY,
        )
        self._given_up.update(behind)
        self._waits_since = None
        return False

    def _is_behind(self, topic: Topic) -> bool:
        sent = topic.sent
        on_their_way = sent - self._acknowledged.get(topic, 0)
        if on_their_way < FIRST_LOOK:
            return False
        if not topic.subscription_count or topic.is_acknowledged():
            self._acknowledged[topic] = sent
            self._given_up.discard(topic)
            return False
        window = WINDOW if topic.is_local else WIDE_WINDOW
        return on_their_way >= window and topic not in self._given_up
