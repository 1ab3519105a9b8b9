"""Programs that do what asyncio offers give one trace, however their vehicles are divided into processes."""

import pytest

from tests.hunt.layouts import LIVE, differences


@pytest.mark.slow
def test_random_programs_give_one_trace_in_simulated_layouts() -> None:
    assert [*differences([2, 4])] == []


@pytest.mark.slow
def test_a_random_program_gives_one_trace_in_all_layouts_of_one_machine() -> None:
    assert [*differences([3], {name: options for name, options in LIVE.items() if "hosts" not in name})] == []
