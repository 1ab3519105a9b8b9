"""Overrides of a scenario: which of them a message names."""

from pathlib import PurePath

from emulator.scenario.loading import wrong_value
from vnet.errors import OverrideError


def test_of_several_overrides_of_a_section_none_is_blamed_for_what_all_make() -> None:
    problem, path = "run: tape goes with order", PurePath("s.toml")
    both = ["run.order=shuffle", "run.tape=t"]
    assert str(wrong_value(path, problem, both)) == f"s.toml: {problem}"
    assert isinstance(wrong_value(path, problem, both[1:]), OverrideError)
    assert isinstance(wrong_value(path, "run.tape = 3: a path", both), OverrideError)
    of_one = wrong_value(
        path, "radio.mac: reservation_ms = 150: 100 or 200", ["radio.mac.kind=a", "radio.mac.reservation_ms=150"]
    )
    assert isinstance(of_one, OverrideError) and of_one.key == "radio.mac.reservation_ms"
    of_list = wrong_value(path, "radio.mac: bler.2 = 5: less", ["radio.mac.kind=a", "radio.mac.bler=[1, 5]"])
    assert isinstance(of_list, OverrideError) and of_list.key == "radio.mac.bler"
