"""Corrupted gain files with a valid digest, so that only their content can reveal the corruption."""

import copy
import json
import math
import random
from typing import Any

from gain_documents import GAINS, gain_document
from guarded import LIMITED

from jaxhil.rig import COMPENSATORS, digest
from jaxhil.rig.bounds import CONTROL_PERIODS, DISTANCES
from jaxhil.rig.limits import LIMITS

EXTREMES = (
    *(0.0, -0.0, 5e-324, -5e-324, 1e-310, 2.3e-308, 1e-12, 1e-6, 1e-5, 0.1, 0.5, 1.0, -1.0, 2.0, 50.0),
    *(1e3, 1e6, 1e9, -1e9, 1e16, -1e160, 1e300, 1e308, -1e308, 1.7976931348623157e308, 0, 1, -1, 2, 10**6),
    *(2**63, -(2**63), 10**30, 10**400, -(10**400)),
)
GARBAGE = (
    *(None, True, False, "", "0.5", "NaN", "1e9", "\ud800", "s", "N", "none", "phase_lead", [], {}, [1.0]),
    *({"value": 1.0}, {"value": 1.0, "unit": "1", "lower": 0.0, "upper": 2.0}, [[[[]]]], {"": {"": {}}}),
    *(math.nan, math.inf, -math.inf),
)
KEYS = ("value", "unit", "lower", "upper", "gains", "limits", "sha256", "", "\u00e9", "clearance", "others")
PERIODS = (1e-3, 1e-3, 2.5e-4, 1e-5, 0.1)


def numbers_changed(rng: random.Random) -> dict[str, Any]:
    """Draw a document with changed numbers; bounds in the file are adapted to the changed values."""
    document = _whole(rng)
    for _ in range(rng.randrange(1, 4)):
        kind = rng.choice(("gain", "gain", "gain", "limit", "limit", "period", "clearance"))
        if kind == "gain" and document["gains"]:
            name = rng.choice(list(document["gains"]))
            one = COMPENSATORS[document["compensator"]].gains[name]
            value = any_number(rng, document["gains"][name]["value"], one.lowest, one.highest)
            document["gains"][name] |= {"value": value, "lower": value, "upper": value}
        elif kind == "limit" and document.get("limits"):
            name = rng.choice(list(document["limits"]))
            one = LIMITS[name]
            value = any_number(rng, document["limits"][name]["value"] or 1.0, one.lowest, one.highest)
            document["limits"][name]["value"] = rng.choice((None, value, value, value))
        elif kind == "period":
            value = any_number(rng, 1e-3, *CONTROL_PERIODS)
            document["control_period"] = document["mechanism"]["rig"]["control_period"] = value
        elif kind == "clearance":
            document["mechanism"]["contact"]["clearance"] = any_number(rng, 1e-3, *DISTANCES)
    return document


def anything_changed(rng: random.Random) -> dict[str, Any]:
    """Draw a document with entries replaced, removed, renamed or added."""
    document = numbers_changed(rng) if rng.random() < 0.3 else _whole(rng)
    for _ in range(rng.randrange(1, 4)):
        places = list(_places(document))
        holder, key = rng.choice(places)
        # In half of the cases, change a number that the controller uses.
        if rng.random() < 0.5:
            holder, key = rng.choice([(h, k) for h, k in places if isinstance(h[k], (int, float))] or places)
        change = rng.randrange(6)
        if change == 0:
            del holder[key]
        elif change == 1 and isinstance(holder, dict):
            holder[rng.choice((*KEYS, *LIMITS, "phase_lead"))] = holder.pop(key)
        elif change == 2 and isinstance(holder, dict):
            holder[rng.choice((*KEYS, *LIMITS))] = copy.deepcopy(rng.choice(GARBAGE))
        elif change == 3:
            holder[key] = copy.deepcopy(rng.choice(places)[0])
        else:
            holder[key] = copy.deepcopy(rng.choice((*GARBAGE, *EXTREMES, *COMPENSATORS)))
    return document


def text_of(document: dict[str, Any], rng: random.Random) -> str:
    """Return the text of the file, signed if JSON allows; sometimes with a duplicate key or deep nesting."""
    try:
        document["sha256"] = digest(document)
    except (ValueError, TypeError, RecursionError):
        pass
    text = json.dumps(document)
    if rng.random() < 0.02:
        place = rng.choice([n for n, character in enumerate(text) if character == "{"]) + 1
        text = f'{text[:place]}"value": 1e9, "value": 1e9, {text[place:]}'
    if rng.random() < 0.02:
        depth = rng.choice((20, 31, 40, 3000, 100_000))
        text = text.replace('"timings": {', '"timings": {"deep": ' + "[" * depth + "]" * depth + ", ", 1)
    return text


def any_number(rng: random.Random, usual: float, lowest: float, highest: float) -> float:
    """Draw a number: of any size, near the usual value, or near an end of the admitted range."""
    kind = rng.randrange(5)
    if kind == 0:
        return rng.choice(EXTREMES)
    if kind == 1:
        return rng.choice((1.0, -1.0)) * 10 ** rng.uniform(-320.0, 308.0)
    if kind == 2:
        end = rng.choice((lowest, highest))
        return rng.choice((end, math.nextafter(end, math.inf), math.nextafter(end, -math.inf), 2.0 * end))
    if kind == 3:
        return rng.uniform(lowest, highest)
    return (usual if abs(usual) < 1e300 else 1.0) * 10 ** rng.uniform(-3.0, 3.0)


_BASES: dict[tuple, str] = {}


def _whole(rng: random.Random) -> dict[str, Any]:
    """Draw a valid document of any compensator."""
    law, period = rng.choice(sorted(GAINS)), rng.choice(PERIODS)
    clearance = rng.choice((None, None, 0.0, 0.002))
    kind = law, period, clearance
    if kind not in _BASES:
        _BASES[kind] = json.dumps(gain_document(law, control_period=period, clearance=clearance))
    document = json.loads(_BASES[kind])
    limits = rng.choice((None, {}, LIMITED, LIMITED, dict.fromkeys(LIMITS)))
    if limits is not None:
        document["limits"] = {
            name: {"value": value, "unit": LIMITS[name].unit} for name, value in limits.items()
        }
    return document


def _places(node: Any):
    entries = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
    for key in entries:
        yield node, key
        yield from _places(node[key])
