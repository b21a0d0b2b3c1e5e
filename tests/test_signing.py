"""Signed bundles: `verify --key` proves the origin of a bundle, and OpenSSL agrees."""

import json
import random
import shutil
import subprocess
import sys

import pytest
from bundles import document, run_selftest, signed, small_files, write_files
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.rsa import generate_private_key
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)
from test_bundle_checking import flipped

import tuning
from jaxhil.errors import InputError
from tuning.bundle.checking import check_bundle
from tuning.bundle.signing import load_signer, load_verifier
from tuning.gain_file import write_gain_file


def as_private(key, encryption=None):
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption or NoEncryption())


def as_public(key):
    return key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)


@pytest.fixture
def key(tmp_path):
    """Return files of a private and a public key."""
    pair = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    files = tmp_path / "key.pem", tmp_path / "public.pem"
    for file, text in zip(files, (as_private(pair), as_public(pair)), strict=True):
        file.write_bytes(text)
    return files


@pytest.fixture
def folder(key, tmp_path):
    """Return a signed bundle."""
    files = small_files()
    signature = load_signer(key[0])(files["manifest.json"])
    return write_files(tmp_path / "bundle", {**files, "manifest.sig": signature})


def test_bundle_signature_matches_example_of_rfc_8032(tmp_path):
    """Use the example of section 7.1, test 2."""
    secret = "4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb"
    signature = (
        "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da"
        "085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00"
    )
    pair = Ed25519PrivateKey.from_private_bytes(bytes.fromhex(secret))
    (tmp_path / "key.pem").write_bytes(as_private(pair))
    assert load_signer(tmp_path / "key.pem")(b"\x72").hex() == signature


def test_verify_without_key_does_not_claim_proof_of_origin(folder):
    checked = check_bundle(folder)
    assert checked.reasons == [] and checked.signature.startswith("present, but not checked")
    good, out = run_selftest(folder)
    assert good and "note  manifest.json: is signed; only `jaxhil verify --key` proves by whom" in out
    (folder / "manifest.sig").unlink()
    assert check_bundle(folder).signature == "not signed"
    good, out = run_selftest(folder)
    assert good and "note  manifest.json: is not signed" in out


def test_verify_rejects_signature_of_another_key_or_manifest(key, folder, tmp_path):
    by_key = load_verifier(key[1])
    assert check_bundle(folder, by_key).signature == "valid for the given key"
    (tmp_path / "other.pem").write_bytes(as_public(Ed25519PrivateKey.generate()))
    result = tuning.verify(folder, key=tmp_path / "other.pem")
    expected = "manifest.sig: found another signature, expected the signature by the given key"
    assert not result.good and result.reasons == [expected] and result.document["self_test"] == []
    # Update all checksums after a change, as is possible without the key; only the signature is wrong.
    files = small_files()
    shorter = files["vectors.csv"].rpartition(b"\n1,")[0] + b"\n"
    write_files(folder, signed({**files, "vectors.csv": shorter}, json.loads(files["gains.json"])))
    assert check_bundle(folder).reasons == []
    assert check_bundle(folder, by_key).reasons == [expected]


@pytest.mark.parametrize("flips", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_verify_detects_flipped_bits_in_signature_and_signed_content(key, folder, flips):
    source, by_key = random.Random(flips), load_verifier(key[1])
    for turn in range(flips):
        path = folder / ("manifest.sig", "manifest.json")[turn % 2]
        content = path.read_bytes()
        path.write_bytes(flipped(source, content))
        reasons = check_bundle(folder, by_key).reasons
        assert any(reason.startswith("manifest.sig: found another") for reason in reasons)
        path.write_bytes(content)
    assert check_bundle(folder, by_key).reasons == []


@pytest.mark.parametrize("size", [0, 63, 64, 65])
def test_verify_with_key_rejects_invalid_signature(key, folder, size):
    (folder / "manifest.sig").write_bytes(bytes(size))
    assert check_bundle(folder, load_verifier(key[1])).reasons[0].startswith("manifest.sig: found ")
    assert (check_bundle(folder).reasons == []) is run_selftest(folder)[0] is (size <= 64)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl")
def test_openssl_creates_keys_and_verifies_bundle_signature(tmp_path):
    for command in (
        "openssl genpkey -algorithm ed25519 -out key.pem",
        "openssl pkey -in key.pem -pubout -out public.pem",
    ):
        assert subprocess.run(command.split(), cwd=tmp_path, capture_output=True).returncode == 0
    files = small_files()
    signature = load_signer(tmp_path / "key.pem")(files["manifest.json"])
    write_files(tmp_path, {**files, "manifest.sig": signature})
    proof = "openssl pkeyutl -verify -pubin -inkey public.pem -rawin -in manifest.json -sigfile manifest.sig"
    assert subprocess.run(proof.split(), cwd=tmp_path, capture_output=True).returncode == 0
    (tmp_path / "manifest.json").write_bytes(files["manifest.json"] + b" ")
    assert subprocess.run(proof.split(), cwd=tmp_path, capture_output=True).returncode != 0


def test_unusable_signing_keys_are_rejected_with_one_line_message(key, folder, tmp_path, jaxhil):
    pair = Ed25519PrivateKey.generate()
    other = generate_private_key(65537, 2048)
    copy = tmp_path / "kept.pem"
    for text, private, public in [
        (as_private(pair, BestAvailableEncryption(b"secret")), "an encrypted key", "no such key"),
        (as_private(other), "another kind of key", "no such key"),
        (as_public(other), "no such key", "another kind of key"),
        (key[0].read_bytes(), None, "no such key"),
        (key[1].read_bytes(), "no such key", None),
        (b"", "no such key", "no such key"),
        (b"-----BEGIN PRIVATE KEY-----\nMC4CAQ==\n-----END PRIVATE KEY-----\n", "no such key", "no such key"),
        (b"x" * 100_000, "a larger file", "a larger file"),
    ]:
        copy.write_bytes(text)
        for read, result, allowed in [(load_signer, private, "private"), (load_verifier, public, "public")]:
            if result is None:
                read(copy)
                continue
            with pytest.raises(InputError) as caught:
                read(copy)
            line = str(caught.value)
            assert f"kept.pem: found {result}, expected an Ed25519 {allowed} key" in line and "\n" not in line
    ran = jaxhil("verify", folder, "--key", tmp_path / "none.pem")
    assert (ran.code, ran.out) == (2, "") and "none.pem: cannot be read: No such file" in ran.err
    gains = tmp_path / "gains.json"
    write_gain_file(gains, document())
    ran = jaxhil("verify", gains, "--key", key[1])
    assert (ran.code, ran.out) == (2, "") and "no key for a gain file: only bundles are signed" in ran.err
    ran = jaxhil("export", gains, "-o", tmp_path / "new", "--sign", key[1])
    assert (ran.code, ran.out) == (2, "") and not (tmp_path / "new").exists()


def test_missing_signing_package_is_reported_in_one_line(key, folder, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "cryptography"]:
        monkeypatch.setitem(sys.modules, name, None)
    for read, file in ((load_signer, key[0]), (load_verifier, key[1])):
        with pytest.raises(InputError, match=r"run pip install 'jaxhil\[sign\]'"):
            read(file)
    assert check_bundle(folder).reasons == []
