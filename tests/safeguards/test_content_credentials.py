"""Signed statements: read back, broken by any change of the file, and refused with a sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("c2pa")
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa

from tests.certificates import certified
from uika import UikaError
from uika.cli import main
from uika.io.video import write_png, write_video
from uika.safeguards.content_credentials import read_credentials, sign

STATED = {"photos": "1", "consent": "stated by the user", "note": "ünïcode"}


@pytest.fixture
def made(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    picture = torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0))
    write_png("a.png", picture, STATED)
    write_video("a.mp4", picture.expand(3, -1, -1, -1), 10, STATED)
    return tmp_path


@pytest.mark.parametrize("kind", ["png", "mp4"])
@pytest.mark.parametrize(
    "key", [ec.generate_private_key(ec.SECP384R1()), ed25519.Ed25519PrivateKey.generate()], ids=["P-384", "Ed25519"]
)
def test_a_statement_is_read_back(made, kind, key):
    sign(f"a.{kind}", *certified(made, key), STATED, f"b.{kind}")
    found = read_credentials(f"b.{kind}")
    assert found is not None and found.valid and not found.trusted and found.faults == ()
    assert found.signer == "Ada, Test" and found.program.startswith("uika-drjit ")
    assert found.provenance == STATED and read_credentials(f"a.{kind}") is None
    assert sorted(p.name for p in made.iterdir() if p.suffix != ".pem") == ["a.mp4", "a.png", f"b.{kind}"]


def test_rsa_keys_and_other_pictures(made):
    Image.fromarray(np.zeros((32, 32, 3), np.uint8)).save("a.jpg")
    sign("a.jpg", *certified(made, rsa.generate_private_key(65537, 2048)), {}, "b.jpg")
    found = read_credentials("b.jpg")
    assert found is not None and found.valid and found.provenance == {}


def test_a_changed_file_is_no_longer_valid(made):
    sign("a.png", *certified(made, ec.generate_private_key(ec.SECP256R1())), STATED, "b.png")
    data = bytearray((made / "b.png").read_bytes())
    data[data.rindex(b"IDAT") + 40] ^= 1
    (made / "c.png").write_bytes(data)
    found = read_credentials("c.png")
    assert found is not None and not found.valid and "assertion.dataHash.mismatch" in found.faults


def test_commands_sign_and_verify(made, capsys):
    chain, key = certified(made, ec.generate_private_key(ec.SECP256R1()), "Grace")
    assert main(["sign", "a.mp4", "--certificate", str(chain), "--key", str(key), "-o", "b.mp4"]) == 0
    assert "wrote b.mp4: signed by Grace, Test" in capsys.readouterr().out
    assert main(["verify", "b.mp4"]) == 0
    out = capsys.readouterr().out
    assert "credentials valid" in out and "Grace, Test (a certificate on no list of trust)" in out
    assert out.count("consent") == 1, "the provenance beside the statement is the same and is said once"
    assert main(["verify", "a.mp4"]) == 0 and "credentials" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["none.png"], "none.png: no such file"),
        (["a.png", "--key", "none.pem"], "none.pem: no such file; give a PEM file"),
        (["a.png", "--key", "a.png"], "a.png: is no PEM file"),
        (["a.png", "--key", "locked/key.pem"], "without a password"),
        (["a.png", "--key", "chain.pem"], "chain.pem: is no private key"),
        (["a.png", "--key", "other/key.pem"], "cannot be signed with chain.pem and other/key.pem"),
        (["a.png", "-o", "b.mp4"], "b.mp4"),
        (["plain.png"], "has no provenance of this program"),
    ],
)
def test_wrong_input_is_one_sentence(made, capsys, arguments, says):
    certified(made, ec.generate_private_key(ec.SECP256R1()))
    for name, password in (("locked", b"secret"), ("other", None)):
        (made / name).mkdir()
        certified(made / name, ec.generate_private_key(ec.SECP256R1()), password=password)
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save("plain.png")
    given = {"--certificate": "chain.pem", "--key": "key.pem", "-o": "b.png"}
    given |= dict(zip(arguments[1::2], arguments[2::2], strict=True))
    assert main(["sign", arguments[0], *(part for pair in given.items() for part in pair)]) == 2
    err = capsys.readouterr().err
    assert says in err and err.count("\n") == 1
    assert not (made / "b.png").exists() and not (made / "b.mp4").exists()


def test_a_damaged_statement_is_named_or_says_nothing_else(made):
    sign("a.png", *certified(made, ec.generate_private_key(ec.SECP256R1())), STATED, "b.png")
    whole = (made / "b.png").read_bytes()
    start = whole.index(b"caBX")
    random = np.random.default_rng(0)
    for _ in range(60):
        data = bytearray(whole)
        data[start + 8 + int(random.integers(4000))] ^= int(random.integers(1, 256))
        (made / "c.png").write_bytes(data)
        try:
            found = read_credentials("c.png")
        except UikaError as error:
            assert "c.png: has content credentials that cannot be read" in str(error)
        else:
            # Parts of the box are padding that nothing is said in.
            assert found is None or not found.valid or (found.provenance, found.signer) == (STATED, "Ada, Test")
