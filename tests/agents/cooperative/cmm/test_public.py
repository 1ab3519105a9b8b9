"""`agents.cooperative.cmm` as a public API: its names, here and at their former place."""

import inspect

import pytest

from agents.cooperative import cmm
from tests.support.paths import ROOT


def test_the_public_names_are_there_and_say_what_they_are() -> None:
    assert sorted(cmm.__all__) == list(cmm.__all__) == sorted(cmm._PUBLIC)
    for name in cmm.__all__:
        assert inspect.getdoc(getattr(cmm, name)), name
        assert name in dir(cmm)
    with pytest.raises(AttributeError, match=r"module .* has no attribute 'Filter'"):
        cmm.Filter  # noqa: B018


def test_their_former_place_warns_and_has_the_same_names() -> None:
    from vnet import cmm as former

    for name in cmm.__all__:
        with pytest.warns(DeprecationWarning, match=name):
            assert getattr(former, name) is getattr(cmm, name)
    with pytest.raises(AttributeError, match="Filter"):
        former.Filter  # noqa: B018
    assert len((ROOT / "vnet" / "cmm.py").read_text().splitlines()) <= 20
