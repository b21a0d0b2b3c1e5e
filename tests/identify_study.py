"""Study of `jaxhil identify` on campaigns of two generators: verdict, errors, intervals and `--check`.

`python tests/identify_study.py FILE [--first SEED] [--count N] [--kinds KIND ...]` appends one line of JSON
per campaign to FILE and prints a summary of each kind. It omits campaigns that FILE contains already, so that
an interrupted study continues. The kinds are those of `independent_logs`, "mixture" (a random combination of
their properties on a random rig) and, with the prefix "ambiguous ", those of `ambiguous_campaigns`.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import ambiguous_campaigns as ambiguous
import independent_logs
import numpy as np
import pytest
from independent_study import Outcome, evaluate_identification

from jaxhil.mechanism.file import from_plain_data
from jaxhil.simulation.gain_choice import choose_gains
from jaxhil.simulation.jax_environment import prepare_jax
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.mechanism_check import check_against_mechanism

AMBIGUOUS = {f"ambiguous {name}": name for name in ambiguous.KINDS}
KINDS = (*independent_logs.KINDS, independent_logs.MIXTURE, *AMBIGUOUS)


def evaluate_ambiguous_identification(name, seed):
    """Simulate an ambiguous campaign, identify it and return the outcome."""
    kind = ambiguous.KINDS[name]
    with pytest.MonkeyPatch.context() as monkeypatch:
        campaign = ambiguous.campaign(monkeypatch, name, seed)
    begin = time.process_time()
    result = identify(campaign, ambiguous.prior(name), IdentificationOptions(seed=seed))
    seconds = time.process_time() - begin
    mechanism = from_plain_data(result.mechanism, "identified")
    check = "good" if check_against_mechanism(campaign, mechanism).good else "bad"
    gains = choose_gains(ambiguous.truth(name), "response_error", None)[1]
    ((error, difference),) = ambiguous.deviations(name, [mechanism], "response_error", gains)
    share = mechanism.rig.position_sensor.delay - kind.rig["position_sensor"].get("delay", 0.0)
    sensor = kind.rig["force_sensor"]
    age = sensor["delay"] + sensor.get("time_constant", 0.0) + share
    items = {item.key: item for item in (*result.estimates, *result.combinations)}
    lag = "delay and lag of force"
    true = {f"contact.{key}.0": kind.contact[key][0] for key in ("stiffness", "damping")}
    true[lag if lag in items else "rig.force_sensor.delay"] = age
    # A law with layers, if the noise suggests one, has other keys of stiffness.
    covered = {
        key: bool(items[key].low <= value <= items[key].high) for key, value in true.items() if key in items
    }
    verdict, message = "good" if result.good else "bad", " | ".join([result.verdict, *result.notes])
    kind_name, error, difference = f"ambiguous {name}", float(error), float(difference)
    return Outcome(kind_name, seed, verdict, message, check, np.nan, error, difference, True, "", seconds,
                   covered)  # fmt: skip


def evaluate(kind, seed):
    """Identify one campaign and return the outcome; an exception is part of the outcome."""
    folder = Path(tempfile.mkdtemp())
    try:
        if kind in AMBIGUOUS:
            return evaluate_ambiguous_identification(AMBIGUOUS[kind], seed)
        return evaluate_identification(kind, seed, folder)
    except Exception as error:
        trouble = f"{type(error).__name__}: {error}"
        return Outcome(kind, seed, "", "", "", np.nan, np.nan, np.nan, False, trouble, np.nan, {})
    finally:
        shutil.rmtree(folder)


def load_outcomes(path):
    """Return the outcomes in a file by kind."""
    outcomes = {}
    if path.exists():
        for line in path.read_text().splitlines():
            outcome = Outcome(**json.loads(line))
            outcomes.setdefault(outcome.kind, []).append(outcome)
    return outcomes


def summarise(kind, outcomes):
    """Return a line about all outcomes of a kind."""
    verdicts = Counter(outcome.verdict for outcome in outcomes)
    good = [outcome for outcome in outcomes if outcome.verdict == "good"]
    wrong = sum(outcome.wrong for outcome in good)
    differ = sum(outcome.check not in ("", outcome.verdict) for outcome in outcomes)
    unnamed = sum(not outcome.named for outcome in outcomes if outcome.verdict != "good")
    trouble = sum(outcome.trouble != "" for outcome in outcomes)
    error = max((abs(outcome.error) for outcome in good), default=0.0)
    difference = max((abs(outcome.difference) for outcome in good), default=0.0)
    inside = [covers for outcome in outcomes for covers in outcome.covered.values()]
    covered = f"{np.mean(inside):.3f} of {len(inside)}" if inside else "-"
    return (
        f"{kind:22} good {verdicts['good']:3} bad {verdicts['bad']:3} refused {verdicts['refused']:3}"
        f"   good but wrong {wrong:3}   worst e {error:.4f} e-e* {difference:.4f}   check differs {differ:3}"
        f"   defect not named {unnamed:3}   internal error {trouble:3}   intervals cover {covered}"
        f"   {np.nanmedian([outcome.seconds for outcome in outcomes]):.1f} s"
    )


def main():
    """Run the study for each seed and, in turn, each kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS, metavar="KIND")
    options = parser.parse_args()
    prepare_jax()
    outcomes = load_outcomes(options.file)
    done = {(outcome.kind, outcome.seed) for results in outcomes.values() for outcome in results}
    for seed in range(options.first, options.first + options.count):
        for kind in [kind for kind in options.kinds if (kind, seed) not in done]:
            outcome = evaluate(kind, seed)
            outcomes.setdefault(kind, []).append(outcome)
            with options.file.open("a") as lines:
                lines.write(json.dumps(asdict(outcome)) + "\n")
    for kind, results in outcomes.items():
        print(summarise(kind, results))


if __name__ == "__main__":
    main()
