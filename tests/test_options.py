"""Options defined once and used by the command line, the function and the range check."""

import dataclasses
import inspect
from dataclasses import dataclass
from typing import Annotated, Any

import pytest
import tyro

import tuning
from jaxhil.errors import InputError
from tuning.api.options import AllowedValues, add_options, check_options, number_option
from tuning.api.tune_options import TuneOptions
from tuning.cli.options import Compare, Sweep, Tune
from tuning.cli.options_report import Map
from tuning.cli.options_rig import Export, Shadow, Verify

COMMANDS = {
    tuning.tune: Tune,
    tuning.sweep: Sweep,
    tuning.compare: Compare,
    tuning.map: Map,
    tuning.export: Export,
    tuning.verify: Verify,
    tuning.shadow: Shadow,
}


@dataclass(frozen=True, kw_only=True)
class ToyOptions(TuneOptions):
    """Options with one additional option, which is defined only here."""

    toys: Annotated[int, number_option("Toys to play with."), AllowedValues(1, 3)] = 2


@add_options(ToyOptions)
def play(mechanism: Any, **options: Any) -> ToyOptions:
    """Play.

    Args:
        mechanism: a mechanism.
    OPTIONS
    """
    asked = ToyOptions(**options)
    check_options(asked)
    return asked


def test_option_defined_once_appears_in_command_function_and_range_check():
    assert tyro.cli(ToyOptions, args=["--toys", "3"]).toys == play("varying", toys=3).toys == 3
    assert inspect.signature(play).parameters["toys"].default == 2 == play("varying").toys
    assert "        toys: Toys to play with.\n" in str(play.__doc__)
    with pytest.raises(InputError, match=r"^toys: found 4, expected at most 3$"):
        play("varying", toys=4)
    with pytest.raises(InputError, match=r"^toys: found 0, expected an integer >= 1$"):
        play("varying", toys=0)
    with pytest.raises(InputError, match=r"^toys: found 1\.5, expected an integer >= 1$"):
        play("varying", toys=1.5)


@pytest.mark.parametrize("function", COMMANDS, ids=lambda function: function.__name__)
def test_functions_and_commands_have_the_same_options_and_defaults(function):
    command = {field.name: field for field in dataclasses.fields(COMMANDS[function])}
    parameters = inspect.signature(function).parameters
    # The command line reads these options differently: as files, or as words.
    read = {"formats", "limits", "gains"} | ({"compensator"} if function is tuning.map else set())
    shared = [name for name in parameters if name in command and name not in read]
    assert len(shared) >= 3
    for name in shared:
        assert parameters[name].default in (command[name].default, inspect.Parameter.empty)
        assert f"        {name}: " in function.__doc__
    assert "OPTIONS" not in function.__doc__


def test_unknown_option_of_function_is_rejected():
    with pytest.raises(TypeError, match="unexpected keyword argument 'scenario'"):
        tuning.tune("varying", scenario=3)
