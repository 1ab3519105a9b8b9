"""The table of outcomes is all that vnet knows about them."""

from emulator.pages.palette import PALETTE
from emulator.radio.outcomes import DRAWN, Outcome, Stage, decided_at


def test_numbers_names_and_stages() -> None:
    assert [outcome.value for outcome in Outcome] == list(range(len(Outcome))), "they index tables"
    assert Outcome(7) is Outcome.fault and Outcome.fault.title == "fault" and Outcome.peer_cap.title == "peer cap"
    assert set(Outcome) - set(DRAWN) == {Outcome.pending, Outcome.out_of_range}
    assert DRAWN[0] is Outcome.delivered
    staged = {outcome for outcome in Outcome if outcome.stage is not None}
    assert staged == {*DRAWN}
    assert decided_at(Stage.SENDER) == ("queue_full", "oversize", "held_back", "no_grant")
    assert decided_at(Stage.ARRIVAL) == ("delivered", "receiver_down", "transport")


def test_outcomes_are_told_apart_by_colour_and_by_sign() -> None:
    colours = [PALETTE[outcome.colour] for outcome in DRAWN]
    for shade in ("light", "dark", "either"):
        assert len({getattr(colour, shade) for colour in colours}) == len(DRAWN)
    assert len({outcome.sign for outcome in DRAWN}) == len(DRAWN)
