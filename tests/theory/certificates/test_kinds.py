"""Every kind of certificate fulfils the contract. A new kind is a new row here."""

import perfcontrol as pc
from tests.contracts.certificate import CertificateContract


class TestPaper(CertificateContract):
    kind = pc.Paper


class TestRepaired(CertificateContract):
    kind = pc.Paper
    settings = {"repaired": True}  # noqa: RUF012


class TestRigorous(CertificateContract):
    kind = pc.Rigorous


class TestGlobalBound(CertificateContract):
    kind = pc.GlobalBound


class TestSharp(CertificateContract):
    kind = pc.Sharp
    settings = {"samples": 16, "pairs": 2}  # noqa: RUF012
