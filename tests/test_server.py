"""The server: carries, counts, tells the time, and says clearly when it cannot."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import pytest

from vinesim.net import messages
from vinesim.net.server import PortTaken, Server
from vinesim.net.zenoh_bus import ZenohBus


def wait(condition, what: str) -> None:
    end = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < end, f"waited in vain for: {what}"
        time.sleep(0.002)


def test_a_free_port_is_chosen_and_reported():
    with Server("tcp/127.0.0.1:0") as first, Server("tcp/127.0.0.1:0") as second:
        ports = [int(server.endpoint.rpartition(":")[2]) for server in (first, second)]
        assert all(1024 < port < 65536 for port in ports)
        assert ports[0] != ports[1]
        with ZenohBus("ada", connect=first.endpoint), ZenohBus("ada", connect=second.endpoint):
            wait(lambda: first.actors == second.actors == ["vineyard/ada"], "both rosters")


def test_a_taken_port_is_one_clear_line():
    with Server("tcp/127.0.0.1:0") as running:
        with pytest.raises(PortTaken, match="already in use") as caught:
            Server(running.endpoint)
        assert running.endpoint in str(caught.value)
        assert "another port" in str(caught.value)
        assert "\n" not in str(caught.value)
    Server(running.endpoint).close()


@pytest.mark.parametrize("endpoint", ["", "7447", "udp/127.0.0.1:0", "tcp/127.0.0.1", "tcp/:x", "tcp/1.2.3.4:99999"])
def test_what_is_no_endpoint_is_refused(endpoint):
    with pytest.raises(ValueError, match=r"expected tcp/HOST:PORT"):
        Server(endpoint)


def test_the_roster_follows_who_comes_and_goes():
    with Server("tcp/127.0.0.1:0") as server:
        with ZenohBus("ada", connect=server.endpoint), ZenohBus("bob", connect=server.endpoint, world="row-2"):
            wait(lambda: server.actors == ["row-2/bob", "vineyard/ada"], "two actors")
        wait(lambda: server.actors == [], "nobody")
        assert server.joined == 2


def test_the_clock_answers_with_the_time_of_day():
    with Server("tcp/127.0.0.1:0") as server, ZenohBus("ada", connect=server.endpoint) as ada:
        ada.ask("clock", b"nonsense")
        ada.ask("clock", messages.encode_time(12.5))
        answers: list = []
        wait(lambda: answers.extend(ada.answers()) or answers, "the time")
        asked, told = messages.decode_time(answers[0].payload)
        assert asked == 12.5
        assert abs(told - time.time()) < 10.0
        assert (server.pings, server.malformed) == (1, 1)


def test_run_returns_when_stopped():
    with Server("tcp/127.0.0.1:0") as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        assert thread.is_alive()
        server.stop()
        thread.join(timeout=10.0)
        assert not thread.is_alive()
    server.close()


def test_the_server_simulates_nothing():
    heavy = {"warp", "mujoco", "vinesim.physics", "vinesim.kernels"}
    code = f"import sys, vinesim.net.server; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"
