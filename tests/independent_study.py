"""Outcome of `jaxhil identify` on a campaign of the independent generator."""

import contextlib
import io
import json
import time
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from independent_logs import get_kind, write_campaign
from independent_rig import ideal_restitution, restitution

LIMIT = 0.01  # error of e or e - e* beyond which a file is wrong
SILENT = {
    f"rig.{sensor}_sensor.{key}": 0.0 for sensor in ("force", "position") for key in ("noise_std", "quantum")
}
NO_BIAS = {"rig.force_sensor.bias": 0.0, "rig.force_sensor.bias_random_walk": 0.0}
PHASES = (0.0, 0.25, 0.5, 0.75)  # of a contact within a control period
VERDICTS = {0: "good", 1: "bad", 2: "refused"}


@dataclass
class Outcome:
    """Result of identification for one campaign, and the true values."""

    kind: str
    seed: int
    verdict: str  # good, bad or refused (exit code 2)
    message: str
    check: str  # verdict of `--check`; empty where no file was written
    restitution: float  # e of the true rig; all e and e - e* are for the file's gains
    error: float  # e of the file minus e of the true rig
    difference: float  # e - e* of the file minus e - e* of the true rig
    named: bool  # whether the message names the defect or, for a clean kind, a check
    trouble: str  # an internal error
    seconds: float  # processor time of identify without plots
    covered: dict[str, bool]  # whether each interval includes the true value, by key

    @property
    def wrong(self):
        """Return whether an error of the file exceeds the limit."""
        return not (abs(self.error) <= LIMIT and abs(self.difference) <= LIMIT)


def run_command(*arguments):
    """Run `jaxhil` in this process and return exit code, standard output and standard error."""
    from tuning.__main__ import main

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
    return code, out.getvalue(), err.getvalue()


def errors_of(file, campaign):
    """Return the true e, and the errors of e and e - e* of the file, at the literature's gains.

    They are means over phases of the contact: otherwise an error of the surface that does not matter, of a
    fraction of the travel per control period, would change them.
    """
    import jaxhil
    from jaxhil.rig import COMPENSATORS

    rig, speed = campaign.rig, campaign.speed
    approach = {"approach.velocity": speed, "approach.contacts": 1}
    results = []
    for phase in PHASES:
        mechanism = jaxhil.load(str(file), {**SILENT, **approach, **NO_BIAS, "approach.phase": phase})
        run = jaxhil.simulate(mechanism, "response_error")
        law = COMPENSATORS["response_error"](run.gains, rig.period, np.inf)
        contact = run.contacts[0]
        results.append([restitution(rig, speed, law.step, phase), contact.restitution, contact.error])
    e, of_file, error_of_file = np.mean(results, axis=0).tolist()
    return e, of_file - e, error_of_file - (e - ideal_restitution(rig, speed))


def evaluate_identification(kind, seed, folder):
    """Write a campaign, identify it and return the outcome."""
    campaign = write_campaign(kind, seed, folder)
    begin, result = time.process_time(), folder / "identified"
    with patch("tuning.plots.identification.draw_identification", lambda *_: {}):
        code, out, err = run_command(*campaign.arguments, "-o", result)
    seconds, check, covered = time.process_time() - begin, "", {}
    e = error = difference = np.nan
    # Without a file, the report on standard output says why.
    verdict, message = VERDICTS.get(code, str(code)), " ".join((out + err).split())
    text = message
    if (result / "mechanism.toml").exists():
        document = json.loads((result / "identification.json").read_text())
        covered, message = check_intervals(campaign.rig, document), document["reason"]
        large = [
            c
            for c in document["checks"]
            if c["there"] and max(c["effect"] or 0, c["effect_on_error"] or 0) > LIMIT / 2
        ]
        text = " ".join([message, *(f"{c['name']} {c['finding']}" for c in large), *document["notes"]])
        if verdict == "good":  # this check takes longer than all others
            e, error, difference = errors_of(result / "mechanism.toml", campaign)
        arguments = [
            "identify",
            "--check",
            *campaign.logs,
            result / "mechanism.toml",
            "--map",
            campaign.mapping,
        ]
        code, _, err_of_check = run_command(*arguments)
        check = VERDICTS.get(code, str(code))
        err += err_of_check
        message = " | ".join([message, *(f"{c['name']}: {c['finding']} ({c['effect']:.2g})" for c in large)])
        message = " | ".join([message, *document["notes"]])
    elif verdict == "bad":
        verdict = "refused"
    words = get_kind(kind, seed).defect
    named = any(word in text for word in words) if words else len(text) > 0
    trouble = err if "internal error" in err or "Traceback" in err else ""
    return Outcome(kind, seed, verdict, message, check, e, float(error), float(difference), named, trouble,
                   seconds, covered)  # fmt: skip


def check_intervals(rig, document):
    """Return, by key, whether the intervals of an identification include the true values of the rig."""
    items = {item["key"]: item for item in (*document["estimates"], *document["combinations"])}
    # Only the sum of the delays of motion and position sensor is determined.
    share = items.get("rig.position_sensor.delay", {"value": 0.0})["value"]
    age = rig.force_delay + share
    lagging = {"rig.force_sensor.time_constant", "rig.force_sensor.filter.cutoff"} & set(items)
    if rig.filter_order and (rig.filter_order == 1 or "rig.force_sensor.filter.cutoff" in items):
        # At low frequencies, the filter acts like a delay.
        sines = np.sin(np.pi * (2 * np.arange(rig.filter_order) + 1) / (2 * rig.filter_order))
        age += sines.sum() / (2 * np.pi * rig.cutoff)
    true = {
        "rig.force_sensor.filter.cutoff": rig.cutoff,
        "rig.force_sensor.dead_zone": rig.dead_zone,
        "contact.stiffness.0": rig.stiffness,
        "contact.damping.0": rig.damping,
        "rig.contact_plane": rig.plane,
        "rig.simulator.natural_frequency": rig.frequency,
        "rig.simulator.damping_ratio": rig.ratio,
        "rig.simulator.delay": rig.drive_delay - share,
        "rig.simulator.window": rig.window,
        "delay and lag of force" if lagging else "rig.force_sensor.delay": age,
    }
    if not {"rig.simulator.natural_frequency", "rig.simulator.window"} & set(items):
        del true["rig.simulator.delay"]  # a motion simulator of another structure has another delay
    return {
        key: bool(items[key]["low"] <= value <= items[key]["high"])
        for key, value in true.items()
        if key in items and not items[key]["known"]
    }
