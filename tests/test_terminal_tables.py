"""Terminal output: tables without lost digits or broken names at any width, and JSON."""

import json
import math

import numpy as np
import pytest

from tuning import terminal
from tuning.number_format import format_number

LAW = "multi_parameter_lead"
FIGURES = [12.34, 20.15, 200.2, 0.1041, 0.5123, 0.9252, 1.443, 4.125]


@pytest.mark.parametrize("width", [30, 60, 80, 110, 300])
def test_terminal_table_shows_every_digit(monkeypatch, capsys, width):
    monkeypatch.setenv("COLUMNS", str(width))
    heads = ["law", *(f"figure {number} %" for number in range(len(FIGURES)))]
    terminal.emit(
        terminal.build_table(
            "suite-damped: each compensator, and a title that is long", heads, [[LAW, *FIGURES]]
        )
    )
    *title, _, _, _, line, _ = capsys.readouterr().out.splitlines()
    words = "suite-damped: each compensator, and a title that is long".split()
    assert " ".join(title).split()[: len(words)] == words
    assert line.split() == [LAW, *(f"{figure:.4g}" for figure in FIGURES)]


def test_terminal_table_wraps_long_texts_between_words(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "60")
    text = "force delay, noise of the force sensor and dead zone, equivalent mass, roughly the surface"
    terminal.emit(
        terminal.build_table("costs", ["law", "known beforehand", "us"], [[LAW, text, 1.25]], (0, 1))
    )
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 60
    assert set(" ".join(lines).split()) >= {LAW, *text.split(), "1.25"}


def test_narrow_table_breaks_long_keys_before_their_last_part(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "76")
    keys = "rig.simulator.natural_frequency", "rig.force_sensor.time_constant", "contact.damping[0]"
    rows = [[key, 0.0043028, 0.0043001, 0.0043056, "N s/m", 124355.1234, "+848 %"] for key in keys]
    heads = ["number", "estimate", "95 % from", "to", "unit", "prior", "change"]
    terminal.emit(terminal.build_table("Identified", heads, rows, texts=(0, 4)))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 76
    assert {line.split()[0] for line in lines[5:-1]} == {
        *("rig.simulator.", "natural_frequency", "rig.force_sensor.", "time_constant", keys[2])
    }


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (124355.1, "124400"),
        (-9999.6, "-10000"),
        (99_996_000.0, "100000000"),
        (1.0e8, "1e+08"),
        (0.00003, "3e-05"),
        (3.14159, "3.142"),
        (123456, "123456"),
        *((value, "-") for value in (math.nan, math.inf, None, True)),
    ],
)
def test_numbers_below_a_hundred_million_have_no_exponent(value, text):
    assert format_number(value) == text


def test_piped_output_is_wrapped_to_environment_variable_columns(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "40")
    terminal.emit("word " * 20)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 and max(map(len, lines)) <= 40


def test_json_output_has_numbers_for_numpy_scalars_and_null_for_nonfinite_values():
    said = {
        "yes": np.bool_(True),
        "three": np.int64(3),
        "half": np.float32(0.5),
        "each": np.array([1.0, np.nan]),
    }
    assert json.loads(terminal.format_json(said)) == {
        "yes": True,
        "three": 3,
        "half": 0.5,
        "each": [1.0, None],
    }


@pytest.mark.parametrize(
    ("key", "shown"),
    [
        ("contact.stiffness.1", "contact.stiffness[1]"),
        ("contact.stiffness_2", "contact.stiffness[1]"),
        ("contact.stiffness_1_3", "contact.stiffness[0][2]"),
        ("rig.force_sensor.delay", "rig.force_sensor.delay"),
    ],
)
def test_list_entry_is_named_with_bracketed_index_in_tables(key, shown):
    assert terminal.format_key(key) == shown
