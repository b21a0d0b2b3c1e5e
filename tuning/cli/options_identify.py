"""Options of `jaxhil identify` and `jaxhil monitor`, read by tyro."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from tuning.front_door.options import Json, Timings, folder, number, text


@dataclass(frozen=True)
class Identify:
    """Estimate a mechanism file with uncertainty from a rig's logs; check that the model explains the logs.

    Example: jaxhil identify day1/*.csv --map logs.toml --prior rig-300kg

    Writes DIR/mechanism.toml, which tune can read, DIR/identification.json and plots; with --check nothing.
    Exit code 1 if unexplained effects and the uncertainty of the estimates can change e or e - e* by the
    limit or more.
    """

    logs: Annotated[
        Positional[tuple[str, ...]],
        text(
            "LOG [LOG ...]", "Logs: text, Parquet; with jaxhil[logs] also MAT, HDF5, ROS 2 bags, MDF4, TDMS."
        ),
    ] = ()
    map: Annotated[
        str | None,
        text(
            "FILE", "Meaning of the columns and kind of the runs (TOML); by default those of simulate --log."
        ),
    ] = None
    guess: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Only print a draft of --map, made from the names and contents of the columns."),
    ] = False
    design: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Write the rig commands that best identify a mechanism, given as --prior or LOGS."),
    ] = False
    stroke: Annotated[
        float, number("With --design: largest displacement of the rig in either direction [m].")
    ] = 0.002
    prior: Annotated[
        str | None,
        text("MECHANISM", "Mechanism file, or a built-in's name, for values that the logs do not show."),
    ] = None
    check: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Compare the logs with a mechanism, --prior or the last of LOGS; estimate nothing."),
    ] = False
    bayes: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Use the normal entries of the prior's [uncertainty] as evidence, with the logs."),
    ] = False
    output: Annotated[str, folder("Folder for the results.")] = "jaxhil-out/identified"
    stage: Annotated[
        str | None,
        text("KIND", "Use only runs of this kind (free, press, contact or tap), and runs at rest."),
    ] = None
    order: Annotated[
        str, text("NUMBER", "Order of the motion simulator; by default 'auto', chosen from the logs.")
    ] = "auto"
    law: Annotated[str | None, text("NAME", "Contact law; by default chosen from the contacts.")] = None
    fix: Annotated[
        UseAppendAction[tuple[str, ...]],
        text(
            "KEY=VALUE",
            "Known value, a number or a list of numbers, such as rig.contact_plane=0; repeatable.",
        ),
    ] = ()
    hold_out: Annotated[float, number("Share of the contacts used to validate the fit to the others.")] = 0.2
    bootstrap: Annotated[
        int, number("Fits to resampled contacts; they widen intervals if contacts differ by more than noise.")
    ] = 0
    limit: Annotated[
        float, arg(metavar="NUMBER", help="Restitution error from which the verdict is bad.")
    ] = 0.01
    scheduler: Annotated[
        str | None,
        text("ADDRESS", "With --bootstrap: a dask.distributed cluster whose workers run the fits."),
    ] = None
    resume: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "With --bootstrap: continue after an interruption; finished fits are not repeated."),
    ] = False
    seed: Annotated[int, number("Seed of the random draws for the intervals.")] = 0
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class Monitor:
    """Check contact by contact that the rig still matches the identified mechanism; find when it changed.

    Example: jaxhil monitor identified/mechanism.toml day2/contact_*.csv --map logs.toml

    Good: nothing changed. Watch: a change within the file's [uncertainty]. Bad: a change beyond it; exit code
    1.
    """

    mechanism: Annotated[
        Positional[str], text("MECHANISM", "Mechanism file, such as identify writes, or a built-in's name.")
    ]
    logs: Annotated[
        Positional[tuple[str, ...]],
        text("LOG [LOG ...]", "Logs of contacts, in the order of their recording."),
    ] = ()
    map: Annotated[
        str | None,
        text(
            "FILE", "Meaning of the columns and kind of the runs (TOML); by default those of simulate --log."
        ),
    ] = None
    json: Json = False
    timings: Timings = False
