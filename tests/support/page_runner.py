"""Runs the blocks of pages as a reader does: by a shell, in the folder that the page names."""

from __future__ import annotations

import contextlib
import pathlib
import re
import signal
import subprocess
import threading
from collections.abc import Iterator, Mapping

from tests.support.page_blocks import Block
from tests.support.reader_files import bring
from tests.support.waiting import deadline

LASTS = re.compile(
    r"vinesim (?:server|client|record (?!.*--seconds)|replay (?!.*--out)(?!.*--ros)|dataset .*--images 1000)"
    r"|vinesim ros (?:record|hz|echo (?!.*--once)|pub (?!.*--once))|python examples/ros/"
)
"""Commands that a reader ends."""

READY = re.compile(
    r"listening on|\d Hz|\bin a browser: |publishing to |recording (?:world|into)|\b[1-9]\d* of 1000"
    r"|^waiting for /battery_state$|^soft$|\bbunch at x |^x \S+ m, y |^bunch_\d+: \w+ hand, from ",
    re.M,
)
"""What a lasting command prints when it does its work."""

HERE = {"HOST": "127.0.0.1", "10.0.0.1": "127.0.0.1"}
"""Placeholders of pages for the address of a server, and the address of this machine."""


class Lasting:
    """A command that runs until :meth:`end`, with its output."""

    def __init__(self, line: str, folder: pathlib.Path, environment: Mapping[str, str]) -> None:
        self._line = line
        self._output: list[str] = []
        self._ready = threading.Event()
        self._process = subprocess.Popen(
            ["bash", "-c", f"exec {line}"],
            cwd=folder,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for text in self._process.stdout:
            self._output.append(text)
            if READY.search(text):
                self._ready.set()
        self._ready.set()  # it has ended; wait_until_ready reports this

    def output(self) -> str:
        return f"{self._line}\n{''.join(self._output)}"

    def wait_until_ready(self) -> None:
        """Wait until the command prints that it works."""
        assert self._ready.wait(deadline(180.0)), f"not ready: {self.output()}"
        assert READY.search("".join(self._output)), f"ended: {self.output()}"

    def end(self) -> None:
        """Send SIGINT, as Ctrl-C does, and wait for the end, which is clean."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            code = self._process.wait(deadline(60.0))
        except subprocess.TimeoutExpired:
            self._process.kill()
            raise AssertionError(f"SIGINT does not end it: {self.output()}") from None
        self._reader.join(deadline(10.0))
        assert code in (0, 130), f"exit code {code}: {self.output()}"
        assert "Traceback" not in self.output(), self.output()


@contextlib.contextmanager
def _started(line: str, folder: pathlib.Path, environment: Mapping[str, str]) -> Iterator[None]:
    """A lasting command that is ready, until the context is left."""
    running = Lasting(line, folder, environment)
    try:
        running.wait_until_ready()
        yield
    finally:
        running.end()


def run_line(line: str, folder: pathlib.Path, environment: Mapping[str, str]) -> None:
    """Run a command that ends by itself."""
    command = ["bash", "-e", "-c", line]
    done = subprocess.run(
        command,
        cwd=folder,
        env=dict(environment),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=deadline(600.0),
        check=False,
    )
    said = f"{line}\n{done.stdout[-4000:]}{done.stderr[-4000:]}"
    assert done.returncode == 0, f"exit code {done.returncode}: {said}"
    assert "Traceback" not in done.stderr, said


def run_script(block: Block, folder: pathlib.Path, environment: Mapping[str, str]) -> None:
    """Run a block in one shell, so that an environment that it activates remains active to its end."""
    run_line(block.text, folder, environment)


def run_shell(block: Block, folder: pathlib.Path, environment: Mapping[str, str]) -> None:
    """Run the commands of a block: lasting ones side by side until the block's end. Where the page has no server of its
    own, one is there."""
    lines = block.lines()
    own_server = any("vinesim server" in line for line in lines)
    with contextlib.ExitStack() as running:
        for line in block.beside:
            running.enter_context(_started(line, folder, environment))
        if not own_server and any("--connect" in line for line in lines):
            running.enter_context(_started("vinesim server", folder, environment))
        for printed in lines:
            line = printed
            for name, address in HERE.items():
                line = re.sub(rf"\b{re.escape(name)}\b", address, line)
            bring(line, folder)
            if LASTS.search(line):
                running.enter_context(_started(line, folder, environment))
            else:
                run_line(line, folder, environment)


def run_python(block: Block, folder: pathlib.Path, environment: Mapping[str, str]) -> None:
    """Run a block of Python as a script, which prints something."""
    bring(block.text, folder)
    (folder / "block.py").write_text(block.text)
    command = ["python", "block.py"]
    done = subprocess.run(
        command, cwd=folder, env=dict(environment), capture_output=True, text=True, timeout=deadline(600.0), check=False
    )
    assert done.returncode == 0, f"{block}\n{done.stdout}{done.stderr}"
    assert done.stdout.strip() or "print(" not in block.text, block.text
