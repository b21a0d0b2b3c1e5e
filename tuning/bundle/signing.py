"""Signatures of bundles: Ed25519 (RFC 8032) over the manifest, which has the SHA-256 of every other file.

The signature is the file `manifest.sig` of 64 bytes; keys are PEM files, such as `openssl genpkey -algorithm
ed25519` writes. It uses the package `cryptography`, the extra `jaxhil[sign]`, which is imported on use.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, to_one_line
from jaxhil.files import open_input

MAX_KEY_BYTES = 65536  # bytes; largest size of a key's file


def load_signer(path: Path) -> Callable[[bytes], bytes]:
    """Return a function that signs bytes with the private key in a file. Raise `InputError`."""
    ed25519, serialization = _import_cryptography()
    allowed = "an Ed25519 private key without a passphrase, as PEM"
    key = _read_key(path, allowed, lambda text: serialization.load_pem_private_key(text, password=None))
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise _key_error(path, "another kind of key", allowed)
    return key.sign


def load_verifier(path: Path) -> Callable[[bytes, bytes], bool]:
    """Return a function that checks signatures by the public key in a file. Raise `InputError`."""
    ed25519, serialization = _import_cryptography()
    from cryptography.exceptions import InvalidSignature

    allowed = "an Ed25519 public key as PEM"
    key = _read_key(path, allowed, serialization.load_pem_public_key)
    if not isinstance(key, ed25519.Ed25519PublicKey):
        raise _key_error(path, "another kind of key", allowed)

    def is_signature(signature: bytes, content: bytes) -> bool:
        try:
            key.verify(signature, content)
        except InvalidSignature:
            return False
        return True

    return is_signature


def _import_cryptography() -> tuple[Any, Any]:
    """Import and return the modules of `cryptography`. Raise `InputError` if it is not installed."""
    try:
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError:
        raise InputError(
            "signing: found no package cryptography, expected with it: pip install 'jaxhil[sign]'"
        ) from None
    return ed25519, serialization


def _read_key(path: Path, allowed: str, load: Callable[[bytes], Any]) -> Any:
    """Read a key from a PEM file by the function `load`. Raise `InputError`."""
    from cryptography.exceptions import UnsupportedAlgorithm

    try:
        with open_input(path) as file:
            text = file.read(MAX_KEY_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{to_one_line(str(path))}: cannot be read: {to_one_line(reason)}") from None
    if len(text) > MAX_KEY_BYTES:
        raise _key_error(path, "a larger file", allowed)
    try:
        return load(text)
    except TypeError:
        raise _key_error(path, "an encrypted key", allowed) from None
    except (ValueError, UnsupportedAlgorithm):
        raise _key_error(path, "no such key", allowed) from None


def _key_error(path: Path, found: str, allowed: str) -> InputError:
    """Return the error for an unusable key file."""
    return InputError(f"{to_one_line(str(path))}: found {found}, expected {allowed}")
