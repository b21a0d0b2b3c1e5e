"""Options of `jaxhil identify` and `jaxhil monitor`, read by tyro."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from tuning.api.options import Json, Timings, folder_option, number_option, text_option

ColumnMap = Annotated[
    str | None,
    text_option(
        "FILE",
        "TOML file with the meaning of the columns and the kind of each run; by default the columns are "
        "those of jaxhil simulate --log.",
    ),
]


@dataclass(frozen=True)
class IdentifyOptions:
    """Estimate a mechanism file, with uncertainty, from a rig's logs; check that the model explains the logs.

    Example: jaxhil identify day1/*.csv --map logs.toml --prior rig-300kg

    Writes DIR/mechanism.toml (input for jaxhil tune), DIR/identification.json and plots; with --check, writes
    nothing. The exit code is 1 if unexplained effects and the uncertainty of the estimates can change e or
    e - e* by the limit or more.
    """

    logs: Annotated[
        Positional[tuple[str, ...]],
        text_option(
            "LOG [LOG ...]",
            "Log files: text, Parquet; with jaxhil[logs] also MAT, HDF5, ROS 2 bags, MDF4, TDMS.",
        ),
    ] = ()
    map: ColumnMap = None
    guess: Annotated[
        FlagCreatePairsOff[bool],
        text_option(
            None,
            "Only print a draft of the mapping file, from the names and values of the columns. With --map, "
            "the draft uses the table [text] of that file.",
        ),
    ] = False
    design: Annotated[
        FlagCreatePairsOff[bool],
        text_option(
            None, "Only write the rig commands that best identify the mechanism given as --prior or LOG."
        ),
    ] = False
    stroke: Annotated[
        float, number_option("With --design: largest displacement of the rig in either direction [m].")
    ] = 0.002
    prior: Annotated[
        str | None,
        text_option(
            "MECHANISM",
            "Mechanism file, or name of a built-in mechanism: values for what the logs do not determine.",
        ),
    ] = None
    check: Annotated[
        FlagCreatePairsOff[bool],
        text_option(
            None, "Only compare the logs with the mechanism given as --prior or last LOG; estimate nothing."
        ),
    ] = False
    bayes: Annotated[
        FlagCreatePairsOff[bool],
        text_option(
            None, "Combine the logs with the normal distributions in the prior's [uncertainty] (Bayesian)."
        ),
    ] = False
    output: Annotated[str, folder_option("Folder for the results.")] = "jaxhil-out/identified"
    stage: Annotated[
        str | None,
        text_option("KIND", "Use only runs at rest and runs of this kind: free, press, contact or tap."),
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
            "Fix a key at a number or a list of numbers, such as rig.contact_plane=0; repeatable.",
        ),
    ] = ()
    hold_out: Annotated[
        float, number_option("Share of the contacts that are not fitted, but used to validate the fit.")
    ] = 0.2
    bootstrap: Annotated[
        int,
        number_option(
            "Number of bootstrap fits; they widen the intervals if contacts differ by more than the noise."
        ),
    ] = 0
    limit: Annotated[
        float, arg(metavar="NUMBER", help="Smallest effect on e or e - e* for which the verdict is bad.")
    ] = 0.01
    scheduler: Annotated[
        str | None,
        text_option(
            "ADDRESS",
            "With --bootstrap: scheduler of a dask.distributed cluster whose workers compute the fits.",
        ),
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
    """Check for every contact that the rig still matches the identified mechanism; locate a change.

    Example: jaxhil monitor identified/mechanism.toml day2/contact_*.csv --map logs.toml

    The state is "good" if nothing changed, "watch" if a change is within the file's [uncertainty], and "bad"
    if a change exceeds it. The exit code is 1 if the state is "bad".
    """

    mechanism: Annotated[
        Positional[str],
        text_option(
            "MECHANISM", "Mechanism file, for example from jaxhil identify, or name of a built-in mechanism."
        ),
    ]
    logs: Annotated[
        Positional[tuple[str, ...]],
        text_option("LOG [LOG ...]", "Logs of contacts, in the order of their recording."),
    ] = ()
    map: ColumnMap = None
    json: Json = False
    timings: Timings = False
