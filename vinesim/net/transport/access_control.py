"""TLS and access control of Zenoh: keys that each certificate may publish, subscribe to and query. All else is denied.

Every actor has a certificate with its name as common name. It may subscribe to its whole world, query, and publish only
under keys that end with its own name. A robot also offers its meshes to the server, under its own name. A spectator
publishes only its presence, its hello, its viewpoint and its voice. The router applies the rules, so a message under a
foreign key ends there.
"""

from __future__ import annotations

import enum
import pathlib
from collections.abc import Mapping
from typing import Any

from vinesim.net.codec.messages import FAMILIES
from vinesim.net.transport.bus import BusError

SERVER = "server"
"""Common name of all servers: nothing is denied between them."""

CA_NAME = "ca"
"""Common name of the certificate authority, and stem of its files."""


class Role(enum.StrEnum):
    """Role of the holder of a certificate."""

    ROBOT = "robot"
    HUMAN = "human"
    SPECTATOR = "spectator"
    SERVER = "server"


class CertificateError(BusError):
    """A certificate or key is missing or unusable; the text names it."""


_EVERYTHING = [
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
]


def authority_folder(folder: pathlib.Path) -> pathlib.Path:
    """Default folder of the authority's key for a folder of certificates."""
    folder = folder.absolute() if not folder.name else folder
    return folder.with_name(f"{folder.name}-authority")


def refuse_authority_key(folder: pathlib.Path) -> None:
    """Raise :class:`CertificateError` if the key of the authority lies in a folder of certificates."""
    if (folder / f"{CA_NAME}.key").exists():
        place = authority_folder(folder)
        raise CertificateError(
            f"{folder / CA_NAME}.key: who has it can make certificates for every name, so no server or client may hold "
            f"it: mkdir -m 700 {place} && cp {folder}/{CA_NAME}.pem {place}/ && mv {folder}/{CA_NAME}.key {place}/"
        )


def tls_config(folder: pathlib.Path, name: str) -> dict[str, Any]:
    """Settings of a session with the certificate of ``name`` that trusts only what ``folder/ca.pem`` signed."""
    refuse_authority_key(folder)
    authority, certificate, key = (folder / file for file in (f"{CA_NAME}.pem", f"{name}.pem", f"{name}.key"))
    for file in (authority, certificate, key):
        if not file.is_file():
            raise CertificateError(
                f"no {file}: make it with 'vinesim certs new {name} --dir {folder}' where the authority's key is, "
                f"and copy {authority.name}, {certificate.name} and {key.name} here"
            )
    return {
        "transport__link__tls": {
            "root_ca_certificate": str(authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "listen_private_key": str(key),
            "listen_certificate": str(certificate),
            "connect_private_key": str(key),
            "connect_certificate": str(certificate),
        }
    }


def server_answers_config(root: str) -> dict[str, Any]:
    """Access control of a server without certificates under ``root`` (like ``vs/1``): no other program that connects to
    the server can answer queries that actors send to the server."""
    questions = [f"{root}/*/{question}" for question in ("clock/**", "join/**", "snap/**")]
    rule = {
        "id": "answers of the server",
        "permission": "deny",
        "flows": ["ingress"],
        "messages": ["declare_queryable", "reply"],
        "key_exprs": questions,
    }
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "allow",
            "rules": [rule],
            "subjects": [{"id": "all"}],
            "policies": [{"rules": [rule["id"]], "subjects": ["all"]}],
        }
    }


def acl_config(root: str, actors: Mapping[str, Role]) -> dict[str, Any]:
    """Access control of a router for the one world under ``root`` (like ``vs/1/vineyard``)."""
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def rule(name: str, flow: str, messages: list[str], *keys: str) -> str:
        rules.append(
            {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": list(keys)}
        )
        return name

    world = f"{root}/**"
    receiving = [
        rule("receive", "egress", ["put", "delete", "reply", "liveliness_token"], world),
        rule(
            "subscribe", "ingress", ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"], world
        ),
        rule("query", "ingress", ["query"], f"{root}/hello/*", f"{root}/snap/*/*", f"{root}/mesh/*"),
        rule("be queried", "egress", ["query"], f"{root}/hello/*"),
        # without the declarations of subscribers a publisher would never match and never send
        rule("see queryables", "egress", ["declare_queryable"], world),
        rule("see subscribers", "egress", ["declare_subscriber"], world),
    ]
    for name, role in sorted(actors.items()):
        if role == Role.SERVER:
            continue
        about_itself = (f"{root}/live/{name}/*", f"{root}/hello/{name}")
        own = [
            rule(f"{name} is there", "ingress", ["liveliness_token", "declare_queryable", "reply"], *about_itself),
            rule(
                f"{name} asks to be let in, and the time",
                "ingress",
                ["query"],
                f"{root}/join/{name}/*",
                f"{root}/clock/{name}",
            ),
        ]
        if role == Role.ROBOT:
            own.append(rule(f"{name} offers its meshes", "ingress", ["query"], f"{root}/offer/{name}"))
        written = [
            f"{root}/{key.format(actor=name)}"
            for family in FAMILIES.values()
            if family.is_published and (family.by_spectators or role != Role.SPECTATOR)
            for key in family.keys
        ]
        own.append(rule(f"{name} writes", "ingress", ["put", "delete"], *written))
        policies.append({"rules": receiving + own, "subjects": [name]})
    everything = [rule(f"servers {flow}", flow, _EVERYTHING, "**") for flow in ("ingress", "egress")]
    policies.append({"rules": everything, "subjects": [SERVER]})
    subjects = [{"id": name, "cert_common_names": [name]} for name in sorted({*actors, SERVER})]
    subjects = [subject for subject in subjects if actors.get(subject["id"]) != Role.SERVER or subject["id"] == SERVER]
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        }
    }
