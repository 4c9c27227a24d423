"""Settings of Zenoh's TLS and access control: which keys the holder of a certificate may publish, subscribe to and
query.

The common name of an actor's certificate is the name of the actor. An actor may subscribe to its whole world, send
queries, and publish only under keys that contain its own name. A robot may also offer its meshes to the server. A
spectator may only publish its presence, its hello, its viewpoint and its voice. Everything else is denied. The router
applies the rules, so it drops a message under the key of another actor.
"""

from __future__ import annotations

import enum
import pathlib
from collections.abc import Mapping
from typing import Any

from vinesim.net.codec.messages import FAMILIES
from vinesim.net.transport.bus import BusError

SERVER = "server"
"""Common name in the certificates of all servers. The router denies servers nothing."""

CA_NAME = "ca"
"""Name of the certificate authority, after which its files ``ca.pem`` and ``ca.key`` are named."""


class Role(enum.StrEnum):
    """Role of the holder of a certificate, which determines what the holder may publish."""

    ROBOT = "robot"
    HUMAN = "human"
    SPECTATOR = "spectator"
    SERVER = "server"


class CertificateError(BusError):
    """A certificate or key is missing or unusable. The text names the file and what to do."""


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
    """Returns the default folder of the authority's key, for a ``folder`` of certificates."""
    folder = folder.absolute() if not folder.name else folder
    return folder.with_name(f"{folder.name}-authority")


def refuse_authority_key(folder: pathlib.Path) -> None:
    """Raise :class:`CertificateError` if a folder of certificates contains the key of the authority."""
    if (folder / f"{CA_NAME}.key").exists():
        place = authority_folder(folder)
        raise CertificateError(
            f"{folder / CA_NAME}.key: whoever has it can make certificates for every name, so no server or client may "
            f"have it: mkdir -m 700 {place} && cp {folder}/{CA_NAME}.pem {place}/ && mv {folder}/{CA_NAME}.key {place}/"
        )


def tls_config(folder: pathlib.Path, name: str) -> dict[str, Any]:
    """Returns Zenoh's TLS settings for the certificate of ``name`` in ``folder``. Only certificates of the authority
    ``folder/ca.pem`` are trusted. Raises :class:`CertificateError` if a file is missing."""
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
    """Returns Zenoh's settings of access control for a server without certificates.

    The settings keep other programs that connect to the server from answering queries that actors send to the server.
    ``root``: first chunks of all keys, like ``vs/1``.
    """
    questions = [f"{root}/*/{question}" for question in ("clock/**", "join/**", "holder/**", "snap/**", "server/**")]
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
    """Returns Zenoh's settings of access control for a server with certificates.

    ``root``: first chunks of the keys of its only world, like ``vs/1/vineyard``. ``actors``: roles of all certificates
    by name.
    """
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
        rule(
            "query",
            "ingress",
            ["query"],
            f"{root}/hello/*",
            f"{root}/robot/*",
            f"{root}/holder/*",
            f"{root}/snap/*/*",
            f"{root}/mesh/*",
        ),
        rule("be queried", "egress", ["query"], f"{root}/hello/*", f"{root}/robot/*"),
        # without declarations of subscribers publishers would never match, and never send
        rule("see queryables", "egress", ["declare_queryable"], world),
        rule("see subscribers", "egress", ["declare_subscriber"], world),
    ]
    for name, role in sorted(actors.items()):
        if role == Role.SERVER:
            continue
        about_itself = (f"{root}/live/{name}/*", f"{root}/hello/{name}", f"{root}/robot/{name}")
        own = [
            rule(f"{name} is there", "ingress", ["liveliness_token", "declare_queryable", "reply"], *about_itself),
            rule(
                f"{name} asks for the server, to be let in, and the time",
                "ingress",
                ["query"],
                f"{root}/join/{name}/*",
                f"{root}/clock/{name}",
                f"{root}/server/{name}",
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
