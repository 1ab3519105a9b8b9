"""Coverage-guided fuzzing: `python -m tests.fuzz --runs 1000000`, with atheris from the extra `fuzz`.

Each target runs in a process of its own, with bounds on the time of an input, on memory and on the whole. A line a
target says how many inputs it was given and how many edges they covered; an input that does harm is kept, and the
exit status is 1.
"""

import argparse
import re
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

LONGEST_INPUT_BYTES = 8192
LONGEST_INPUT_S = 10
MEMORY_BYTES = 2**30
"""Address space beyond what a target takes when nothing has been read yet: a claim of 2 GB does not fit."""


@dataclass(frozen=True)
class Result:
    """The result of one target."""

    inputs: int
    covered: int
    crashes: int


def fuzz(name: str, runs: int, seconds: int, folder: Path) -> None:
    """Fuzz one target in this process; libFuzzer ends the process."""
    import atheris

    with atheris.instrument_imports(include=["vnet", "agents", "emulator", "tomllib", "csv"]):
        from tests.fuzz.adversarial_inputs import NASTIES
        from tests.fuzz.targets import TARGETS
    target = next(target for target in TARGETS if target.name == name)
    corpus = folder / "corpus"
    corpus.mkdir()
    small = [nasty for nasty in NASTIES.values() if len(nasty) <= LONGEST_INPUT_BYTES]
    for number, seed in enumerate([*target.seeds, *small]):
        (corpus / str(number)).write_bytes(seed)
    _bound_memory()
    options = {
        "runs": runs,
        "max_total_time": seconds,
        "max_len": LONGEST_INPUT_BYTES,
        "timeout": LONGEST_INPUT_S,
        "seed": 1,
        "artifact_prefix": f"{folder}/",
        "print_final_stats": 1,
    }
    if target.words:
        quoted = ("".join(f"\\x{byte:02x}" for byte in word) for word in target.words)
        (folder / "words").write_text("".join(f'"{word}"\n' for word in quoted))
        options["dict"] = folder / "words"

    def one_input(data: bytes) -> None:
        target.try_out(data)

    atheris.Setup([name, *(f"-{key}={value}" for key, value in options.items()), str(corpus)], one_input)
    atheris.Fuzz()


def _bound_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def fuzz_in_process(name: str, runs: int, seconds: int, kept: Path) -> Result:
    """Fuzz one target in a process of its own; inputs that do harm are moved to `kept`."""
    from tests.fuzz.seeds import temporary_folder

    with temporary_folder() as text:
        folder = Path(text)
        command = [sys.executable, "-m", "tests.fuzz", "--only", name, "--folder", text]
        command += ["--runs", str(runs), "--seconds", str(seconds)]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=seconds + 300)
        said = done.stderr.decode(errors="replace")
        crashes = [path for path in folder.iterdir() if re.match(r"(crash|timeout|oom|leak)-", path.name)]
        for path in crashes:
            kept.mkdir(exist_ok=True)
            (kept / f"{name.replace(' ', '-')}-{path.name}").write_bytes(path.read_bytes())
    inputs = [int(number) for number in re.findall(r"(?:^#|executed_units:\s*)(\d+)", said, re.MULTILINE)]
    covered = [int(number) for number in re.findall(r"cov: (\d+)", said)]
    if done.returncode != 0 or crashes:
        print(said[-3000:], file=sys.stderr)
    failed = max(len(crashes), int(done.returncode != 0))
    return Result(max(inputs, default=0), max(covered, default=0), failed)


def target_names() -> list[str]:
    """All targets; not imported at the top, where atheris could no longer instrument what they import."""
    from tests.fuzz.targets import TARGETS

    return [target.name for target in TARGETS]


def main() -> None:
    """Share the runs among the targets; what a slow one leaves undone is done by those after it."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--runs", type=int, default=1_000_000, help="inputs for all targets together")
    parser.add_argument("--seconds", type=int, default=900, help="wall clock for all targets together")
    parser.add_argument("--only", help="one target by name")
    parser.add_argument("--kept", type=Path, default=Path("fuzz-crashes"), help="folder for inputs that do harm")
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)  # set: this is the process of one target
    options = parser.parse_args()
    if options.folder is not None:
        fuzz(options.only, options.runs, options.seconds, options.folder)
        return
    names = [name for name in target_names() if options.only in (None, name)]
    total = crashes = 0
    deadline = time.monotonic() + options.seconds
    for left, name in zip(range(len(names), 0, -1), names, strict=True):
        start = time.monotonic()
        seconds = max(1, round((deadline - start) / left))
        result = fuzz_in_process(name, (options.runs - total) // left, seconds, options.kept)
        total += result.inputs
        crashes += result.crashes
        print(
            f"{name:18} {result.inputs:9,} inputs  {result.covered:5} covered  {result.crashes} crashes  "
            f"{time.monotonic() - start:5.0f} s",
            flush=True,
        )
    print(f"{'all':18} {total:9,} inputs                 {crashes} crashes")
    sys.exit(1 if crashes or total < options.runs else 0)


if __name__ == "__main__":
    main()
