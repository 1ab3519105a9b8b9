"""Words of messages that several commands share."""

from vnet.errors import first_names


def test_a_long_list_of_names_is_cut_and_says_so() -> None:
    names = [f"v{number}" for number in range(12)]
    assert first_names(names[:2]) == "v0, v1"
    assert first_names(names[:8]) == "v0, v1, v2, v3, v4, v5, v6, v7"
    assert first_names(names) == "v0, v1, v2, v3, v4, v5, v6, v7, …"
    assert first_names(names, 2, with_total=True) == "v0, v1, … (12)"
    assert first_names(names[:2], 2, with_total=True) == "v0, v1"
    assert first_names([]) == ""
