"""The table of large runs: rows that are measured replace their own line, and no other."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest

from benchmarks import scale


@pytest.mark.slow
def test_a_row_that_is_measured_replaces_its_line_and_no_other(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    measured = {name: replace(row, measure=lambda runs: f"{runs} m") for name, row in scale.ROWS.items()}
    measured["ns3"] = scale.Row("engine", "12", "20", lambda runs: str(1 // 0))
    monkeypatch.setattr(scale, "ROWS", measured)
    page = f"head\n{scale.BEGIN}\n{scale.END}\ntail\n"
    first = scale.updated(page, {"start": scale.line("start", "1 s", "here")})
    again = scale.updated(first, {"memory": scale.line("memory", "2 MB", "there")})
    assert again.startswith("head\n") and again.endswith("\ntail\n")
    assert again.count("not measured") == len(scale.ROWS) - 2
    assert "| 1 s | here |" in again and "| 2 MB | there |" in again
    scale.main(["--only", "ns3", "start", "--runs", "7"])
    failed, fine = capsys.readouterr().out.splitlines()
    assert "| failed: ZeroDivisionError: integer division or modulo by zero |" in failed
    assert fine.startswith(f"| {scale.ROWS['start'].what} (`start`) |") and "| 7 m |" in fine


def test_the_page_has_a_line_for_each_row() -> None:
    page = scale.PAGE.read_text()
    assert [name for name in scale.ROWS if page.count(f"(`{name}`) |") != 1] == []


@pytest.mark.slow
def test_memory_is_that_of_the_children() -> None:
    child = subprocess.Popen([sys.executable, "-c", "print('ready', flush=True); input()"], stdin=-1, stdout=-1)
    assert child.stdin is not None and child.stdout is not None
    child.stdout.readline()
    sizes = scale.agents_mb(os.getpid())
    child.communicate()
    assert sizes and all(0 < uss_mb <= pss_mb < 4096 for uss_mb, pss_mb in sizes)
