"""Report page for a review board: rejected results, escaped names, and behaviour in a browser."""

import copy
import html
import json
import re
from pathlib import Path

import pytest
from browser import LAYOUT
from gain_documents import gain_document, sign

import jaxhil
import tuning
from jaxhil.rig import digest
from tuning.cli.commands.identify_tables import SCHEMA
from tuning.reporting.result_files import read_results
from tuning.reporting.verdict_sections import collect_requirements

SCRIPT = "<script>window.hurt = 1</script>"
HOSTILE = f'x"\'>{SCRIPT}<img src=x onerror="window.hurt=1"> {{{{ 9**9 }}}} $\\frac$ &amp;'
WIDTHS = (375, 1440)
A4 = 703, 1017  # pixels within the margins


def signed(document):
    return {**document, "sha256": digest(document)}


def write_identification(name=HOSTILE, **others):
    """Write the result file of `jaxhil identify` with third-party texts."""
    estimate = {"key": name, "value": 1.0, "std": 0.1, "low": 0.8, "high": 1.2, "unit": name, "known": False}
    check = {"name": name, "finding": name, "where": name, "there": False, "effect": 0.001}
    document = {
        "schema": SCHEMA, "estimates": [estimate], "checks": [check], "effect": 0.001, "limit": 0.01,
        "verdict": "good", "reason": name, "notes": [name], "sources": {name: name}, "seed": 0,
        "versions": {name: name}, "mechanism": {"name": name},
    }  # fmt: skip
    return signed({**document, **others})


def write_map(name=HOSTILE):
    """Write the result file of `jaxhil map`."""
    error = [[0.1, -0.02, None], [0.3, 0.0, 0.01]]
    margin = {"low": None, "high": 4.0}
    return signed({
        "schema": "jaxhil/map/1", "mechanism": name, "compensator": name, "gains": {}, "limit": 0.01,
        "seed": 0,
        "x": {"key": name, "unit": name, "nominal": 2.0, "values": [1.0, 2.0, 3.0]},
        "y": {"key": "b", "unit": "s", "nominal": 0.1, "values": [0.1, 0.2]},
        "error": error, "restitution": error, "theory": {"none_because": name},
        "spectral_radius": {"x": [1.0, 3.0], "y": [0.1, 0.2], "values": [[0.9, 1.1], [1.0, 1.2]]},
        "nominal": {"error": -0.02, "restitution": 0.98, "growth": None,
                    "margins": {"error": {"x": margin, "y": margin}, "spectral_radius": None}},
    })  # fmt: skip


def write_monitor(name=HOSTILE, **others):
    """Write the output of `jaxhil monitor --json`."""
    figures = {one: {"value": 0.01, "predicted_std": 0.02, "z": 0.5} for one in ("stiffness", "noise", name)}
    figures["bias"] = {"value": None, "predicted_std": None, "z": None}
    contacts = [{"contact": n, "log": name, "state": "good", "figures": figures} for n in range(1, 81)]
    document = {
        "schema": "jaxhil/monitor/1", "mechanism": name, "mechanism_sha256": name, "state": "good",
        "reason": name, "alarm": None, "since": None, "contacts": contacts, "notes": [name],
        "sources": {name: name}, "versions": {name: name},
    }  # fmt: skip
    return signed({**document, **others})


def write_comparison(name=HOSTILE):
    """Write the result file of `jaxhil compare`."""
    figures = {name: {"rms": {"value": 0.1, "low": 0.05, "high": None}, "noise": {"value": None}}}
    return signed({
        "limit": 0.01, "seed": 0, "scenarios": 2, "judged": 4, "tuned": True,
        "mechanisms": [{"mechanism": name, "laws": [{"law": name, "figures": figures}]}],
    })  # fmt: skip


@pytest.fixture
def put(tmp_path):
    def write(document, name="identification.json", folder="result"):
        (tmp_path / folder).mkdir(exist_ok=True)
        text = document if isinstance(document, str) else json.dumps(document)
        (tmp_path / folder / name).write_text(text)
        return tmp_path / folder

    return write


def test_mechanism_names_in_report_are_escaped(put):
    places = [
        put(write_identification(), folder="a"),
        put(write_map(), "map.json", "b"),
        put(write_comparison(), "compare.json", "c"),
        put(write_monitor(), "monitor.json", "d") / "monitor.json",
    ]
    made = tuning.report(places)
    page = made.html.decode()
    assert made.verdict == "good" and "9**9" in page and "387420489" not in page
    # The only script that could run is the page's own; tags from a name are text.
    assert page.count("<script>") == 1 and not re.search(r"<[^>]*\sonerror\s*=", re.sub(r'"[^"]*"', "", page))
    assert page.count(html.escape(SCRIPT)) > 10
    assert "script-src 'sha256-" in page and "default-src 'none'" in page


def test_report_verdict_follows_from_all_requirements(put):
    made = tuning.report(put(write_identification(effect=0.02, verdict="bad")))
    assert made.verdict == "bad" and "Bad: not every requirement is met." in made.html.decode()
    [one] = made.requirements
    assert one["margin"] == "-0.01" and one["result"] == "0.02" and one["verdict"] == "bad"
    assert tuning.report(put(write_comparison(), "compare.json", "c")).verdict == "unknown"
    made = tuning.report(put(write_monitor(state="bad", since=4), "monitor.json", "d") / "monitor.json")
    assert made.verdict == "bad" and made.requirements[0]["result"] == "bad since contact 4 of 80 contacts"


@pytest.mark.parametrize(("factor", "verdict"), [(1 + 4e-12, "good"), (1 + 1e-9, "unknown")])
def test_identification_counts_as_evidence_although_its_file_is_rounded_to_12_digits(put, factor, verdict):
    gains = sign(gain_document("none") | {"envelope": {}})
    mechanism = copy.deepcopy(gains["mechanism"])
    mechanism["contact"]["stiffness"][0] *= factor
    paths = [put(write_identification(mechanism=mechanism)), put(gains, "gains.json", "tuned")]
    [requirement] = collect_requirements(read_results(paths))
    assert requirement.verdict == verdict


@pytest.mark.parametrize(
    ("document", "said"),
    [
        (write_identification() | {"effect": 0.0}, "the file was changed"),
        (write_identification(estimates=[{"key": 1}]), "Expected `str`, got `int` - at `$.estimates[0].key`"),
        (write_identification(schema="other/1"), "found the schema 'other/1'"),
        (signed(write_map() | {"error": [[0.0]]}), "a table that does not match its axes"),
        ({"some": "thing"}, "no schema of jaxhil"),
        ([1, 2], "found no JSON object"),
        ('{"schema": NaN}', "found no JSON"),
        ("[" * 100_000, "found no JSON"),
        ({"schema": "jaxhil/gains/1"}, "sha256: found nothing"),
    ],
)
def test_report_rejects_third_party_results_with_one_line_message(jaxhil, put, tmp_path, document, said):
    ended = jaxhil("report", put(document), "-o", tmp_path / "page.html")
    assert ended.code == 2 and said in ended.err and ended.err.count("\n") == 1
    assert not (tmp_path / "page.html").exists()


def test_report_command_rejects_invalid_arguments(jaxhil, put, tmp_path):
    one = put(write_identification())
    for arguments, message in (
        ([], "RESULT: found none"),
        ([one, one], "one of each kind"),
        ([tmp_path / "none"], "cannot be read"),
        ([tmp_path], "found no result"),
        ([one, "-o", tmp_path / "page.png"], "ends in .html"),
    ):
        ended = jaxhil("report", *arguments)
        assert ended.code == 2 and message in ended.err, arguments


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Write the results of all commands for a mechanism whose name contains special characters."""
    folder = tmp_path_factory.mktemp("results")
    mechanism = jaxhil.load("varying", {"name": HOSTILE, "rig.force_sensor.noise_std": 0.5})
    tuned = tuning.tune(mechanism, "phase_lead", scenarios=16, starts=1)
    tuned.save(folder / "gains.json")
    study = tuning.sweep(
        folder / "gains.json", scenarios=1500, folder=folder / "sweep", drivers=64, rare=0.9, limit=0.5
    )
    tuning.export(tuned, folder / "bundle", sweep=study, false_alarms=1.0, missed=1.0)
    axes = "contact.stiffness", "rig.force_sensor.delay"
    tuning.map(mechanism, *axes, "phase_lead", tuned.gains, points=12, folder=folder / "map")
    return [folder / name for name in ("gains.json", "sweep", "bundle", "map")]


@pytest.fixture(scope="module")
def whole(results, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    made = tuning.report(results)
    made.save(path)
    return path


@pytest.mark.slow
def test_report_contains_all_results_in_the_folder(whole):
    text = whole.read_text(encoding="utf-8")
    for folder in ("requirements", "assumptions", "gains", "runs", "errors", "drivers", "watchdog", "map",
                  "reproduction", "sign-off"):  # fmt: skip
        assert f'<section id="{folder}">' in text
    assert text.count('class="trace"') > 10 and "jaxhil replay" in text and "jaxhil sweep" in text


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_report_page_opens_offline(whole, browser, width):
    assert browser.open(whole, width) == ([], [], [])
    seen = browser.evaluate(LAYOUT)
    assert seen["faults"] == [] and seen["texts"] > 100
    assert browser.evaluate("window.hurt") is None


SHOWN = "[...document.querySelectorAll('.trace')].filter(one => one.checkVisibility()).map(one => one.id)"


@pytest.mark.slow
def test_click_on_a_scenario_in_report_shows_its_time_history(whole, browser):
    browser.open(whole, 1440)
    first = browser.evaluate(SHOWN)
    links = browser.evaluate(
        "[...document.querySelectorAll('.picture a')].map(one => one.getAttribute('href'))"
    )
    assert len(first) == 1 and {f"#{one}" for one in first} < set(links)
    wanted = next(link for link in links if link != f"#{first[0]}")
    browser.click(f".picture a[href='{wanted}']")
    assert browser.evaluate(SHOWN) == [wanted[1:]]
    assert browser.evaluate(f"document.querySelector('{wanted} svg').getBoundingClientRect().height") > 100


@pytest.mark.slow
def test_report_pictures_can_be_magnified(whole, browser):
    browser.open(whole, 1440)
    seen = "+document.querySelector('.picture svg').getAttribute('viewBox').split(' ')[2]"
    before = browser.evaluate(seen)
    browser.click(".buttons button")
    assert browser.evaluate(seen) == pytest.approx(before / 1.6)


@pytest.mark.slow
def test_report_page_is_accessible(whole, browser):
    """axe-core reports no serious problem.

    Pictures are excluded to save minutes; each has a text alternative.
    """
    package = pytest.importorskip("axe_core_python")
    axe = (Path(package.__file__).parent / "axe.min.js").read_text(encoding="utf-8")
    for width in WIDTHS:
        browser.open(whole, width)
        browser.evaluate(f"{axe}; 0")
        script = """axe.run({ exclude: ['.picture svg > g'] }, { resultTypes: ['violations'] })
            .then(told => told.violations.map(one => [one.impact, one.id, one.nodes[0].target.join(' ')]))"""
        result = browser.evaluate(script)
        assert [one for one in result if one[0] in ("serious", "critical")] == []


@pytest.mark.slow
def test_no_picture_is_cut_off_in_printed_report(whole, browser):
    """No element exceeds a page or is split between pages."""
    browser.open(whole, 1440)
    pages, faults = browser.printed(*A4)
    assert pages > 3 and faults == []
    assert browser.evaluate("document.querySelector('.picture svg').getBoundingClientRect().height") > 200
