"""README and guide are consistent with the repository: links, files, names, and numbers from theory."""

import cmath
import math
import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import continuous
import numpy as np
import pytest
from scipy.special import lambertw

from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.rig.law_status import STATUSES

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "notebooks" / "guide"
PAGES = [ROOT / "README.md", *sorted(GUIDE.glob("*.md"))]
SECTIONS = [
    "1 The loop",
    "2 Conventions",
    "3 Contact laws",
    "4 What goes wrong",
    "5 Compensation",
    "6 Closed forms",
]
LINK = re.compile(r"\]\(([^)#]+)(#[^)]*)?\)")
FILE = re.compile(r"(?<!schema = \")(?<![\w/.-])(?:jaxhil|tuning|tests|notebooks|\.ci)/[\w/.-]*\w/?")
CITED = re.compile(r"(model|impulse_ledger)\.md[),]*\s+section\s+(\d+)(?:,\s+items?\s+([\d, and]+))?")
RUNNABLE = re.compile(r"^<!-- runnable -->\n```python\n(.*?)^```", re.M | re.S)
GAIN = re.compile(r"^\| `(\w+)` \| ([^ |]+) \|", re.M)


def text_of(name):
    return (GUIDE / name).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def model():
    return text_of("model.md")


@pytest.fixture(params=PAGES, ids=lambda path: path.name)
def page(request):
    return request.param


def section(text, number):
    """Return the text of the section with this number."""
    return re.search(rf"^## {number} .*?(?=^## |\Z)", text, re.M | re.S)[0]


def items(text):
    """Return the closed forms of model.md by number."""
    result = re.findall(r"^(\d+)\. (.*?)(?=^\d+\. |^\S|\Z)", section(text, 6), re.M | re.S)
    return {int(number): words for number, words in result}


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 200


def test_guide_has_no_broken_links(page):
    links = [target for target, _ in LINK.findall(page.read_text(encoding="utf-8"))]
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


def test_guide_names_existing_files(page):
    result = FILE.findall(page.read_text(encoding="utf-8"))
    missing = [name for name in result if "NAME" not in name and not (ROOT / name).exists()]
    assert not missing


def test_guide_index_links_every_page_and_notebook():
    index = text_of("index.md")
    linked = {(GUIDE / target).resolve() for target, _ in LINK.findall(index)}
    assert {*PAGES, *(ROOT / "notebooks").glob("*.ipynb")} - {GUIDE / "index.md"} <= linked


def test_guide_has_every_section_that_the_code_cites(model):
    assert re.findall(r"^## (.*)$", model, re.M) == SECTIONS
    headings = {
        "model": len(SECTIONS),
        "impulse_ledger": len(re.findall(r"^## \d", text_of("impulse_ledger.md"), re.M)),
    }
    last, cited = max(items(model)), []
    for path in (*ROOT.glob("jaxhil/**/*"), *ROOT.glob("tuning/**/*"), *ROOT.glob("tests/**/*.py")):
        if path.suffix in (".py", ".c", ".toml"):
            cited += [(path, *where) for where in CITED.findall(path.read_text(encoding="utf-8"))]
    assert cited
    for path, name, number, listed in cited:
        assert 1 <= int(number) <= headings[name], path
        assert all(1 <= int(item) <= last for item in re.findall(r"\d+", listed)), path


def test_guide_describes_every_compensator_and_contact_status(model):
    in_tables = set(re.findall(r"^\| `(\w+)` \|", section(model, 3) + section(model, 5), re.M))
    assert in_tables == {*COMPENSATORS, *CONTACT_LAWS}
    statuses = section(text_of("impulse_ledger.md"), 6)
    assert set(re.findall(r"^\| `(\w+)` \|", statuses, re.M)) == {status.name for status in STATUSES}


def test_guide_describes_gains_of_impulse_ledger():
    rows = GAIN.findall(section(text_of("impulse_ledger.md"), 7))
    assert len(rows) == len(dict(rows))
    assert dict(rows) == {gain.name: gain.unit for gain in COMPENSATORS["impulse_ledger"].gains}


def numbers(words):
    """Return every decimal number in the text."""
    return [float(number) for number in re.findall(r"\d+\.\d+", words)]


def restitution_of(root):
    """Return the restitution that corresponds to a root of the characteristic equation."""
    return math.exp(math.pi * root.real / abs(root.imag))


def root_of(function, start):
    """Return a root near `start` by Newton's method."""
    root, step = start, 1e-6
    for _ in range(60):
        root -= function(root) * 2 * step / (function(root + step) - function(root - step))
    return root


def test_guide_closed_forms_of_delay_are_correct(model):
    rows = re.findall(r"\| (0\.\d+) \| (\d\.\d+) \|", items(model)[1])
    assert len(rows) == 4
    for phase, e in rows:
        assert continuous.delayed_restitution(float(phase)) == pytest.approx(float(e), abs=1e-12)
    result = numbers(items(model)[2])
    phases = np.array([0.05, 0.2])
    roots = 2 / phases * lambertw(0.5j * phases)
    first_order = np.exp(np.pi * phases / 2)
    expected = [restitution_of(roots[0]), 0.05, restitution_of(roots[1]), 0.2, *first_order]
    assert result == pytest.approx(expected, abs=5e-7)


def test_guide_closed_forms_of_damping_are_correct(model):
    result = numbers(items(model)[3])
    expected = [continuous.separates_at_surface(0.05), 0.05, continuous.separates_at_no_force(0.05), 0.05]
    assert result == pytest.approx(expected, abs=5e-7)


def test_guide_numbers_of_lead_and_smith_predictor_are_correct(model):
    phase = 0.2
    root = root_of(lambda s: s**2 + (1 + phase * s) * cmath.exp(-s * phase), 1j)
    assert restitution_of(root) - 1 == pytest.approx(math.expm1(math.pi / 6 * phase**3), rel=0.03)

    omega, lag, delay = 6 * math.pi, 0.010, 0.008

    def remaining(forward):
        return restitution_of(
            root_of(lambda s: s**2 + omega**2 * forward(s) * cmath.exp(-s * (lag + delay)), 1j * omega)
        )

    def ahead(s):
        return lag * s / (1 + lag * s / 2)

    readings = [
        remaining(lambda s: (1 + ahead(s)) * (1 + delay * s)),
        remaining(lambda s: 1 + ahead(s) * (1 + delay * s)),
    ]
    assert numbers(items(model)[14]) == pytest.approx(readings, abs=5e-4)


def test_guide_script_is_the_tested_interface_script():
    block = re.search(r"^```python\n(.*?)^```", text_of("python.md"), re.M | re.S)
    run = (ROOT / "tests" / "interface_script.py").read_text(encoding="utf-8")
    sizes = re.compile(r"\b(scenarios|starts|judged)=[\d_]+")
    assert block is not None
    assert sizes.sub(r"\1", run).endswith(sizes.sub(r"\1", block[1]))


@pytest.mark.parametrize(
    "path",
    [
        ROOT / "README.md",
        *(pytest.param(GUIDE / name, marks=pytest.mark.slow) for name in ("python.md", "six_axes.md")),
    ],
    ids=lambda path: path.name,
)
def test_guide_examples_run(path, tmp_path):
    blocks = RUNNABLE.findall(path.read_text(encoding="utf-8"))
    assert blocks
    inherited = os.environ.get("PYTHONPATH")
    places = os.pathsep.join([str(ROOT), *([inherited] if inherited else [])])
    ran = subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n".join(blocks)],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": places}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0 and not ran.stderr, ran.stderr
    assert ran.stdout
    # The text block below the last example of a page is that example's output.
    *_, shown = re.findall(r"^```text\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S)
    assert path.name == "README.md" or ran.stdout.endswith(shown)


@pytest.mark.parametrize("kind", ["butterworth", "bessel"])
def test_delays_of_filters_are_group_delays_at_low_frequency(kind):
    from scipy import signal

    page = (GUIDE / "model.md").read_text()
    (row,) = re.findall(rf"delay of a {kind.title()} filter, times f \|(.*)\|", page)
    for order, factor in enumerate(row.split("|"), 1):
        design = signal.butter if kind == "butterworth" else partial(signal.bessel, norm="mag")
        numerator, denominator = design(order, 2 * np.pi, analog=True)
        _, response = signal.freqs(numerator, denominator, [2 * np.pi * 1e-3])
        assert -np.angle(response[0]) / (2 * np.pi * 1e-3) == pytest.approx(float(factor), abs=5e-4)
