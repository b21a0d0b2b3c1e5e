"""Study of `jaxhil identify` on campaigns of the independent generator.

`python tests/independent_study.py FOLDER FIRST COUNT [KIND ...]` runs it for COUNT seeds of each kind.
"""

import contextlib
import io
import json
import shutil
import sys
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from independent_logs import KINDS, write_campaign
from independent_rig import ideal_restitution, restitution

LIMIT = 0.01  # error of e or e - e* beyond which a file is wrong
SILENT = {
    f"rig.{sensor}_sensor.{key}": 0.0 for sensor in ("force", "position") for key in ("noise_std", "quantum")
}
VERDICTS = {0: "good", 1: "bad", 2: "refused"}


@dataclass
class Outcome:
    """Result of identification for one campaign, and the true values."""

    kind: str
    seed: int
    verdict: str  # good, bad or refused
    message: str
    check: str  # verdict of `--check`; empty where no file was written
    restitution: float  # e of the true rig; all e and e - e* are for the file's gains
    error: float  # e of the file minus e of the true rig
    difference: float  # e - e* of the file minus e - e* of the true rig
    named: bool  # the message names the defect or, for a clean kind, a check
    trouble: str  # an internal error
    seconds: float  # duration of identify

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
    """Return the true e, and the errors of e and e - e* of the file, at the literature's gains."""
    import jaxhil
    from jaxhil.rig import COMPENSATORS

    approach = {"approach.velocity": campaign.speed, "approach.contacts": 1}
    mechanism = jaxhil.load(str(file), {**SILENT, **approach, "rig.force_sensor.bias": 0.0})
    run = jaxhil.simulate(mechanism, "response_error")
    law = COMPENSATORS["response_error"](run.gains, campaign.rig.period, np.inf)
    e, ideal = (
        restitution(campaign.rig, campaign.speed, law.step),
        ideal_restitution(campaign.rig, campaign.speed),
    )
    contact = run.contacts[0]
    return e, contact.restitution - e, contact.error - (e - ideal)


def evaluate_identification(kind, seed, folder):
    """Write a campaign, identify it and return the outcome."""
    campaign = write_campaign(kind, seed, folder)
    begin, result = time.perf_counter(), folder / "identified"
    code, out, err = run_command(*campaign.arguments, "-o", result)
    seconds, check = time.perf_counter() - begin, ""
    e = error = difference = np.nan
    # Without a file, the report on standard output says why.
    verdict, message = VERDICTS.get(code, str(code)), " ".join((out + err).split())
    text = message
    if (result / "mechanism.toml").exists():
        document = json.loads((result / "identification.json").read_text())
        message = document["reason"]
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
    words = KINDS[kind].defect
    named = any(word in text for word in words) if words else len(text) > 0
    trouble = err if "internal error" in err or "Traceback" in err else ""
    return Outcome(
        kind, seed, verdict, message, check, e, float(error), float(difference), named, trouble, seconds
    )


def summary(kind, outcomes):
    """Return a line about all outcomes of a kind."""
    verdicts = Counter(outcome.verdict for outcome in outcomes)
    good = [outcome for outcome in outcomes if outcome.verdict == "good"]
    wrong = sum(outcome.wrong for outcome in good)
    differ = sum(outcome.check not in ("", outcome.verdict) for outcome in outcomes)
    unnamed = sum(not outcome.named for outcome in outcomes if outcome.verdict != "good")
    error = max((abs(outcome.error) for outcome in good), default=0.0)
    difference = max((abs(outcome.difference) for outcome in good), default=0.0)
    return (
        f"{kind:18} good {verdicts['good']:3} bad {verdicts['bad']:3} refused {verdicts['refused']:3}"
        f"   good but wrong {wrong:3}   worst e {error:.4f} e-e* {difference:.4f}   check differs {differ:3}"
        f"   defect not named {unnamed:3}   {np.median([outcome.seconds for outcome in outcomes]):.0f} s"
    )


def main(folder, first, count, *kinds):
    """Run all kinds for each seed in turn; append outcomes to `outcomes.jsonl`."""
    outcomes = {kind: [] for kind in kinds or KINDS}
    for seed in range(int(first), int(first) + int(count)):
        for kind in outcomes:
            place = Path(folder) / f"{kind}_{seed}"
            shutil.rmtree(place, ignore_errors=True)
            outcome = evaluate_identification(kind, seed, place)
            outcomes[kind].append(outcome)
            with (Path(folder) / "outcomes.jsonl").open("a") as lines:
                lines.write(json.dumps(asdict(outcome)) + "\n")
            errors = f"{outcome.error:+.4f}, e - e* by {outcome.difference:+.4f}"
            print(f"{kind} {seed}: {outcome.verdict}, check {outcome.check}, e off by {errors}", flush=True)
            print(f"    {outcome.message} {outcome.trouble}", flush=True)
            for log in [*place.glob("*.csv"), *place.glob("*.parquet")]:
                log.unlink()
    for kind, results in outcomes.items():
        print(summary(kind, results))


if __name__ == "__main__":
    main(*sys.argv[1:])
