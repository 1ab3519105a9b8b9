"""Sessions of pytester that keep what they have imported: modules in C, such as numpy's, cannot come twice."""

import sys

import pytest


@pytest.fixture(autouse=True)
def _modules_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    def forget_tests(snapshot: object) -> None:
        for name in [name for name in sys.modules if name.startswith(("test_", "conftest"))]:
            del sys.modules[name]

    monkeypatch.setattr("_pytest.pytester.SysModulesSnapshot.restore", forget_tests)
