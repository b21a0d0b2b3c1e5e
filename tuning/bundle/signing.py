"""Ed25519 signatures of bundles (RFC 8032).

The signature is made from the manifest, which contains the SHA-256 of every other file. The file
`manifest.sig` contains the 64 bytes of the signature. Keys are PEM files, as `openssl genpkey -algorithm
ed25519` writes them. This module needs the package `cryptography`, which `pip install 'jaxhil[sign]'`
installs.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, to_one_line
from jaxhil.files import open_input

MAX_KEY_BYTES = 65536  # largest size of a key file [bytes]; real key files are much smaller


def load_signer(path: Path) -> Callable[[bytes], bytes]:
    """Return a function that signs bytes with the private key in a PEM file.

    Raise `InputError` if the file or the package `cryptography` cannot be used.
    """
    ed25519, serialization = _import_cryptography()
    expected = "an Ed25519 private key without a passphrase, as PEM"
    key = _read_key(path, expected, lambda text: serialization.load_pem_private_key(text, password=None))
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise _key_error(path, "another kind of key", expected)
    return key.sign


def load_verifier(path: Path) -> Callable[[bytes, bytes], bool]:
    """Return a function that checks a signature of bytes with the public key in a PEM file.

    The function takes the signature and the signed bytes, and returns whether the signature is valid. Raise
    `InputError` if the file or the package `cryptography` cannot be used.
    """
    ed25519, serialization = _import_cryptography()
    from cryptography.exceptions import InvalidSignature

    expected = "an Ed25519 public key as PEM"
    key = _read_key(path, expected, serialization.load_pem_public_key)
    if not isinstance(key, ed25519.Ed25519PublicKey):
        raise _key_error(path, "another kind of key", expected)

    def is_signature(signature: bytes, content: bytes) -> bool:
        try:
            key.verify(signature, content)
        except InvalidSignature:
            return False
        return True

    return is_signature


def _import_cryptography() -> tuple[Any, Any]:
    """Import and return the modules of `cryptography`; raise `InputError` if it is not installed."""
    try:
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError:
        raise InputError(
            "signing: the package cryptography is not installed: run pip install 'jaxhil[sign]'"
        ) from None
    return ed25519, serialization


def _read_key(path: Path, expected: str, load: Callable[[bytes], Any]) -> Any:
    """Read a PEM file and return the key that `load` decodes; raise `InputError` after an error.

    `expected` describes the required kind of key for the error message.
    """
    from cryptography.exceptions import UnsupportedAlgorithm

    try:
        with open_input(path) as file:
            text = file.read(MAX_KEY_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{to_one_line(str(path))}: cannot be read: {to_one_line(reason)}") from None
    if len(text) > MAX_KEY_BYTES:
        raise _key_error(path, "a larger file", expected)
    try:
        return load(text)
    except TypeError:
        raise _key_error(path, "an encrypted key", expected) from None
    except (ValueError, UnsupportedAlgorithm):
        raise _key_error(path, "no such key", expected) from None


def _key_error(path: Path, found: str, expected: str) -> InputError:
    return InputError(f"{to_one_line(str(path))}: found {found}, expected {expected}")
