"""Certificates and tokens for the test, generated in each run."""

import base64
import datetime
import json
import time
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa


def self_signed(folder: Path, name: str = "databroker.test") -> tuple[Path, Path]:
    """Creates a self-signed certificate for `name`, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.timezone.utc)
    day = datetime.timedelta(days=1)
    builder = x509.CertificateBuilder(subject, subject, key.public_key(), x509.random_serial_number(), now - day, now + day)
    builder = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
    certificate = builder.sign(key, hashes.SHA256())
    paths = folder / "certificate.pem", folder / "key.pem"
    paths[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    paths[1].write_bytes(key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()))
    return paths


def signed_tokens(folder: Path, scopes: dict[str, str]) -> tuple[Path, dict[str, str]]:
    """Creates a public key, and tokens (JWT, RS256) with these scopes."""
    def encoded(data: bytes) -> bytes:
        return base64.urlsafe_b64encode(data).rstrip(b"=")

    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    public = folder / "jwt.pub"
    public.write_bytes(key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo))
    tokens, now = {}, int(time.time())
    for name, scope in scopes.items():
        claims = {"sub": "test", "iss": "test", "aud": ["kuksa.val"], "iat": now, "exp": now + 3600, "scope": scope}
        text = encoded(b'{"alg":"RS256","typ":"JWT"}') + b"." + encoded(json.dumps(claims).encode())
        tokens[name] = (text + b"." + encoded(key.sign(text, padding.PKCS1v15(), hashes.SHA256()))).decode()
    return public, tokens
