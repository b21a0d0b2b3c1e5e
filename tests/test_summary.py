"""Summary page of a bundle: every gain and limit, self-contained, without unknown facts."""

import base64
import copy
import re
from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest
from bundles import document
from matplotlib import image

from jaxhil.rig.limits import LIMITS
from tuning.bundle.bundle import replace_limits
from tuning.bundle.summary import summary_html
from tuning.plots.bundle_summary import COLOURS, summary_png

FIGURES = {
    "rms": 0.5, "p99": 1.25, "max": 1.5, "mean": 0.375, "diverging": 1.0, "peak_ratio": 1.75,
    "chatter": 0.0, "failed": 3,
}  # fmt: skip
RATE = {"runs": 5000, "alarms": 0, "rate": 0.0, "low": 0.0, "high": 0.00073, "allowed": 0.01}
RATES = {
    "limit": 0.01,
    "restitution_margin": 0.0125,
    "false_alarms": RATE,
    "missed_alarms": {**RATE, "runs": 40, "alarms": 2, "high": 0.17, "allowed": 0.02},
    "noticed_from": {"error": 0.0175, "contacts": 25, "largest": 0.03},
    "widened_from": 0.0025,
    "verdict": "unknown",
    "reasons": [],
    "unknown": ["missed alarms: <0 to 0.17>"],
}


def full_document():
    made = copy.deepcopy(document("varying", "response_error"))
    one = {name: {**FIGURES, "rms": 0.5 / 10**index} for index, name in enumerate(COLOURS)}
    made["figures"] = {"nominal": one, "robust": one, "tuned_intervals": {}}
    made["envelope"] = {
        "contact_frequency": {"low": 1.625, "high": 6.5, "unit": "Hz"},
        "delay": {"low": 0.0045, "high": 0.0056, "unit": "s"},
        "approach_velocity": {"low": 0.005, "high": 0.005, "unit": "m/s"},
        "force": {"low": 15.0, "high": 83.0, "unit": "N"},
    }
    # Special values, and some missing limits.
    limits = {name: None if index % 7 == 3 else 1.5 + index for index, name in enumerate(LIMITS)}
    return replace_limits(made, limits, RATES)


class Page(HTMLParser):
    """Texts of the page, its balanced tags, and its references."""

    def __init__(self, content):
        super().__init__()
        self.open, self.references, self.texts, self.rows = [], [], [], []
        self.feed(content.decode("utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        self.references += [value for name, value in attributes if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] in (["td"], ["th"]):
            self.rows[-1].append(data)
        self.texts.append(data)


# Scale and unit of limits in the summary, by their SI unit.
SHOWN_UNITS = {"m": (1e3, "mm"), "m/s": (1e3, "mm/s"), "s": (1e3, "ms")}


@pytest.fixture(scope="module")
def made():
    return full_document()


@pytest.fixture(scope="module")
def page(made):
    return Page(summary_html(made))


def test_bundle_summary_has_a_row_with_unit_for_every_gain(made, page):
    rows = {row[0]: row for row in page.rows if row}
    for name, one in made["gains"].items():
        assert float(rows[name][1]) == pytest.approx(one["value"], rel=1e-5) and rows[name][2] == one["unit"]


def test_bundle_summary_lists_every_limit_or_states_that_no_limit_is_set(made, page):
    rows = {row[0]: row for row in page.rows if row}
    text = " ".join(page.texts)
    unset = re.search(r"the widest limit holds: ([^.]*)\.", text)[1].split(", ")
    for name, one in made["limits"].items():
        if one["value"] is None:
            assert name in unset
        elif name in rows:
            scale, unit = SHOWN_UNITS.get(one["unit"], (1.0, one["unit"]))
            assert float(rows[name][1]) == pytest.approx(scale * one["value"], rel=1e-3), name
            assert rows[name][2] == unit
        else:
            assert name.startswith(("expected_", "softness_", "speed_", "loss_", "reference_")), name
    assert {"force_limit", "restitution_margin"} <= {*rows} | {*unset}


def test_bundle_summary_states_purpose_quality_and_confidence(made, page):
    text = " ".join(page.texts)
    for part in (
        *(
            "varying: compensator response_error",
            made["sha256"],
            made["created"],
            "numpy",
            "350 kg at 5 mm/s",
        ),
        "False alarms 0 of 5000 good runs (95 %: 0 to 0.00073, limit 0.01)",
        "missed alarms 2 of 40 runs to be stopped (95 %: 0 to 0.17, limit 0.02)",
        "Unknown: missed alarms: <0 to 0.17>.",
        "restitution_margin widened from 0.0025 to 0.013, because too many good runs would be stopped",
        "errors above 0.018 are detected in 95 % of contacts",
    ):
        assert part in text, part
    rows = {row[0]: row for row in page.rows if row}
    assert rows["tuned"][1:] == ["0.005", "1.25", "1.5", "0.375", "1.75", "3"]


def test_bundle_summary_is_self_contained_and_reproducible(made, page):
    assert len(page.references) == 1 and page.references[0].startswith("data:image/png;base64,")
    assert summary_html(made) == summary_html(made)
    content = summary_html(made).decode()
    assert "http" not in content and "@page { size: A4" in content


def test_bundle_summary_has_a_single_picture(made, page, tmp_path):
    content = base64.b64decode(page.references[0].partition(",")[2])
    assert content == summary_png(made)
    (tmp_path / "picture.png").write_bytes(content)
    pixels = image.imread(tmp_path / "picture.png")[..., :3]
    assert pixels.shape[1] > 1000 and pixels.shape[1] / pixels.shape[0] > 2.5
    for colour in COLOURS.values():
        wanted = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
        assert np.sum(np.all(np.abs(pixels - wanted) < 0.02, axis=-1)) > 100, colour
    # Nothing touches the edge of the picture.
    edges = [pixels[:3], pixels[-3:], pixels[:, :3], pixels[:, -3:]]
    assert all(np.all(edge == 1.0) for edge in edges)


def test_bundle_summary_picture_ignores_user_matplotlib_settings(made):
    with matplotlib.rc_context({"figure.constrained_layout.use": True, "font.size": 20}):
        inside = summary_png(made)
    assert inside == summary_png(made)


def test_bundle_summary_fits_on_a_single_printed_page(page):
    # A4 less margins is 275 mm: 3.7 mm a row in the longer column, 110 mm for heading, picture and figures.
    limits = [row for row in page.rows if len(row) == 3]
    gains = [row for row in page.rows if len(row) == 4]
    assert 3.7 * max(len(limits), len(gains)) + 110 + 20 < 275


def test_mechanism_name_in_bundle_summary_is_escaped(made):
    hostile = {**made, "mechanism": {**made["mechanism"], "name": "<script>alert('$x_1')</script>\n&"}}
    content = summary_html(hostile)
    assert b"<script" not in content and b"&lt;script&gt;" in content
    Page(content)


def test_bundle_summary_marks_unknown_values_as_unknown():
    bare = document("rattling", "none")
    text = " ".join(Page(summary_html(bare)).texts)
    assert "None: the force command is the measured force." in text
    assert "None in the gain file: the controller's widest limits hold." in text
    assert "contains no restitution errors" in text
    unknown = replace_limits(bare, {"force_limit": 1.0})
    assert "Rates of false and missed alarms are not known." in " ".join(Page(summary_html(unknown)).texts)
