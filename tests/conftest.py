"""What holds for all tests, wherever they are started from."""

import signal

import pytest


@pytest.fixture(autouse=True)
def signals_are_heard() -> None:
    """No test begins deaf to Ctrl-C or SIGTERM, which all that it starts would be, too.

    A shell that runs tests in the background, as CI may, ignores Ctrl-C for them; and a live run in this process
    ends with both ignored, so that a second Ctrl-C does not lose its records.
    """
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, usual)
