"""Drafted mapping files: logs with any column names are read with the mapping drafted from them."""

import numpy as np
import pytest
from log_cases import sway, touches, write_csv

from jaxhil.errors import InputError
from tuning.identification.logs.campaign import read_campaign
from tuning.identification.logs.mapping import load_mapping
from tuning.identification.logs.mapping_draft import draft_mapping

LOG = touches(1)
NAMES = [
    ("t", "xd", "xm", "F"),
    ("Time [ms]", "Position command [mm]", "Position [mm]", "Force [N]"),
    ("stamp_us", "x_cmd", "x_meas", "Fz_kN"),
    ("clock (s)", "setpoint (um)", "LVDT (um)", "load cell (lbf)"),
]
FACTORS = [(1, 1, 1, 1), (1e3, 1e3, 1e3, 1), (1e6, -1e3, 1e3, -1e-3), (1, -1e6, -1e6, 1 / 4.4482216152605)]


@pytest.mark.parametrize(("names", "factors"), list(zip(NAMES, FACTORS, strict=True)))
def test_logs_are_read_with_the_mapping_file_drafted_from_them(tmp_path, names, factors):
    columns = [LOG[name] * factor for name, factor in zip(("t", "xd", "xm", "F"), factors, strict=True)]
    day = write_csv(tmp_path / "contact_1.csv", dict(zip(names, columns, strict=True)))
    free = sway() | {"F": 0.3 * np.random.default_rng(0).standard_normal(800)}
    columns = [free[name] * factor for name, factor in zip(("t", "xd", "xm", "F"), factors, strict=True)]
    other = write_csv(tmp_path / "morning.csv", dict(zip(names, columns, strict=True)))
    text = draft_mapping([day, other])
    (tmp_path / "map.toml").write_text(text.replace("# [bodies]", "[bodies]").replace("# equ", "equ"))
    result = read_campaign([day, other], load_mapping(tmp_path / "map.toml"))
    assert [run.kind for run in result.runs] == ["contact", "free"]
    np.testing.assert_allclose(result.runs[0].position_desired, LOG["xd"], atol=1e-15)
    np.testing.assert_allclose(result.runs[0].position_measured, LOG["xm"], atol=1e-15)
    np.testing.assert_allclose(result.runs[0].force_measured, LOG["F"], atol=1e-12)
    assert result.timing.control_period == 1e-3
    assert 'files = "contact*.csv"' in text and 'files = ["morning.csv"]' in text


def test_drafted_mapping_recognises_columns_of_jaxhil_and_lists_unknown_columns(tmp_path):
    names = (
        "time",
        "force_measured",
        "force_command",
        "position_desired",
        "velocity_desired",
        "position_measured",
    )
    columns = (LOG["t"], LOG["F"], LOG["Fc"], LOG["xd"], LOG["vd"], LOG["xm"], np.zeros(600))
    path = write_csv(tmp_path / "run.csv", dict(zip((*names, "contact"), columns, strict=True)))
    text = draft_mapping([path])
    for name in names:
        assert f'{name} = {{ column = "{name}"' in text
    assert 'contact_index = { column = "contact" }' in text
    path = write_csv(tmp_path / "a.csv", {"a": LOG["t"], "b": LOG["xd"]})
    assert '# position_measured = { column = "" }  # which of: "b"' in draft_mapping([path])
    with pytest.raises(InputError, match="logs: found none"):
        draft_mapping([])
