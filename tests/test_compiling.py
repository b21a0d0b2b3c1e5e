"""Everyday modules compile quickly; that others do not is a test of `test_programs.py`."""

import pytest
from compiling import QUICK, overridden


@pytest.mark.skipif("'not slow' not in config.option.markexpr", reason="of the everyday suite alone")
def test_everyday_modules_compile_quickly():
    assert overridden() == QUICK
