"""Options of `jaxhil identify` and `jaxhil monitor`, read by tyro."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from tuning.api.options import Json, Timings, folder_option, number_option, text_option


@dataclass(frozen=True)
class IdentifyOptions:
    """Estimate a mechanism file with uncertainty from a rig's logs; check that the model explains the logs.

    Example: jaxhil identify day1/*.csv --map logs.toml --prior rig-300kg

    Writes DIR/mechanism.toml, which tune can read, DIR/identification.json and plots; with --check nothing.
    Exit code 1 if unexplained effects and the uncertainty of the estimates can change e or e - e* by the
    limit or more.
    """

    logs: Annotated[
        Positional[tuple[str, ...]],
        text_option(
            "LOG [LOG ...]",
            "Logs: text_option, Parquet; with jaxhil[logs] also MAT, HDF5, ROS 2 bags, MDF4, TDMS.",
        ),
    ] = ()
    map: Annotated[
        str | None,
        text_option(
            "FILE", "Meaning of the columns and kind of the runs (TOML); by default those of simulate --log."
        ),
    ] = None
    guess: Annotated[
        FlagCreatePairsOff[bool],
        text_option(None, "Only print a draft of --map, made from the names and contents of the columns."),
    ] = False
    design: Annotated[
        FlagCreatePairsOff[bool],
        text_option(None, "Write the rig commands that best identify a mechanism, given as --prior or LOGS."),
    ] = False
    stroke: Annotated[
        float, number_option("With --design: largest displacement of the rig in either direction [m].")
    ] = 0.002
    prior: Annotated[
        str | None,
        text_option(
            "MECHANISM", "Mechanism file, or a built-in's name, for values that the logs do not show."
        ),
    ] = None
    check: Annotated[
        FlagCreatePairsOff[bool],
        text_option(
            None, "Compare the logs with a mechanism, --prior or the last of LOGS; estimate nothing."
        ),
    ] = False
    bayes: Annotated[
        FlagCreatePairsOff[bool],
        text_option(None, "Use the normal entries of the prior's [uncertainty] as evidence, with the logs."),
    ] = False
    output: Annotated[str, folder_option("Folder for the results.")] = "jaxhil-out/identified"
    stage: Annotated[
        str | None,
        text_option("KIND", "Use only runs of this kind (free, press, contact or tap), and runs at rest."),
    ] = None
    order: Annotated[
        str, text_option("NUMBER", "Order of the motion simulator; by default 'auto', chosen from the logs.")
    ] = "auto"
    law: Annotated[str | None, text_option("NAME", "Contact law; by default chosen from the contacts.")] = (
        None
    )
    fix: Annotated[
        UseAppendAction[tuple[str, ...]],
        text_option(
            "KEY=VALUE",
            "Known value, a number_option or a list of numbers, such as rig.contact_plane=0; repeatable.",
        ),
    ] = ()
    hold_out: Annotated[
        float, number_option("Share of the contacts used to validate the fit to the others.")
    ] = 0.2
    bootstrap: Annotated[
        int,
        number_option(
            "Fits to resampled contacts; they widen intervals if contacts differ by more than noise."
        ),
    ] = 0
    limit: Annotated[
        float, arg(metavar="NUMBER", help="Restitution error from which the verdict is bad.")
    ] = 0.01
    scheduler: Annotated[
        str | None,
        text_option("ADDRESS", "With --bootstrap: a dask.distributed cluster whose workers run the fits."),
    ] = None
    resume: Annotated[
        FlagCreatePairsOff[bool],
        text_option(
            None, "With --bootstrap: continue after an interruption; finished fits are not repeated."
        ),
    ] = False
    seed: Annotated[int, number_option("Seed of the random draws for the intervals.")] = 0
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class MonitorOptions:
    """Check contact by contact that the rig still matches the identified mechanism; find when it changed.

    Example: jaxhil monitor identified/mechanism.toml day2/contact_*.csv --map logs.toml

    Good: nothing changed. Watch: a change within the file's [uncertainty]. Bad: a change beyond it; exit code
    1.
    """

    mechanism: Annotated[
        Positional[str],
        text_option("MECHANISM", "Mechanism file, such as identify writes, or a built-in's name."),
    ]
    logs: Annotated[
        Positional[tuple[str, ...]],
        text_option("LOG [LOG ...]", "Logs of contacts, in the order of their recording."),
    ] = ()
    map: Annotated[
        str | None,
        text_option(
            "FILE", "Meaning of the columns and kind of the runs (TOML); by default those of simulate --log."
        ),
    ] = None
    json: Json = False
    timings: Timings = False
