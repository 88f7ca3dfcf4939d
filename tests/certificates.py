"""Keys and certificates for signing, made on the spot."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

PEM = serialization.Encoding.PEM


def certified(folder: Path, key: Any, name: str = "Ada", password: bytes | None = None) -> tuple[Path, Path]:
    """A key, and a chain of its certificate and that of an authority made for it."""
    authority = ec.generate_private_key(ec.SECP256R1())
    chain = b"".join(
        _certificate(each, of, authority, above).public_bytes(PEM)
        for each, of, above in ((name, key, False), ("authority", authority, True))
    )
    kept = serialization.BestAvailableEncryption(password) if password else serialization.NoEncryption()
    (folder / "chain.pem").write_bytes(chain)
    (folder / "key.pem").write_bytes(key.private_bytes(PEM, serialization.PrivateFormat.PKCS8, kept))
    return folder / "chain.pem", folder / "key.pem"


def _certificate(name: str, key: Any, authority: Any, above: bool) -> x509.Certificate:
    def called(text: str) -> x509.Name:
        return x509.Name(
            [x509.NameAttribute(NameOID.ORGANIZATION_NAME, "Test"), x509.NameAttribute(NameOID.COMMON_NAME, text)]
        )

    now = datetime.datetime.now(datetime.timezone.utc)
    uses = dict.fromkeys(("key_encipherment", "data_encipherment", "key_agreement", "crl_sign", "encipher_only"), False)
    uses |= {
        "content_commitment": False,
        "decipher_only": False,
        "digital_signature": not above,
        "key_cert_sign": above,
    }
    builder = (
        x509.CertificateBuilder()
        .subject_name(called(name))
        .issuer_name(called("authority"))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=2))
        .add_extension(x509.BasicConstraints(above, None), True)
        .add_extension(x509.KeyUsage(**uses), True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.public_key()), False)
    )
    if not above:
        builder = builder.add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.EMAIL_PROTECTION]), True)
    return builder.sign(authority, hashes.SHA256())
