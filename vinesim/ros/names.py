"""Names that ROS allows: conversion of names of actors, and checks of namespaces. Needs no ROS."""

from __future__ import annotations

import re

from vinesim.core.errors import UsageError

MAX_NAMESPACE = 244
"""Largest number of characters of a namespace, without the slash in front (rmw)."""


def ros_name(actor: str) -> str:
    """Convert an actor's name to a name that ROS allows in topics and for nodes. All characters but ASCII letters,
    digits and underscores become underscores. A name that is empty or starts with a digit gets an underscore in
    front."""
    return re.sub(r"^(?=\d|$)", "_", re.sub(r"\W", "_", actor, flags=re.ASCII))


def ros_namespace(text: str) -> str:
    """Returns a namespace without slashes at its ends or beside one another, so ``/north/`` is ``north`` and ``/`` is
    empty, the root. Raises :class:`vinesim.core.errors.UsageError` for one that ROS does not allow."""
    parts = [part for part in text.split("/") if part]
    wrong = next((part for part in parts if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", part)), None)
    if wrong is not None:
        similar = "/".join(map(ros_name, parts))
        raise UsageError(
            f"--namespace {text!r} is no ROS namespace: {wrong!r} has other characters than ASCII letters, digits and "
            f"_, or begins with a digit; give for example {similar}"
        )
    if len(namespace := "/".join(parts)) > MAX_NAMESPACE:
        raise UsageError(
            f"--namespace {text[:40]!r}... is no ROS namespace: it has {len(namespace)} characters; give at most "
            f"{MAX_NAMESPACE}"
        )
    return namespace
