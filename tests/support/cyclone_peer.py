"""A peer of another DDS vendor, Eclipse Cyclone, as a program: it imports neither vinesim nor ROS.

``python cyclone_peer.py DOMAIN`` makes its types from the text of message definitions (as recordings embed them: a type
and, behind lines of ``=``, all types in it). It takes one JSON object a line on standard input, and prints one for each
answer:

* ``{"list": true}``: ``{"topics": {name: type}}``, all topics that are published to its knowledge;
* ``{"read": topic, "type", "definition", "qos"}``: ``{"heard": topic, "qos", "message"}`` for the first message that
  comes, with which the reader ends; ``qos`` is one of :data:`READER_QOS`;
* ``{"write": topic, "type", "definition", "message"}``: the message, with all fields, is sent once.
"""

from __future__ import annotations

import json
import queue
import re
import sys
import threading
import time
from typing import Any

from cyclonedds import builtin
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

POLL_PERIOD = 0.005
"""Wall time between two looks at readers and commands [s]."""
_RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
READER_QOS = {
    "default": Qos(_RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(10)),
    "sensor": Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(5)),
    "latched": Qos(_RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1)),
}
"""The default QoS of subscriptions in rclpy, ``qos_profile_sensor_data``, and that of subscribers to latched topics."""
PRIMITIVES = {
    "bool": bool,
    "byte": types.uint8,
    "char": types.uint8,
    "string": str,
    "float32": types.float32,
    "float64": types.float64,
    **{f"{sign}int{size}": getattr(types, f"{sign}int{size}") for sign in ("", "u") for size in (8, 16, 32, 64)},
}
_FIELD = re.compile(r"(?P<kind>[\w/]+)(<=\d+)?(?P<many>\[(?P<bound><=)?(?P<count>\d*)\])?\s+(?P<name>[a-z]\w*)")
"""A line of a definition that is a field: names of constants are upper case."""


def make_type(type_name: str, definition: str) -> type[IdlStruct]:
    """The type ``package/msg/Name`` by its definition and those of all types in it."""
    name = type_name.replace("/msg/", "/")
    root, *parts = re.split(r"^=+\nMSG: ", definition, flags=re.MULTILINE)
    texts = {name: root} | dict(part.split("\n", 1) for part in parts)
    made: dict[str, type[IdlStruct]] = {}

    def make(name: str) -> type[IdlStruct]:
        if name not in made:
            package, short = name.split("/")
            fields = filter(None, map(_FIELD.match, map(str.strip, texts[name].splitlines())))
            named = {field["name"]: kind_of(field, package) for field in fields}
            made[name] = make_idl_struct(short, f"{package}::msg::dds_::{short}_", named)
        return made[name]

    def kind_of(field: re.Match[str], package: str) -> Any:
        kind = field["kind"]
        count = field["count"]
        element = PRIMITIVES.get(kind) or make(kind if "/" in kind else f"{package}/{kind}")
        if field["many"] is None:
            return element
        if count and not field["bound"]:
            return types.array[element, int(count)]
        return types.sequence[element, int(count)] if count else types.sequence[element]

    return make(name)


def filled(kind: Any, values: Any) -> Any:
    """A value of a type from one as JSON has it, with all fields."""
    if isinstance(kind, type) and issubclass(kind, IdlStruct):
        return kind(**{name: filled(part, values[name]) for name, part in kind.__annotations__.items()})
    facts: Any = getattr(kind, "__metadata__", (None,))[0]
    if isinstance(facts, (types.sequence, types.array)):
        return [filled(facts.subtype, value) for value in values]
    return values


def plain(value: Any) -> Any:
    """What JSON has no form of: a message as its fields, bytes as numbers."""
    return list(value) if isinstance(value, bytes) else {name: getattr(value, name) for name in value.__annotations__}


class Peer:
    """The participant with its readers and writers."""

    def __init__(self, domain: int) -> None:
        self._participant = DomainParticipant(domain)
        self._publications = builtin.BuiltinDataReader(self._participant, builtin.BuiltinTopicDcpsPublication)
        self._topics: dict[str, str] = {}
        self._types: dict[str, type[IdlStruct]] = {}
        self._readers: dict[tuple[str, str], DataReader] = {}
        self._writers: dict[str, DataWriter] = {}

    def obey(self, command: dict[str, Any]) -> None:
        """Carry out a command."""
        if "list" in command:
            answer({"topics": self._topics})
        elif "read" in command:
            topic = command["read"]
            qos = command["qos"]
            self._readers[topic, qos] = DataReader(self._participant, self._topic(topic, command), qos=READER_QOS[qos])
        else:
            topic = command["write"]
            if topic not in self._writers:
                qos = READER_QOS["default"]  # fits that of a publisher as well
                self._writers[topic] = DataWriter(self._participant, self._topic(topic, command), qos=qos)
            self._writers[topic].write(filled(self._types[command["type"]], command["message"]))

    def look(self) -> None:
        """Take what has come."""
        for one in self._publications.take(1000):
            # no name of a publication that is gone; mangled ones: design.ros2.org/articles/topic_and_service_names
            if (one.topic_name or "").startswith("rt/"):
                self._topics[one.topic_name[2:]] = one.type_name.replace("::dds_::", "/").replace("::", "/").rstrip("_")
        for (topic, qos), reader in list(self._readers.items()):
            messages = [one for one in reader.take(1) if isinstance(one, IdlStruct)]
            if messages:
                del self._readers[topic, qos]
                answer({"heard": topic, "qos": qos, "message": messages[0]})

    def _topic(self, name: str, command: dict[str, Any]) -> Topic:
        kind = command["type"]
        if kind not in self._types:
            self._types[kind] = make_type(kind, command["definition"])
        return Topic(self._participant, f"rt{name}", self._types[kind])


def answer(value: dict[str, Any]) -> None:
    """Print a line."""
    print(json.dumps(value, default=plain), flush=True)


def main() -> None:
    """Obey commands until standard input is closed."""
    commands: queue.SimpleQueue[str] = queue.SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            commands.put(line)
        commands.put("")

    threading.Thread(target=listen, daemon=True).start()
    peer = Peer(int(sys.argv[1]))
    while True:
        while not commands.empty():
            line = commands.get()
            if not line:
                return
            peer.obey(json.loads(line))
        peer.look()
        time.sleep(POLL_PERIOD)


if __name__ == "__main__":
    main()
