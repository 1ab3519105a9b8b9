"""`vnet.cmm` as a public API: its names, and that none of them needs an emulator."""

import inspect
import subprocess
import sys

import pytest

import vnet.cmm
from tests.support.paths import ROOT


def test_the_public_names_are_there_and_say_what_they_are() -> None:
    assert sorted(vnet.cmm.__all__) == list(vnet.cmm.__all__) == sorted(vnet.cmm._PUBLIC)
    for name in vnet.cmm.__all__:
        assert inspect.getdoc(getattr(vnet.cmm, name)), name
        assert name in dir(vnet.cmm)
    with pytest.raises(AttributeError, match=r"module 'vnet\.cmm' has no attribute 'Filter'"):
        vnet.cmm.Filter  # noqa: B018


def test_the_estimators_need_neither_emulator_nor_transport() -> None:
    code = (
        "import sys; from vnet.cmm import *\n"
        "print(sorted({m.split('.')[0] for m in sys.modules} & {'emulator', 'zenoh', 'agents', 'msgpack'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
