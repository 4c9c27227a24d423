"""Secrets in the addresses of pages: only who knows the address that a client prints can open its page.

Other users of a machine, and sites that are open in the same browser, can reach the port of a page, but do not know its
secret. The secret is a part of the path, not a cookie: cookies are shared by all ports of a machine, and browsers do
not send them from a frame in a notebook.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import pathlib
import secrets

from vinesim.core import disk_cache

SIZE = 32
"""Size of the secret from which those of pages follow [B]."""
_LENGTH = 32
"""Number of hexadecimal digits in the address of a page: 128 bits."""


def new_token() -> str:
    """Returns a secret for one run."""
    return secrets.token_hex(_LENGTH // 2)


def lasting_token(port: int) -> str | None:
    """Returns the secret of pages of this user on a port of this machine.

    It is the same in every run, so that an open page finds a client that was restarted on the same port. It follows
    from a file in the folder for caches that only this user can read: without the file, all addresses are new. None if
    the file can neither be read nor made.
    """
    try:
        with disk_cache.exclusive("page-secret", timeout=5.0):
            key = _read_or_make(disk_cache.folder() / "page-secret")
    except (OSError, RuntimeError):  # the folder cannot be written, or there is no home folder
        return None
    return hmac.new(key, f"page {port}".encode(), hashlib.sha256).hexdigest()[:_LENGTH]


def lasting_address(port: int) -> str | None:
    """Returns the address of the page that a client of this user will serve on a port of this machine, for the program
    that starts the client; None as for :func:`lasting_token`."""
    token = lasting_token(port)
    return None if token is None else f"http://127.0.0.1:{port}/{token}/"


def _read_or_make(path: pathlib.Path) -> bytes:
    with contextlib.suppress(FileNotFoundError):
        key = path.read_bytes()
        status = path.stat()
        is_private = os.name == "nt" or (status.st_mode & 0o077 == 0 and status.st_uid == os.getuid())
        if len(key) == SIZE and is_private:
            return key
        path.unlink()
    path.parent.mkdir(parents=True, exist_ok=True)
    key = secrets.token_bytes(SIZE)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(key)
    return key
