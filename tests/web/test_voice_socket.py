"""The socket of sound: frames both ways, a page that stalls, and what is no sound."""

import asyncio
import json

import aiohttp
import pytest

from tests.web.test_page_server import CountingWorld
from vinesim.audio.frame import Codec
from vinesim.web.page_server import PageServer
from vinesim.web.voice_socket import EXTRA, FRAME_HEADER, MAX_WAITING, encode_frame

OPUS = bytes((72,)) + bytes(40)
PCM = bytes(640)


class Room:
    """Stands for the client."""

    def __init__(self):
        self.pages = []
        self.said = []

    def join(self, page):
        self.pages.append(page)

    def leave(self, page):
        self.pages.remove(page)

    def speak(self, page, codec, data, is_main):
        self.said.append((codec, len(data), is_main))


@pytest.fixture
def served():
    room = Room()
    with PageServer(CountingWorld(), sound=room) as server:
        yield room, server


def talk(server, conversation):
    async def page():
        async with aiohttp.ClientSession() as session, session.ws_connect(server.address + "voice") as socket:
            await conversation(socket)

    asyncio.run(page())


async def until(condition):
    while not condition():
        await asyncio.sleep(0.002)


def test_frames_go_both_ways(served):
    room, server = served

    async def conversation(socket):
        await socket.send_json({"opus": True})
        for message in (bytes((1,)) + OPUS, bytes((2 + EXTRA,)) + PCM):
            await socket.send_bytes(message)
        await until(lambda: len(room.said) == 2)
        room.pages[0].send(encode_frame("bot", 7, Codec.PCM16, PCM, (1.0, 2.0, 3.0)))
        frame = (await socket.receive()).data
        codec, length, number, *place = FRAME_HEADER.unpack_from(frame)
        assert (codec, number, place) == (2, 7, [1.0, 2.0, 3.0])
        assert frame[FRAME_HEADER.size :] == b"bot" + PCM
        assert length == 3
        room.pages[0].send("{}")
        assert json.loads((await socket.receive()).data) == {}

    talk(server, conversation)
    assert room.said == [(Codec.OPUS, 41, True), (Codec.PCM16, 640, False)]
    assert server.voice.refused == 0


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"\x01",
        b"\x02" + bytes(639),
        b"\x07" + PCM,
        b"\x01" + b"\xff" * 60,
        "no json",
        "[]",
        '{"opus": 1}',
        "{}",
        '{"opus": true, "more": 1}',
        "[" * 300,
    ],
)
def test_what_is_no_sound_is_counted_and_nothing_else_happens(served, message):
    room, server = served

    async def conversation(socket):
        await socket.send_json({"opus": False})
        await (socket.send_str(message) if isinstance(message, str) else socket.send_bytes(message))
        await until(lambda: server.voice.refused)
        await socket.send_bytes(b"\x02" + PCM)
        await until(lambda: room.said)

    talk(server, conversation)
    assert room.said == [(Codec.PCM16, 640, True)]


def test_a_flood_is_refused_and_a_message_that_is_too_long_ends_the_connection(served):
    room, server = served

    async def conversation(socket):
        await socket.send_json({"opus": False})
        for _ in range(1000):
            await socket.send_bytes(b"\x02" + PCM)
        await until(lambda: len(room.said) + server.voice.refused >= 1000)
        assert server.voice.refused > 100
        await socket.send_bytes(bytes(5000))
        assert (await socket.receive()).type in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED)
        await until(lambda: not room.pages)

    talk(server, conversation)


def test_frames_for_a_page_that_takes_none_are_dropped_and_counted(served):
    room, server = served

    async def conversation(socket):
        await socket.send_json({"opus": True})
        await until(lambda: room.pages)
        voice = room.pages[0]
        # nothing wakes the sender
        loop = voice._loop
        voice._loop = asyncio.new_event_loop()
        for number in range(3 * MAX_WAITING):
            voice.send(encode_frame("bot", number, Codec.PCM16, PCM, (0.0, 0.0, 0.0)))
        assert voice.dropped == 2 * MAX_WAITING
        voice._loop.close()
        voice._loop = loop
        voice.send("end")
        frame = (await socket.receive()).data
        assert FRAME_HEADER.unpack_from(frame)[2] == 2 * MAX_WAITING + 1, "the newest are kept"

    talk(server, conversation)
