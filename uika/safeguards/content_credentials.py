"""Content Credentials (C2PA 2): who made a picture or film and how, signed with a key of the user's own."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uika._version import __version__
from uika.errors import UikaError
from uika.io.files import check_output, replacing
from uika.safeguards.provenance import as_text

KINDS = (".png", ".jpg", ".jpeg", ".webp", ".mp4", ".mov")
_ASSERTION = "org.uika-drjit.provenance"
_SOURCE = "http://cv.iptc.org/newscodes/digitalsourcetype/trainedAlgorithmicMedia"
_UNTRUSTED = "signingCredential.untrusted"
_MARK = b"c2pa"  # of the box that holds a manifest
_CURVES = {"secp256r1": b"es256", "secp384r1": b"es384", "secp521r1": b"es512"}


@dataclass(frozen=True)
class Credentials:
    """The signed statement in a file."""

    valid: bool  # whether the signature fits the statement and the file's bytes
    signer: str  # as the certificate names him
    trusted: bool  # whether that certificate leads to one on a list that the library trusts
    program: str
    provenance: Mapping[str, str]  # empty if another program made it
    faults: tuple[str, ...]  # the standard's codes of what is wrong


def sign(
    path: str | Path, certificate: str | Path, key: str | Path, provenance: Mapping[str, str], output: str | Path
) -> None:
    """Write a copy of a picture or film with a signed statement: made by an algorithm, and its provenance.

    No time stamp is asked for, which would need a network: the signature counts while the certificate does.

    Args:
        path: .png, .jpg, .webp, .mp4 or .mov file.
        certificate: chain of PEM certificates, the signer's first.
        key: private key in PEM without a password; elliptic (P-256, P-384, P-521), RSA or Ed25519.
        provenance: what to state.
        output: file of the same kind.

    Raises:
        UikaError: a file is missing, of another kind, or cannot be used for signing; it names the file.
        ModuleNotFoundError: `c2pa-python` is not installed.
    """
    source = _checked(Path(path))
    target = check_output(output, source.suffix)
    import c2pa

    chain, secret = (_read(Path(place)) for place in (certificate, key))
    statement = {
        "claim_generator_info": [{"name": "uika-drjit", "version": __version__}],
        "title": target.name,
        "assertions": [
            {
                "label": "c2pa.actions",
                "data": {"actions": [{"action": "c2pa.created", "digitalSourceType": _SOURCE}]},
            },
            {"label": _ASSERTION, "data": dict(provenance)},
        ],
    }
    algorithm = _algorithm(Path(key), secret)
    try:
        signer = c2pa.Signer.from_info(c2pa.C2paSignerInfo(algorithm, chain, secret, None))
        settings = c2pa.Settings.from_dict({"builder": {"thumbnail": {"enabled": False}}})
        builder = c2pa.Builder(statement, c2pa.Context(settings))
        with replacing(target) as temporary:
            builder.sign_file(source, temporary, signer)
    except c2pa.C2paError as error:
        raise UikaError(f"{source}: cannot be signed with {certificate} and {key} ({error})") from error


def read_credentials(path: str | Path) -> Credentials | None:
    """The statement in a file; None if it has none.

    Raises:
        UikaError: no such file, or its statement is damaged.
        ModuleNotFoundError: the file seems to have one, and `c2pa-python` is not installed.
    """
    source = _checked(Path(path))
    if _MARK not in source.read_bytes():
        return None
    import c2pa

    try:
        reader = c2pa.Reader.try_create(source)
        if reader is None:
            return None
        with reader:
            manifest, state = reader.get_active_manifest(), reader.get_validation_state()
            found = json.loads(reader.json()).get("validation_status", [])
    except c2pa.C2paError as error:
        raise UikaError(f"{source}: has content credentials that cannot be read ({error})") from error
    return _credentials(manifest or {}, str(state), [str(each.get("code")) for each in found])


def _credentials(manifest: Mapping[str, Any], state: str, codes: list[str]) -> Credentials:
    signature = manifest.get("signature_info") or {}
    programs = manifest.get("claim_generator_info") or [{}]
    stated = next((a.get("data") for a in manifest.get("assertions", ()) if a.get("label") == _ASSERTION), None)
    names = [str(signature[name]) for name in ("common_name", "issuer") if signature.get(name)]
    return Credentials(
        valid=state in ("Valid", "Trusted"),
        signer=", ".join(names) or "not named",
        trusted=state == "Trusted",
        program=" ".join(str(programs[0].get(name, "")) for name in ("name", "version")).strip(),
        provenance=as_text(stated),
        faults=tuple(code for code in codes if code != _UNTRUSTED),
    )


def _checked(path: Path) -> Path:
    if not path.is_file():
        raise UikaError(f"{path}: no such file")
    if path.suffix.lower() not in KINDS:
        raise UikaError(f"{path}: content credentials go into files that end in {', '.join(KINDS)}")
    return path


def _read(path: Path) -> bytes:
    if not path.is_file():
        raise UikaError(f"{path}: no such file; give a PEM file")
    data = path.read_bytes()
    if b"-----BEGIN" not in data:
        raise UikaError(f"{path}: is no PEM file")
    return data


def _algorithm(path: Path, secret: bytes) -> bytes:
    """What the standard calls signing with a key of this kind."""
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        key = load_pem_private_key(secret, None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise UikaError(f"{path}: is no private key that can be used without a password ({error})") from error
    if isinstance(key, rsa.RSAPrivateKey):
        return b"ps256"
    if isinstance(key, ed25519.Ed25519PrivateKey):
        return b"ed25519"
    if isinstance(key, ec.EllipticCurvePrivateKey) and key.curve.name in _CURVES:
        return _CURVES[key.curve.name]
    raise UikaError(f"{path}: is a key of a kind that content credentials do not know; make one with P-256")
