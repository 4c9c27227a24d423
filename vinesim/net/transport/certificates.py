"""Certificates for secured links: one authority, one certificate for each actor.

``server.pem`` and ``server.key`` are the files of the server, ``NAME.pem`` and ``NAME.key`` those of an actor. An actor
needs only its two files and ``ca.pem``. The key of the authority, ``ca.key``, is in a folder of its own. Whoever has
this key can make certificates for every name, so servers and clients refuse a folder that contains it. The
organisational unit of a certificate is the role of its holder. Keys are elliptic (P-256), and only their owner can read
the files.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
import pathlib
import socket
from collections.abc import Sequence

from vinesim.core.errors import UsageError
from vinesim.net.codec.header import is_valid_name
from vinesim.net.transport.access_control import (
    CA_NAME,
    SERVER,
    CertificateError,
    Role,
    authority_folder,
    refuse_authority_key,
)

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    _missing: ImportError | None = error
else:
    _missing = None

AUTHORITY_YEARS = 10
"""Validity of the certificate of an authority [a]."""
CERTIFICATE_DAYS = 825
"""Validity of the certificate of an actor or a server [d]."""
WARNING_DAYS = 30
"""Time before the expiry of a certificate at which warnings begin [d]."""


class CryptographyMissing(RuntimeError):
    """The library that makes and checks certificates is not installed."""

    exit_code = 3

    def __init__(self) -> None:
        super().__init__("certificates need the library cryptography: pip install 'vinesim[tls]'")


def create(
    folder: pathlib.Path,
    name: str,
    role: Role = Role.ROBOT,
    hosts: Sequence[str] = (),
    days: float = CERTIFICATE_DAYS,
    authority: pathlib.Path | None = None,
    permitted: Sequence[str] = (),
) -> list[pathlib.Path]:
    """Create the certificate of an actor and, at first use, the certificates of the authority and the server.

    Returns the paths of the files that were written.

    ``hosts``: if ``name`` is ``server``, names and addresses under which clients reach the server, besides those of
    this machine. The server's certificate is then replaced. ``days``: validity [d]. ``authority``: folder of
    ``ca.key``, by default ``folder`` with ``-authority`` appended. ``permitted``: names of hosts, addresses and
    networks for which a new authority may sign (RFC 5280, name constraints); without them it may sign for every host.

    Raises :class:`CertificateError` if the actor already has a certificate, and
    :class:`vinesim.core.errors.UsageError` for an invalid name or role.
    """
    if _missing is not None:
        raise CryptographyMissing from _missing
    if not is_valid_name(name) or name == CA_NAME:
        raise UsageError(f"actor name {name!r}: use 1 to 48 letters, digits, '_', '-' or '.', and not {CA_NAME!r}")
    if (name == SERVER) != (role == Role.SERVER):
        raise UsageError(f"{name!r} as {role}: only the server is called {SERVER!r}")
    if hosts and role != Role.SERVER:
        raise UsageError(f"hosts {', '.join(hosts)} for {name!r}: only the server's certificate names hosts")
    if name != SERVER and (folder / f"{name}.pem").exists():
        raise CertificateError(f"{folder / name}.pem is there already: remove it and its key first, if that is meant")
    refuse_authority_key(folder)
    authority = authority_folder(folder) if authority is None else authority
    if authority.resolve() == folder.resolve():
        raise UsageError(
            f"--authority {authority}: give a folder of its own for {CA_NAME}.key, e.g. {folder}-authority"
        )
    try:
        for each in (authority, folder):
            each.mkdir(parents=True, exist_ok=True, mode=0o700)
        written = _authority_of(folder, authority, permitted)
        if name != SERVER and not (folder / f"{SERVER}.pem").exists():
            written += _signed(folder, authority, SERVER, Role.SERVER, (), days)
        return written + _signed(folder, authority, name, role, hosts, days)
    except OSError as error:
        place = error.filename or folder  # the error of a full disk names no file
        raise CertificateError(f"{place}: {error.strerror}: the certificate cannot be made there") from error


def may_sign_only_for(folder: pathlib.Path, permitted: Sequence[str]) -> bool:
    """Returns whether a folder has a certificate of an authority that may sign for ``permitted`` (as in
    :func:`create`), and for nothing else."""
    if _missing is not None:
        raise CryptographyMissing from _missing
    try:
        found = _read(folder / f"{CA_NAME}.pem").extensions.get_extension_for_class(x509.NameConstraints)
    except (CertificateError, x509.ExtensionNotFound):
        return False
    return found.critical and found.value == _constraints(permitted)


def roles(folder: pathlib.Path) -> dict[str, Role]:
    """Returns the roles of all certificates in a folder, by name.

    Raises :class:`CertificateError` if another authority has signed one of them.
    """
    if _missing is not None:
        raise CryptographyMissing from _missing
    authority = _read(folder / f"{CA_NAME}.pem")
    found: dict[str, Role] = {}
    for file in sorted(folder.glob("*.pem")):
        if file.stem == CA_NAME:
            continue
        certificate = _read(file)
        try:
            certificate.verify_directly_issued_by(authority)
            name = _text(certificate, NameOID.COMMON_NAME)
            role = Role(_text(certificate, NameOID.ORGANIZATIONAL_UNIT_NAME))
        except (InvalidSignature, ValueError, TypeError) as error:
            raise CertificateError(
                f"{file}: not signed by {CA_NAME}.pem beside it, or without a role: remove it, or make it anew with "
                f"'vinesim certs new {file.stem} --dir {folder}'"
            ) from error
        if name != file.stem:
            raise CertificateError(f"{file}: is the certificate of {name!r}: rename it to {name}.pem")
        found[name] = role
    return found


def check(folder: pathlib.Path, name: str) -> None:
    """Check the certificate of ``name`` and that of the authority.

    Raises :class:`CertificateError` if one of them is not valid now, or if the certificate does not belong to its key.
    """
    if _missing is not None:
        raise CryptographyMissing from _missing
    now = datetime.datetime.now(datetime.UTC)
    for file in (folder / f"{CA_NAME}.pem", folder / f"{name}.pem"):
        certificate = _read(file)
        first = certificate.not_valid_before_utc
        last = certificate.not_valid_after_utc
        if not first <= now <= last:
            remedy = (
                f"make it anew with 'vinesim certs new {name} --dir {folder}'"
                if file.stem == name
                else "make a new authority and all certificates anew, in empty folders"
            )
            raise CertificateError(f"{file}: not valid now, but from {first:%Y-%m-%d} to {last:%Y-%m-%d}: {remedy}")
    if _load_key(folder / f"{name}.key").public_key() != _read(folder / f"{name}.pem").public_key():
        raise CertificateError(f"{folder / name}.key: not the key of {name}.pem: copy both files of one certificate")


def expiring(folder: pathlib.Path) -> list[str]:
    """Returns a line of text with the date for each certificate of a folder that expires within
    :data:`WARNING_DAYS`."""
    if _missing is not None:
        return []
    soon = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=WARNING_DAYS)
    lines = []
    for file in sorted(folder.glob("*.pem")):
        last = _read(file).not_valid_after_utc
        if last < soon:
            lines.append(
                f"{file} is valid until {last:%Y-%m-%d %H:%M} UTC, and refused afterwards: make a new one in time"
            )
    return lines


def _authority_of(folder: pathlib.Path, authority: pathlib.Path, permitted: Sequence[str]) -> list[pathlib.Path]:
    """Create the authority in the folder ``authority`` if there is none, and copy its certificate to ``folder``.

    Returns the paths of the files that were written.
    """
    own = authority / f"{CA_NAME}.pem"
    public = folder / f"{CA_NAME}.pem"
    has_key = (authority / f"{CA_NAME}.key").exists()
    if public.exists() and not (has_key and own.exists() and own.read_bytes() == public.read_bytes()):
        raise CertificateError(
            f"{public} is not of the authority in {authority}: give the folder of its {CA_NAME}.key with --authority"
        )
    written = [] if has_key else _create_authority(authority, permitted)
    if not public.exists():
        _write(public, _read(own).public_bytes(serialization.Encoding.PEM), 0o644)
        written.append(public)
    return written


def _create_authority(folder: pathlib.Path, permitted: Sequence[str]) -> list[pathlib.Path]:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "vinesim authority")])
    usage = x509.KeyUsage(
        key_cert_sign=True,
        crl_sign=True,
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
    builder = (
        _builder(name, name, key.public_key(), 365 * AUTHORITY_YEARS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    if permitted:
        builder = builder.add_extension(_constraints(permitted), critical=True)
    return _save(folder, CA_NAME, key, builder.sign(key, hashes.SHA256()))


def _constraints(permitted: Sequence[str]) -> x509.NameConstraints:
    """Returns the limits of an authority that may sign for names of hosts, addresses and networks only."""
    subtrees: list[x509.GeneralName] = []
    for one in permitted:
        try:
            subtrees.append(x509.IPAddress(ipaddress.ip_network(one)))
        except ValueError:
            subtrees.append(x509.DNSName(one))
    return x509.NameConstraints(subtrees, None)


def _signed(
    folder: pathlib.Path, authority_at: pathlib.Path, name: str, role: Role, hosts: Sequence[str], days: float
) -> list[pathlib.Path]:
    """Create a key and a certificate, signed by the authority in the folder ``authority_at``. Returns the written
    paths."""
    authority = _read(authority_at / f"{CA_NAME}.pem")
    signer = _load_key(authority_at / f"{CA_NAME}.key")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name(
        [
            x509.NameAttribute(NameOID.COMMON_NAME, name),
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role.value),
        ]
    )
    names = dict.fromkeys(
        [*hosts, "localhost", "127.0.0.1", "::1", socket.gethostname()] if role == Role.SERVER else [name]
    )
    certificate = (
        _builder(subject, authority.subject, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([_host(one) for one in names]), critical=False)
        # a server is also a client of the router to which it is linked
        .add_extension(
            x509.ExtendedKeyUsage(
                [ExtendedKeyUsageOID.CLIENT_AUTH] + [ExtendedKeyUsageOID.SERVER_AUTH] * (role == Role.SERVER)
            ),
            critical=False,
        )
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
        .sign(signer, hashes.SHA256())
    )
    return _save(folder, name, key, certificate)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: float
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=2))  # because clocks of machines differ
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text.strip("[]")))
    except ValueError:
        return x509.DNSName(text)


def _save(
    folder: pathlib.Path, name: str, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate
) -> list[pathlib.Path]:
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    public = certificate.public_bytes(serialization.Encoding.PEM)
    files = []
    for suffix, content, mode in ((".key", secret, 0o600), (".pem", public, 0o644)):
        _write(folder / f"{name}{suffix}", content, mode)
        files.append(folder / f"{name}{suffix}")
    return files


def _write(path: pathlib.Path, content: bytes, mode: int) -> None:
    """Write a file atomically: if an error occurs, ``path`` is unchanged. ``mode``: permissions of the file."""
    part = path.with_name(f"{path.name}.part")
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
        file.write(content)
    part.replace(path)


def _load_key(file: pathlib.Path) -> ec.EllipticCurvePrivateKey:
    try:
        key = serialization.load_pem_private_key(file.read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise CertificateError(
            f"{file} cannot be read as a private key: restore it, or make the certificate anew"
        ) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise CertificateError(f"{file} is no elliptic key: make the certificate anew with 'vinesim certs new'")
    return key


def _read(file: pathlib.Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(file.read_bytes())
    except FileNotFoundError as error:
        raise CertificateError(
            f"no {file}: make certificates with 'vinesim certs new server --dir {file.parent} --host HOST'"
        ) from error
    except (OSError, ValueError) as error:
        raise CertificateError(
            f"{file}: cannot be read as a certificate ({error}): remove it or make it anew"
        ) from error


def _text(certificate: x509.Certificate, what: x509.ObjectIdentifier) -> str:
    (attribute,) = certificate.subject.get_attributes_for_oid(what)
    return str(attribute.value)
