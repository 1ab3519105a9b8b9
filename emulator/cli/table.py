"""The commands of `vnet`: where each one is, and what is known of it without importing it.

Nothing heavy is imported here: `vnet --help` and a command that starts itself again need this table, and no more.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

REGISTRY = "vnet.commands"
"""Group of the entry points by which another distribution brings a command of the table."""


class Panel(StrEnum):
    """The headings under which `vnet --help` lists the commands, in this order."""

    RUN = "Run"
    LOOK = "Look"
    BREAK = "Break"
    STUDY = "Study"
    FILES = "Files"


@dataclass(frozen=True)
class Command:
    """A command or a group of commands.

    `module` is a module of `emulator.cli`, and `attribute` the function or the group in it; both are empty for a
    command from elsewhere.
    """

    name: str
    panel: Panel
    module: str
    attribute: str
    summary: str
    """One line of `vnet --help` at 80 columns; the command's own docstring says more."""
    runs_programs: bool = False
    """It runs programs in this process, which therefore needs a fixed hash seed."""
    elsewhere: str = ""
    """Set for a command that another distribution registers in `REGISTRY`: the line for a user who lacks it."""

    @property
    def needed_mb(self) -> int:
        """Address space in MB that it needs at least: libraries and their threads, most of it never touched."""
        return 3000 if self.name in ("run", "emulator", "demo", "host") else 1100


COMMANDS = (
    Command("run", Panel.RUN, "runs", "run", "Run a scenario, with a process for each vehicle."),
    Command(
        "simulate",
        Panel.RUN,
        "runs",
        "simulate",
        "Run it in one process: the same trace, faster.",
        runs_programs=True,
    ),
    Command("demo", Panel.RUN, "runs", "demo", "Run the shipped scenario quickstart, and record it."),
    Command("new", Panel.RUN, "new", "new", "Write a scenario, a program, a check and a test to begin with."),
    Command(
        "emulator", Panel.RUN, "runs", "emulator", "Run it for agents that are started by hand, here or elsewhere."
    ),
    Command("host", Panel.RUN, "host", "host", "Start the vehicles of one of several hosts (experimental)."),
    Command("access", Panel.RUN, "access", "access", "Write the users and rules of a separate router (zenohd)."),
    Command("status", Panel.LOOK, "fault", "status", "Show how a run that is on is getting on."),
    Command("check", Panel.LOOK, "folders", "check", "Judge a finished run again."),
    Command("report", Panel.LOOK, "folders", "report", "Write a run's report, or a list of runs, as a page."),
    Command("compare", Panel.LOOK, "folders", "compare", "Set two runs side by side, and show where they part."),
    Command(
        "radio", Panel.LOOK, "export", "radio", "Show delivery by distance, latency, age, and the worst links."
    ),
    Command("trace", Panel.LOOK, "folders", "trace", "Show who sent what to whom, and what became of it."),
    Command("view", Panel.LOOK, "viewing", "view", "Open a run's recording in Rerun, or serve it."),
    Command("fault", Panel.BREAK, "fault", "app", "Inject faults into a run that is on, and heal them."),
    Command(
        "campaign",
        Panel.BREAK,
        "studies",
        "campaign",
        "Run it many times under random faults, and shrink failures.",
        runs_programs=True,
    ),
    Command(
        "sweep",
        Panel.STUDY,
        "studies",
        "sweep",
        "Run it over values of its keys and over seeds: a table.",
        runs_programs=True,
    ),
    Command("analyze", Panel.STUDY, "studies", "analyze", "Analyze a network's graph without a run."),
    Command(
        "experiment",
        Panel.STUDY,
        "",
        "",
        "Run the paper's experiments, in a clone of vnet.",
        runs_programs=True,
        elsewhere="the studies are not in the package but in a clone of vnet: `pip install -e ./studies` there",
    ),
    Command(
        "export", Panel.FILES, "export", "export", "Write a run for Wireshark (pcapng), Foxglove (mcap), or as CSV."
    ),
    Command(
        "record", Panel.FILES, "viewing", "record", "Watch a run from outside, and write a Rerun recording of it."
    ),
    Command("render", Panel.FILES, "viewing", "render", "Write a finished run's recording again from its files."),
    Command("docs", Panel.FILES, "new", "docs", "Read the documentation: list its pages, or print one."),
    Command("map", Panel.FILES, "map", "app", "Look at maps, and convert them."),
)


def find(arguments: list[str]) -> Command | None:
    """Return the command that a command line names; None where it names none, or one that does not exist."""
    name = next((argument for argument in arguments if not argument.startswith("-")), None)
    return next((command for command in COMMANDS if command.name == name), None)
