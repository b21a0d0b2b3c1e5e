"""Documentation site: complete generated pages; built and opened in a browser."""

import dataclasses
import os
import re
import subprocess
import sys
import tomllib
import typing
from html.parser import HTMLParser
from pathlib import Path
from typing import Annotated
from urllib.parse import unquote, urldefrag

import pytest
import tyro
import yaml
from browser import LAYOUT

import jaxhil
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.keys import describe_tables
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from tuning.cli.parser import Command

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "notebooks" / "site"
WIDTHS = (375, 1440)
A4 = 703, 1017  # pixels within the margins
COMMANDS = [typing.get_args(entry)[1].name for entry in typing.get_args(Command)]
BAD = """<!doctype html><meta name="viewport" content="width=device-width"><body style="margin: 0">
<p style="margin: 0">One</p>
<p style="margin: -1.2em 0 0">lies on the other</p><p style="margin: 0; width: 500px">wide</p>
<img src="nowhere.png"><svg width="300" height="2000"></svg>
<script>console.error("heard"); undefined_name()</script><script src="http://127.0.0.1:9/x.js"></script>"""


@pytest.fixture(scope="module")
def reference():
    sys.path.insert(0, str(SITE))
    try:
        import reference

        yield reference.pages()
    finally:
        sys.path.remove(str(SITE))


@pytest.mark.parametrize(
    ("page", "kind"), [("mechanism_file", Mechanism), ("mechanism_file_six_axes", SixAxisMechanism)]
)
def test_documentation_site_has_every_key_of_the_mechanism_file(reference, page, kind):
    text = reference[f"reference/{page}.md"]
    for table in describe_tables(kind):
        part = text[text.index(f"## `[{table.path}]`") :] if table.path else text
        for key in table.keys:
            row = re.search(rf"^\| `{key.name}` \|.*", part, re.M)[0].split(" | ")
            assert row[1] == key.meaning and key.allowed.replace("|", "\\|") in row
            assert row[2] == (key.unit or row[2])


@pytest.mark.parametrize("command", COMMANDS)
def test_documentation_site_has_every_command_option(jaxhil, reference, command):
    text = reference["reference/commands.md"]
    [part] = re.findall(rf"^## jaxhil {command}$(.*?)(?=^## |\Z)", text, re.M | re.S)
    options = set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", jaxhil(command, "--help").out.split("options")[1]))
    assert options - {"-h", "--help"} <= set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", part))


def test_command_options_named_in_the_guide_exist(reference):
    parts = dict(
        re.findall(r"^## jaxhil (\w+)$(.*?)(?=^## |\Z)", reference["reference/commands.md"], re.M | re.S)
    )
    seen = 0
    for page in (ROOT / "README.md", *(ROOT / "notebooks" / "guide").glob("*.md")):
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        # Up to the end of the words in code, or of the line.
        for command, rest in re.findall(r"\bjaxhil ([a-z]+)((?: [^\s`]+|\n[^`\n]+(?=`))*)", text):
            for option in re.findall(r"(?<= )--?[a-z][a-z-]*", rest) if command in parts else ():
                assert re.search(rf"(?<![\w-]){option}(?![\w-])", parts[command]), (
                    page.name,
                    command,
                    option,
                )
                seen += 1
    assert seen > 50


def test_documentation_build_fails_for_undocumented_options_and_gains(reference, monkeypatch):
    module = sys.modules["reference"]

    @dataclasses.dataclass
    class Options:
        """Options with an option without help text."""

        depth: Annotated[float, tyro.conf.arg(metavar="NUMBER")] = 1.0

    with pytest.raises(ValueError, match="simulate: depth has no help"):
        module._command(Options, tyro.conf.subcommand("simulate"))
    gain = COMPENSATORS["phase_lead"].gains[0]
    with pytest.raises(ValueError, match="a gain without unit"):
        module._row_of_gain(gain._replace(unit=""), jaxhil.load("varying"))


def test_documentation_site_has_every_gain(reference):
    text = reference["reference/gains.md"]
    for name, law in COMPENSATORS.items():
        [part] = re.findall(rf"^### {name}$(.*?)(?=^### |\Z)", text, re.M | re.S)
        listed = re.findall(r"^\| `(\w+)` \| ([^|]+) \|", part, re.M)
        assert listed == [(one.name, one.unit) for one in law.gains]


def test_error_messages_on_documentation_site_equal_real_messages(jaxhil, reference):
    """`…` on the page stands for inserted values."""
    lines = re.findall(r"^(.*….*)$", reference["reference/messages.md"], re.M)
    patterns = [re.compile(".*".join(map(re.escape, line.split("…"))) + "$") for line in lines]
    for arguments in (
        ["simulate", "no.toml"],
        ["simulate", "--plot=x.doc"],
        ["tune", "--set", "rig.noise=1"],
    ):
        message = jaxhil(*arguments).err.strip().removeprefix("jaxhil: ")
        assert any(pattern.match(message) for pattern in patterns), message


def test_documentation_navigation_has_every_page_and_notebook():
    """A strict `mkdocs build` fails for a file missing from the navigation."""

    def leaves(entry):
        if isinstance(entry, str):
            return [entry]
        inner = entry.values() if isinstance(entry, dict) else entry
        return [path for one in inner for path in leaves(one)]

    listed = leaves(yaml.safe_load((SITE / "mkdocs.yml").read_text(encoding="utf-8"))["nav"])
    folder = ROOT / "notebooks"
    files = {
        path.relative_to(folder).as_posix() for path in [*folder.glob("*.ipynb"), *folder.glob("guide/*.md")]
    }
    assert len(listed) == len(set(listed))
    assert files == {path for path in listed if (folder / path).exists()}


def test_package_versions_on_documentation_site_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert citation["version"] == project["version"] == re.findall(r"^## ([\d.]+)", changes, re.M)[0]
    assert citation["authors"] == project["authors"]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocs_jupyter")
    folder = tmp_path_factory.mktemp("site")
    inherited = os.environ.get("PYTHONPATH")
    places = os.pathsep.join([str(ROOT), *([inherited] if inherited else [])])
    command = ["mkdocs", "build", "--quiet", "-f", SITE / "mkdocs.yml", "-d", folder]
    built = subprocess.run(
        [sys.executable, "-m", *command], env={**os.environ, "PYTHONPATH": places},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    return folder


class Page(HTMLParser):
    """Links of a page, files that it loads, and names of its anchors."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links, self.loads, self.places = [], [], {""}
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.places.add(attributes.get("id"))
        if tag == "a" and "href" in attributes:
            self.links.append(attributes["href"])
        elif tag in ("link", "script", "img", "iframe"):
            self.loads += [attributes[name] for name in ("href", "src") if name in attributes]


@pytest.mark.slow
def test_documentation_site_has_no_broken_links(site):
    pages = {path: Page(path) for path in sorted(site.rglob("*.html"))}
    assert len(pages) > 20
    for path, page in pages.items():
        assert not [load for load in page.loads if "://" in load or load.startswith("//")], path
        for link in page.links + [load for load in page.loads if not load.startswith("data:")]:
            address, place = urldefrag(link)
            if "://" in address or address.startswith("mailto:"):
                continue
            target = (path.parent / unquote(address)).resolve() if address else path
            assert target.exists(), f"{path.name}: {link}"
            assert target.suffix != ".html" or unquote(place) in pages[target].places, f"{path.name}: {link}"


@pytest.mark.slow
def test_browser_check_detects_errors_of_a_page(browser, tmp_path):
    path = tmp_path / "bad.html"
    path.write_text(BAD)
    opened = browser.open(path, 375)
    assert any("heard" in error for error in opened.errors)
    assert any("undefined_name" in error for error in opened.errors)
    assert opened.elsewhere == ["http://127.0.0.1:9/x.js"] and len(opened.missing) == 2
    pages, cut = browser.printed(400, 1017)
    assert pages > 1 and [fault.split('" ')[1][:10] for fault in cut] == ["ends at 50", "is 2000 px"]
    browser.open(path, 375)
    result = browser.evaluate(LAYOUT)["faults"]
    assert [" ".join(fault.split()[:2]) for fault in result] == ["500 px", "no picture", '"lies on']


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_documentation_pages_open_offline(site, browser, width):
    for path in sorted(site.rglob("*.html")):
        name = str(path.relative_to(site))
        assert browser.open(path, width) == ([], [], []), name
        seen = browser.evaluate(LAYOUT)
        assert seen["faults"] == [] and seen["texts"] > 10, name


@pytest.mark.slow
def test_no_content_is_cut_off_in_printed_documentation_pages(site, browser):
    for path in sorted(site.rglob("*.html")):
        browser.open(path, max(WIDTHS))
        pages, faults = browser.printed(*A4)
        assert pages > 0 and faults == [], path.relative_to(site)


@pytest.mark.slow
def test_documentation_pages_are_accessible(site, browser):
    """axe-core reports no serious problem; a single notebook represents all."""
    package = pytest.importorskip("axe_core_python")
    axe = (Path(package.__file__).parent / "axe.min.js").read_text(encoding="utf-8")
    notebooks = sorted(site.glob("0*.html"))
    for path in sorted({*site.rglob("*.html"), notebooks[0]} - {*notebooks[1:]}):
        browser.open(path, min(WIDTHS))
        browser.evaluate(f"{axe}; 0")
        result = browser.evaluate("axe.run({ resultTypes: ['violations'] }).then(told => told.violations.map("
                                 "one => [one.impact, one.id, one.nodes[0].target.join(' ')]))")  # fmt: skip
        grave = [one for one in result if one[0] in ("serious", "critical")]
        assert not grave, f"{path.relative_to(site)}: {grave}"


@pytest.mark.slow
def test_documentation_search_returns_a_mechanism_key_offline(site, browser):
    browser.open(site / "index.html", 1440)
    result = """new Promise(done => {
      const field = document.querySelector("[data-md-component=search-query]");
      field.focus();
      field.value = "unloading_ratio";
      field.dispatchEvent(new Event("keyup", { bubbles: true }));
      field.dispatchEvent(new Event("input", { bubbles: true }));
      const look = left => {
        const links = [...document.querySelectorAll(".md-search-result__link")].map(link => link.pathname);
        if (links.length || !left) done(links); else setTimeout(look, 100, left - 1);
      };
      look(100);
    })"""
    assert any(link.endswith("reference/mechanism_file.html") for link in browser.evaluate(result))
