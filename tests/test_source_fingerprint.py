"""Fingerprint of sources: changes with any code, including user-registered laws."""

import importlib
import sys

import jax
import numpy

from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.simulation.source_fingerprint import dependency_versions, sources_sha256

LAW = """
import dataclasses

@dataclasses.dataclass(frozen=True)
class Mine:
    factor: float = 1.0

    def force(self, depth):
        return {} * depth
"""


def test_fingerprint_covers_every_source_file(tmp_path, monkeypatch):
    digests = [sources_sha256()]
    for text in ("one = 1", "one = 2"):
        package = tmp_path / text.replace(" ", "")
        package.mkdir()
        (package / "__init__.py").write_text("")
        (package / "inner.py").write_text(text)
        monkeypatch.setattr(sys.modules["tuning"], "__file__", str(package / "__init__.py"))
        digests.append(sources_sha256())
    monkeypatch.undo()
    assert len(set(digests)) == 3 and sources_sha256() == digests[0]


def test_fingerprint_covers_user_registered_law_and_its_fields(tmp_path, monkeypatch):
    assert sources_sha256(*COMPENSATORS.values(), *CONTACT_LAWS.values()) == sources_sha256()
    monkeypatch.syspath_prepend(tmp_path)
    digests = [sources_sha256()]
    for number in ("2", "30"):
        (tmp_path / "law_of_mine.py").write_text(LAW.format(number))
        sys.modules.pop("law_of_mine", None)
        importlib.invalidate_caches()
        mine = importlib.import_module("law_of_mine").Mine
        digests += [sources_sha256(mine()), sources_sha256(CONTACT_LAWS["linear"], mine(2.0))]
        assert sources_sha256(mine()) == digests[-2]
    assert len(set(digests)) == 5


def test_fingerprint_versions_equal_imported_versions():
    assert (
        dependency_versions()["jax"] == jax.__version__
        and dependency_versions()["numpy"] == numpy.__version__
    )
    assert dependency_versions()["python"] == ".".join(map(str, sys.version_info[:3]))
