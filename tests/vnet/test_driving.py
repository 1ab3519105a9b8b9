"""Actions that a program asks for: what is one, and what is refused in one line."""

from typing import Any

import numpy as np
import pytest

from vnet.node import Action, checked_action


@pytest.mark.parametrize("asked", [2, 2.0, np.float32(2), np.int64(2), np.array(2.0)])
def test_any_number_is_an_acceleration(asked: Any) -> None:
    assert checked_action("v01", True, asked, 0) == Action("v01", 2.0)


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ({"acceleration_m_s2": "3"}, r"drive\(acceleration_m_s2='3'\): a finite number within"),
        ({"acceleration_m_s2": True}, r"acceleration_m_s2=True\): a finite number"),
        ({"acceleration_m_s2": float("nan")}, r"acceleration_m_s2=nan\): a finite number"),
        ({"acceleration_m_s2": 10**400}, r"acceleration_m_s2=1000.*\): a finite number"),
        ({"acceleration_m_s2": [1, 2]}, r"acceleration_m_s2=\[1, 2\]\): a finite number"),
        ({"lane": 2}, r"drive\(lane=2\): allowed are -1"),
        ({"release": "no"}, r"drive\(release='no'\): True or False"),
        ({"acceleration_m_s2": 1.0, "release": True}, "takes no acceleration_m_s2"),
        ({}, r"drive\(\): give acceleration_m_s2, lane or both"),
    ],
)
def test_what_is_no_action_is_one_line(asked: dict[str, Any], line: str) -> None:
    with pytest.raises(ValueError, match=line) as said:
        checked_action("v01", True, **{"acceleration_m_s2": None, "lane": 0, **asked})
    assert "\n" not in str(said.value)


def test_where_nobody_drives_it_is_refused() -> None:
    with pytest.raises(ValueError, match=r"programs drive only with"):
        checked_action("v01", False, 1.0, 0)
