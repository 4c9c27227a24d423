"""Corrupts files of every kind that vinesim reads, and counts what its readers do.

They refuse a file with one line, accept it, end in a traceback, accept wrong content, or hang. What counts as wrong
depends on the kind. Caches, journals and recordings have checksums: all that is read must be what was written. A text
with another number is another valid text: what is read must keep the laws of its kind.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import os
import pathlib
import random
import re
import signal
import tempfile
import threading
import time
import types
from collections.abc import Callable, Iterator, Mapping

import msgspec
import numpy as np
from mcap.writer import Writer

from vinesim.client.recording.replay import Playhead
from vinesim.core import disk_cache
from vinesim.core.bag_files import BagError, open_bag
from vinesim.core.data_files import data_dir, user_folders
from vinesim.core.toml_loader import DataError
from vinesim.net.codec.control import Hello, RetainedRecord, encode_hello, encode_records
from vinesim.net.codec.messages import describe_message
from vinesim.net.recording.mcap_reader import InvalidRecording, read_recording
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.replication.retained import RetainedState
from vinesim.net.server.admission import SceneId
from vinesim.net.server.journal import Journal, JournalError
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.sidecar import read_sidecar
from vinesim.robot.description.urdf import DescriptionError
from vinesim.scene import scene_limits
from vinesim.scene.ids import ObjectKind, object_id
from vinesim.scene.plant_import.imported_plant import ImportedPlant, import_plant, load_imported_plant
from vinesim.scene.plant_import.skeleton import MAX_HEIGHT
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Measurement

COUNT = 10_000
"""Number of corrupted files of each kind."""
DEADLINE = 10.0
"""Time after which a reader counts as hanging [s]."""
MAX_LINE = 2000
"""Largest number of letters of the line with which a file is refused."""

_NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][\w-]*")
_EXTREMES = (
    b"0",
    b"-1",
    b"1e300",
    b"-1e300",
    b"1e-300",
    b"nan",
    b"inf",
    b"99999999999999999999",
    b"",
    b"1.5",
    b"x",
    b"1" * 400,
)


class WrongContent(Exception):
    """A reader accepted a corrupted file, and what it read contradicts what was written or a law."""


class _Hang(BaseException):
    pass


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of file: its valid samples, and its reader."""

    suffix: str
    samples: tuple[bytes, ...]
    read: Callable[[pathlib.Path], bool]
    """Reads a file and checks what it says. Returns whether the file was accepted. Raises :class:`WrongContent`."""
    refusals: tuple[type[Exception], ...] = ()
    """Errors with one line with which the reader refuses a file."""
    is_text: bool = True


@dataclasses.dataclass(slots=True)
class Outcome:
    """Counts of the outcomes of one kind of file."""

    count: int = 0
    accepted: int = 0
    refused: int = 0
    tracebacks: int = 0
    wrong: int = 0
    hangs: int = 0
    slowest: float = 0.0
    """Longest time to read a file [s]."""
    failures: list[str] = dataclasses.field(default_factory=list)
    """For each traceback, wrong content and hang: the number of the file, and what happened."""


def corrupt(content: bytes, other: bytes, chance: random.Random, *, is_text: bool) -> bytes:
    """Returns a copy of ``content`` with one to three faults; some splice a part of ``other``."""
    data = bytearray(content)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        tokens = is_text and chance.random() < 0.5  # faults that leave the form of a text as it is
        data = _fault(data, other, chance, chance.randint(9, 11) if tokens else chance.randrange(14 if is_text else 9))
    return bytes(data)


def _fault(data: bytearray, other: bytes, chance: random.Random, how: int) -> bytearray:
    size = len(data)
    if not size:
        return bytearray(chance.randbytes(chance.randint(0, 40)))
    at = chance.randrange(size)
    length = min(chance.choice((1, 2, 4, 8, 30, 200)), size - at)
    if how == 0:
        data[at] ^= 1 << chance.randrange(8)
    elif how == 1:
        data[at] = chance.randrange(256)
    elif how == 2:
        del data[at:]
    elif how == 3:
        del data[at : at + length]
    elif how == 4:
        data[at:at] = data[at : at + length] * chance.choice((1, 1, 2, 20))
    elif how == 5:
        data[at:at] = chance.randbytes(length)
    elif how == 6:
        data[at : at + length] = bytes(length) if chance.random() < 0.5 else b"\xff" * length
    elif how == 7:
        start = chance.randrange(len(other))
        data[at : at + length] = other[start : start + length]
    elif how == 8:
        data += other[: chance.randrange(len(other))]
    elif how in (9, 10) and (numbers := list(_NUMBER.finditer(data))):
        found = chance.choice(numbers)
        data[found.start() : found.end()] = chance.choice(_EXTREMES)
    elif how == 11 and (words := list(_WORD.finditer(data))):
        one, two = chance.choice(words), chance.choice(words)
        data[one.start() : one.end()] = two[0]
    elif how == 12:
        lines = data.split(b"\n")
        one, two = chance.randrange(len(lines)), chance.randrange(len(lines))
        lines[one], lines[two] = lines[two], lines[one] if chance.random() < 0.5 else lines[two]
        data = bytearray(b"\n".join(lines))
    else:
        deep = chance.choice((100, 20_000))
        data[at:at] = chance.choice((b"[", b"{", b"(", b"<a>", b"a.")) * deep
    return data


def run(kind: Kind, count: int, seed: int, folder: pathlib.Path, first: int = 0) -> Outcome:
    """Read ``count`` corrupted files of a kind, in the main thread. The file of a number is the same for every
    ``count``."""
    path = folder / f"read{kind.suffix}" / f"file{kind.suffix}"  # beside no file that a reader might look for
    path.parent.mkdir(exist_ok=True)
    result = Outcome()
    for sample in kind.samples[:1]:
        path.write_bytes(sample)
        if not kind.read(path):
            raise WrongContent(f"a whole {kind.suffix} is refused")
    for number in range(first, first + count):
        chance = random.Random(f"{seed} {kind.suffix} {number}")
        content, other = chance.choice(kind.samples), chance.choice(kind.samples)
        path.write_bytes(corrupt(content, other, chance, is_text=kind.is_text))
        begin = time.perf_counter()
        trouble = ""
        try:
            with _deadline():
                accepted = kind.read(path)
            result.accepted += accepted
            result.refused += not accepted
        except kind.refusals as refused:
            line = str(refused)
            result.refused += 1
            if "\n" in line or not 0 < len(line) <= MAX_LINE:
                trouble = f"refused with {len(line)} letters in {line.count(chr(10)) + 1} lines: {line[:200]!r}"
                result.tracebacks += 1
        except WrongContent as wrong:
            result.wrong += 1
            trouble = f"wrong content: {wrong}"
        except _Hang:
            result.hangs += 1
            trouble = f"not read in {DEADLINE:g} s"
        except Exception as error:
            result.tracebacks += 1
            trouble = f"{type(error).__name__}: {str(error)[:200]} ({_place(error)})"
        result.slowest = max(result.slowest, time.perf_counter() - begin)
        result.count += 1
        if trouble:
            result.failures.append(f"{kind.suffix} {number}: {trouble}")
    return result


def _place(error: Exception) -> str:
    """Returns the innermost place in vinesim at which an error was raised."""
    places = []
    step = error.__traceback__
    while step is not None:
        places.append(f"{pathlib.Path(step.tb_frame.f_code.co_filename).name}:{step.tb_lineno}")
        step = step.tb_next
    return " ".join(places[-3:])


@contextlib.contextmanager
def _deadline() -> Iterator[None]:
    """Raise :class:`_Hang` in the main thread after :data:`DEADLINE`."""

    def ring(_: int, __: types.FrameType | None) -> None:
        raise _Hang

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, DEADLINE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


# ---------------------------------------------------------------- the kinds


def make_kinds(folder: pathlib.Path) -> dict[str, Kind]:
    """Returns all kinds of files by name. ``folder``: an empty folder for samples."""
    plants = user_folders()["examples"] / "plants"
    return {
        "cache": _cache(folder / "cache"),
        "journal": _journal(folder / "journal"),
        "recording": _recording(folder / "recording"),
        "bag": _bag(folder / "bag"),
        "scene": Kind(
            ".toml",
            (*(file.read_bytes() for file in sorted((data_dir() / "scenes").glob("*.toml"))), _FULL_SCENE),
            _read_scene,
            (DataError,),
        ),
        "urdf": Kind(".urdf", (_ROBOT,), _read_robot, (DescriptionError,)),
        "robot TOML": Kind(
            ".sidecar", ((data_dir() / "robots" / "vinebot.toml").read_bytes(),), _read_sidecar, (DescriptionError,)
        ),
        "mtg": Kind(".mtg", ((plants / "vine.mtg").read_bytes(),), _read_plant, (DataError,)),
        "ply": Kind(".ply", ((plants / "vine.ply").read_bytes(), _PLY, _binary_ply()), _read_plant, (DataError,)),
        "plant": Kind(".plant", ((plants / "vine.toml").read_bytes(),), _read_imported, (DataError,)),
    }


_ARRAYS: Mapping[str, np.ndarray] = {
    "a": np.arange(60, dtype=np.float32).reshape(20, 3),
    "b": np.array([True, False]),
    "c": np.array([], np.int64),
}


def _cache(folder: pathlib.Path) -> Kind:
    with _cache_in(folder):
        disk_cache.keep("file", "0", _ARRAYS)
        disk_cache.keep("file", "1", {"a": np.ones(5), "b": np.array([False, True])})
    samples = tuple((folder / f"file-{i}.npz").read_bytes() for i in range(2))

    def read(path: pathlib.Path) -> bool:
        (folder / "file-0.npz").write_bytes(content := path.read_bytes())
        lines = _Lines()
        with _cache_in(folder), lines:
            found = disk_cache.load("file", "0")
        if found is None:
            if len(lines.texts) != 1 or str(folder / "file-0.npz") not in lines.texts[0]:
                raise WrongContent(f"a broken file has the lines {lines.texts}")
            return False
        same = found.keys() == _ARRAYS.keys() and all(
            (found[name].dtype, found[name].shape, found[name].tobytes()) == (one.dtype, one.shape, one.tobytes())
            for name, one in _ARRAYS.items()
        )
        if not same or content != samples[0]:
            raise WrongContent("other arrays were read than were written")
        return True

    return Kind(".npz", samples, read, is_text=False)


class _Lines(logging.Handler):
    """Context manager that collects what vinesim logs."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())

    def __enter__(self) -> _Lines:
        self._log = logging.getLogger("vinesim")
        self._log.addHandler(self)
        self._was = self._log.propagate
        self._log.propagate = False
        return self

    def __exit__(self, *_: object) -> None:
        self._log.removeHandler(self)
        self._log.propagate = self._was


@contextlib.contextmanager
def _cache_in(folder: pathlib.Path) -> Iterator[None]:
    before = os.environ.get("VINESIM_CACHE")
    os.environ["VINESIM_CACHE"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["VINESIM_CACHE"]
        else:
            os.environ["VINESIM_CACHE"] = before


def _record(index: int, version: int, author: str = "ada") -> RetainedRecord:
    pose = (0.5 * index, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    return RetainedRecord(object_id(ObjectKind.BOX, index), version, 0, author, pose)


def _journal(folder: pathlib.Path) -> Kind:
    folder.mkdir()
    allowed = set()
    samples = []
    for world in ("w", "other"):
        with Journal(folder / f"{world}.facts", world, SceneId("vsp", "D1"), RetainedState()) as journal:
            for index, version in itertools.product(range(10), (1, 2)):
                cell, record = (index // 4, -index), _record(index, version, f"{world}-ada")
                journal.state.merge(cell, record)
                journal.append(cell, record)
                allowed.add((world, cell, record))
        samples.append((folder / f"{world}.facts").read_bytes())
        (folder / f"{world}.facts").unlink()

    def read(path: pathlib.Path) -> bool:
        content = path.read_bytes()
        for old in path.parent.glob(f"{path.name}.torn-*"):
            old.unlink()
        with _Lines():
            try:
                journal = Journal.load(path)
            except JournalError:
                if path.read_bytes() != content:
                    raise WrongContent("a journal that is refused was changed") from None
                raise
            journal.close()
            again = Journal.load(path)
            again.close()
        # a frame of another world may be spliced in whole: its checksum holds
        other = {(cell, record) for _, cell, record in allowed}
        for cell, record in journal.state:
            if (cell, record) not in other:
                raise WrongContent(f"record {record} was never written")
        if list(again.state) != list(journal.state):
            raise WrongContent("a repaired journal reads otherwise the second time")
        kept = [one.read_bytes() for one in path.parent.glob(f"{path.name}.torn-*")]
        if kept not in ([], [content]):
            raise WrongContent("the backup is not the original file")
        return not kept

    return Kind(".facts", tuple(samples), read, (JournalError,), is_text=False)


def _recording(folder: pathlib.Path) -> Kind:
    folder.mkdir()
    samples = []
    whole = []
    pose = encode_records([_record(0, 1)])
    for author in ("ada", "bob"):
        path = folder / f"{author}.mcap"
        entries = [
            (0, f"hello/{author}", encode_hello(Hello(author))),
            (0, f"live/{author}", b"\1"),
            *((i * 10**8, f"fact/0/{i}/{author}", encode_records([_record(i, 1, author)])) for i in range(20)),
            (10**9, "snap/0/0", pose),
        ]
        with RecordingWriter(path, {"scene": "demo", "world": "w"}) as file:
            for entry in entries:
                file.put(*entry)
        samples.append(path.read_bytes())
        whole.append({(key, payload) for _, key, payload in entries})
    allowed = whole[0] | whole[1]

    def read(path: pathlib.Path) -> bool:
        recording = read_recording(path)
        found = {(entry.key, entry.payload) for entry in recording.messages}
        if not recording.damage and not any(one <= found for one in whole):
            raise WrongContent(f"{len(found)} messages are read without a word about the others")
        for entry in recording.messages:
            describe_message(entry.key, entry.payload)
            if (entry.key, entry.payload) not in allowed:
                raise WrongContent(f"message {entry.key!r} with {len(entry.payload)} bytes was never written")
        if len(recording.messages):
            playhead = Playhead(recording)
            playhead.play(recording.start + recording.length)
        if "\n" in recording.damage:
            raise WrongContent("the message about the damage has several lines")
        return not recording.damage

    return Kind(".mcap", tuple(samples), read, (InvalidRecording,), is_text=False)


def _bag(folder: pathlib.Path) -> Kind:
    folder.mkdir()
    samples = []
    allowed = set()
    for topic in ("/joint_states", "/tf"):
        with (folder / "run.mcap").open("wb") as file:
            writer = Writer(file, chunk_size=300)
            writer.start(profile="ros2")
            channel = writer.register_channel(
                topic, "cdr", writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
            )
            for i in range(40):
                writer.add_message(channel, log_time=i, publish_time=i, data=f"{topic} {i}".encode() * 5)
                allowed.add((topic, i, f"{topic} {i}".encode() * 5))
            writer.finish()
        samples.append((folder / "run.mcap").read_bytes())
    topics = {topic for topic, _, _ in allowed}

    def read(path: pathlib.Path) -> bool:
        bag = open_bag(path)
        found = [(message.topic, message.time, message.data) for message in bag.messages()]
        for topic, at, data in found:
            # no checksum covers the summary, which has the names of the topics
            if (at, data) not in {one[1:] for one in allowed} and bag.topics.keys() <= topics:
                raise WrongContent(f"a message of {topic!r} with {len(data)} bytes was never written")
        if "\n" in bag.damage:
            raise WrongContent("the message about the damage has several lines")
        return not bag.damage

    return Kind(".bag", tuple(samples), read, (BagError,), is_text=False)


def _read_scene(path: pathlib.Path) -> bool:
    scene = load_scene(path)
    if excess := scene_limits.find_excess(msgspec.to_builtins(scene)):
        raise WrongContent(excess)
    if not (path.parent / f"{scene.name}.png").resolve().parent == path.parent.resolve():
        raise WrongContent(f"name {scene.name!r} leaves the folder")
    return True


def _read_robot(path: pathlib.Path) -> bool:
    with _Lines():
        robot = load_description(path)
    numbers = [robot.mass, *robot.home, *np.ravel(robot.fixed_poses)]
    if not np.isfinite(numbers).all() or not robot.mass > 0.0:
        raise WrongContent(f"the robot has mass {robot.mass} and home {robot.home}")
    return True


def _read_sidecar(path: pathlib.Path) -> bool:
    read_sidecar(path)
    return True


def _read_plant(path: pathlib.Path) -> bool:
    return _check_plant(import_plant(path))


def _read_imported(path: pathlib.Path) -> bool:
    return _check_plant(load_imported_plant.__wrapped__(str(path)))  # the file changes under the cache


def _check_plant(plant: ImportedPlant) -> bool:
    points = plant.skeleton()
    size = np.linalg.norm(points.position, axis=1)
    nodes = np.arange(len(size))
    held = (points.parent[1:] < nodes[1:]).all() and (points.parent[1:] >= 0).all()
    if not (held and size.max() <= MAX_HEIGHT + 1e-3 and (points.diameter > 0.0).all() and (points.bunch >= 0.0).all()):
        raise WrongContent("the plant is no tree of wood with diameters")
    return True


_FULL_SCENE = b"""name = "full"
seed = 3
training = "vsp"

[layout]
rows = 2
vines = 2
row_spacing = 2.5
vine_spacing = 1.2
height = 0.9
missing = [[0, 1]]

[terrain]
slope = 0.1
direction = 0.3
cell = 0.1
ruts = { depth = 0.06, width = 0.35, gauge = 1.1 }
roughness = { deviation = 0.01, wavelength = 2.0 }

[season]
leafiness = 0.8

[clutter]
straw = 0.5
posts = "mixed"

[fruit]
bunches = [3, 5]
varieties = ["italia"]
ripeness = [0.2, 0.9]

[sun]
hour = 10.5
day = 258

[wind]
mean = [1.0, 0.5, 0.0]
gusts = 0.3

[datum]
latitude = 41.6
longitude = 12.6

[[boxes]]
x = 1.0
y = 0.5
size = [0.6, 0.4, 0.24]

[[spawns]]
name = "left"
x = 0.5
y = 1.2

[physics]
gravity = 9.81
dt = 0.01
"""
_BODY = """<inertial><origin xyz="0 0 0.1"/><mass value="2.5"/><inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0"
 izz="0.02"/></inertial><collision><origin xyz="0 0 0.1"/><geometry><box size="0.2 0.1 0.2"/></geometry></collision>"""
_ROBOT = f"""<?xml version="1.0"?>
<robot name="small">
<link name="base_footprint"/>
<joint name="up" type="fixed"><parent link="base_footprint"/><child link="base"/><origin xyz="0 0 0.2"/></joint>
<link name="base">{_BODY}</link>
<link name="arm">{_BODY}</link>
<link name="hand">{_BODY}</link>
<link name="tip">{_BODY}</link>
<joint name="lift" type="prismatic"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.3" rpy="0 0 0.1"/>
<axis xyz="0 0 1"/><limit lower="0" upper="0.4" effort="200" velocity="0.5"/>
<dynamics damping="1" friction="0.5"/></joint>
<joint name="turn" type="revolute"><parent link="arm"/><child link="hand"/><origin xyz="0.1 0 0.2"/>
<axis xyz="0 1 0"/><limit lower="-1.5" upper="1.5" effort="30" velocity="2"/></joint>
<joint name="wrist" type="continuous"><parent link="hand"/><child link="tip"/><origin xyz="0.1 0 0.2"/>
<axis xyz="1 0 0"/><limit effort="10" velocity="3"/><mimic joint="turn" multiplier="0.5"/></joint>
</robot>
""".encode()


def _ply_rows() -> list[tuple[float, float, float, float, int]]:
    return [(0.03 * i, 0.01 * (i % 3), 0.1 * i, 0.03 - 0.001 * i, i - 1) for i in range(14)] + [
        (0.2, 0.05, 0.5, 0.008, 4)
    ]


def _ply_head(form: str) -> str:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "diameter"))
    return f"ply\nformat {form} 1.0\nelement vertex {len(_ply_rows())}\n{names}property int parent\nend_header\n"


_PLY = (_ply_head("ascii") + "".join(" ".join(map(str, row)) + "\n" for row in _ply_rows())).encode()


def _binary_ply() -> bytes:
    kind = [(name, "<f4") for name in ("x", "y", "z", "diameter")] + [("parent", "<i4")]
    return _ply_head("binary_little_endian").encode() + np.array(_ply_rows(), kind).tobytes()


def file_fuzz(
    count: int = COUNT, seed: int = 1, first: int = 0, kinds: str = "", announce: Callable[[str], None] = print
) -> Iterator[Measurement]:
    """Measure what the readers of all ``kinds`` of files (names with commas between them; empty: all) do with ``count``
    corrupted files each, from number ``first`` on."""
    memory = pathlib.Path("/dev/shm")  # journals are forced to the disk, which costs most of the time
    with tempfile.TemporaryDirectory(prefix="vinesim-fuzz-", dir=memory if memory.is_dir() else None) as name:
        folder = pathlib.Path(name)
        for kind, made in make_kinds(folder).items():
            if kinds and kind not in kinds.split(","):
                continue
            done = run(made, count, seed, folder, first)
            for line in done.failures:
                announce(line)
            for what, value, unit in (
                ("corrupted files", done.count, ""),
                ("refused with one line", done.refused, ""),
                ("accepted", done.accepted, ""),
                ("tracebacks", done.tracebacks, ""),
                ("wrong content accepted", done.wrong, ""),
                (f"not read in {DEADLINE:g} s", done.hangs, ""),
                ("slowest file", 1e3 * done.slowest, "ms"),
            ):
                yield Measurement("file_fuzz", f"{kind}: {what}", float(value), unit)
