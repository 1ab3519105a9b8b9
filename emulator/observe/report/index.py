"""`runs/index.html`: all runs of a folder, the newest first, those that broke off and those that broke included."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from emulator.observe.checks.verdicts import Verdict
from emulator.observe.report.page import badge, escape, page, put_page
from emulator.observe.report.record import Record, read_record
from vnet.errors import VnetError
from vnet.toml_text import read_toml

INDEX = "index.html"


def write_index(folder: Path) -> Path:
    raise NotImplementedError
