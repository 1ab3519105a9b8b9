"""Units at the ends of names."""

import pytest

from vnet.units import title_of, unit_of


@pytest.mark.parametrize(
    ("name", "title", "unit"),
    [
        ("delay_ms", "delay", "ms"),
        ("warning_delay_s", "warning delay", "s"),
        ("speed_mps", "speed", "m/s"),
        ("speed_m_s", "speed", "m/s"),
        ("load_percent", "load", "%"),
        ("sent_bytes", "sent", "bytes"),
        ("bytes", "bytes", ""),
        ("m", "m", ""),
        ("_s", " s", ""),
        ("informed", "informed", ""),
        ("hops", "hops", ""),
        ("delay_ms.v_03", "delay.v_03", "ms"),
        ("queue_length.high_s", "queue length.high_s", ""),
        ("own:warned.delay_ms", "own:warned.delay", "ms"),
    ],
)
def test_a_name_is_words_and_a_unit(name: str, title: str, unit: str) -> None:
    assert (title_of(name), unit_of(name)) == (title, unit)
