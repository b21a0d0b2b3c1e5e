"""The options of `jaxhil identify` and `jaxhil monitor`, as tyro reads them."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from tuning.front_door.options import Json, Timings, folder, number, text


@dataclass(frozen=True)
class Identify:
    """From a rig's logs to a mechanism file with uncertainty, and whether the model explains the rig.

    Example: jaxhil identify day1/*.csv --map logs.toml --prior rig-300kg

    Writes DIR/mechanism.toml, which tunes as it is, DIR/identification.json and pictures; with --check none.
    Exit code 1 if what the model leaves unexplained and the numbers' uncertainty can change e or e - e* by
    the limit or more.
    """

    logs: Annotated[
        Positional[tuple[str, ...]],
        text(
            "LOG [LOG ...]", "Logs: text, Parquet; with jaxhil[logs] also MAT, HDF5, ROS 2 bags, MDF4, TDMS."
        ),
    ] = ()
    map: Annotated[
        str | None,
        text("FILE", "What the columns mean and what was done (TOML); by default those of simulate --log."),
    ] = None
    guess: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Print a draft of --map, from the names of columns and what is in them; nothing else."),
    ] = False
    design: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Write commands for a rig that tell the numbers of a mechanism, --prior or LOGS, best."),
    ] = False
    stroke: Annotated[float, number("With --design: how far the rig may go to either side [m].")] = 0.002
    prior: Annotated[
        str | None, text("MECHANISM", "Mechanism file, or a built-in's name, for what the logs do not tell.")
    ] = None
    check: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Set the logs against a mechanism as it is, --prior or the last of LOGS; find nothing."),
    ] = False
    bayes: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Take the normal entries of the prior's [uncertainty] as evidence beside the logs."),
    ] = False
    output: Annotated[str, folder("Folder for what is written.")] = "jaxhil-out/identified"
    stage: Annotated[
        str | None,
        text("KIND", "Take runs of this kind alone (free, press, contact or tap), and those at rest."),
    ] = None
    order: Annotated[
        str, text("NUMBER", "Order of the motion simulator; by default 'auto': the logs choose.")
    ] = "auto"
    law: Annotated[str | None, text("NAME", "Contact law; by default the contacts choose.")] = None
    fix: Annotated[
        UseAppendAction[tuple[str, ...]],
        text("KEY=VALUE", "A number, or a list of them, that is known, as rig.contact_plane=0; repeatable."),
    ] = ()
    hold_out: Annotated[float, number("Share of the contacts that judge the fit to the others.")] = 0.2
    bootstrap: Annotated[
        int, number("Fits to contacts drawn again; intervals widen where contacts differ by more than noise.")
    ] = 0
    limit: Annotated[
        float, arg(metavar="NUMBER", help="Restitution error from which the verdict is bad.")
    ] = 0.01
    scheduler: Annotated[
        str | None, text("ADDRESS", "With --bootstrap: a dask.distributed cluster whose workers do its fits.")
    ] = None
    resume: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "With --bootstrap: go on after an interruption; what is finished is not done again."),
    ] = False
    seed: Annotated[int, number("Seed of the draws behind intervals.")] = 0
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class Monitor:
    """Whether the rig still is the one that was identified: contact by contact, and since when it is not.

    Example: jaxhil monitor identified/mechanism.toml day2/contact_*.csv --map logs.toml

    Good: nothing changed. Watch: something did, within what the file's [uncertainty] covers. Bad: beyond
    that; exit code 1.
    """

    mechanism: Annotated[
        Positional[str], text("MECHANISM", "Mechanism file, as identify writes it, or a built-in's name.")
    ]
    logs: Annotated[
        Positional[tuple[str, ...]], text("LOG [LOG ...]", "Logs of contacts, in the order they were made.")
    ] = ()
    map: Annotated[
        str | None,
        text("FILE", "What the columns mean and what was done (TOML); by default those of simulate --log."),
    ] = None
    json: Json = False
    timings: Timings = False
