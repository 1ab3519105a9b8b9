"""Campaigns and sweeps in a list of runs: `campaign.json` and `sweep.parquet`, read as foreign files."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from pydantic import TypeAdapter, ValidationError

from emulator.records.run_tables import open_table
from emulator.records.verdicts import Verdict
from emulator.scenario.sections import first_problem
from vnet.bounded import read_bounded
from vnet.errors import VnetError, printable

CAMPAIGN_FILE, CAMPAIGN_PAGE = "campaign.json", "campaign.html"
SWEEP_TABLE, SWEEP_PAGE = "sweep.parquet", "sweep.html"
LARGEST_BYTES = 256 * 2**20


@dataclass(frozen=True)
class CampaignRecord:
    """The fields of campaign.json that a list of campaigns needs."""

    seed: int
    runs: int
    kinds: list[str]
    results: list[dict[str, Any]]
    drawn_from: str = ""
    """Digest of what decides which runs can be drawn; "" in campaigns of earlier versions."""

    @property
    def failed(self) -> int:
        """Number of runs that have failed."""
        return sum("failed" in result for result in self.results)


_RECORD = TypeAdapter(CampaignRecord)


def read_campaign(folder: Path) -> CampaignRecord:
    """Read the campaign.json of a folder. Raises VnetError where it is not what vnet writes."""
    path = folder / CAMPAIGN_FILE
    try:
        return _RECORD.validate_python(json.loads(read_bounded(path, LARGEST_BYTES)))
    except OSError as error:
        raise VnetError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValidationError as error:
        raise VnetError(f"{path}: {first_problem(error, _RECORD)}") from None
    except (ValueError, RecursionError) as error:
        raise VnetError(f"{path}: not JSON: {error}") from None


@dataclass(frozen=True)
class SweepRecord:
    """The contents of sweep.parquet that a list of sweeps needs."""

    varied: list[str]
    runs: int
    not_valid: int


def read_sweep(folder: Path) -> SweepRecord:
    """Read the sweep.parquet of a folder. Raises VnetError where it is not what vnet writes."""
    path = folder / SWEEP_TABLE
    try:
        file = open_table(path, ["verdict"])
        names = file.schema_arrow.names
        varied = names[: names.index("seed")]
        verdicts = file.read(["verdict"])["verdict"].to_pylist()
    except OSError as error:
        raise VnetError(f"{path}: cannot be read: {error.strerror or printable(str(error), 200)}") from None
    except (ValueError, KeyError, pa.ArrowException) as error:
        raise VnetError(f"{path}: not the table of a sweep: {printable(str(error), 200)}") from None
    return SweepRecord(varied, len(verdicts), sum(verdict != Verdict.VALID for verdict in verdicts))
