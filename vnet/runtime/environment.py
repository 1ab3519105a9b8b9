"""The environment of a process that runs programs, so that they compute the same in every process and every run.

Each entry point sets it for its own process, and whoever starts a process sets it there; importing a package of
vnet changes nothing. This module imports nothing heavy: BLAS reads its variables when numpy is imported.
"""

from __future__ import annotations

import os
import sys

from vnet.runtime import interrupts
from vnet.runtime.own_packages import foreign_on_path

ONE_BLAS_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""One thread of linear algebra: more would not be faster here, and less reproducible."""

KEPT_MEMORY = {
    "MALLOC_TRIM_THRESHOLD_": str(64 * 2**20),
    "MALLOC_MMAP_THRESHOLD_": str(32 * 2**20),
    "MALLOC_TOP_PAD_": str(2**20),
}
"""Bounds in bytes from which glibc gives memory that was freed back to the system.

By default, 128 KiB, an agent fetches the arrays of its filter again, page by page, in each period."""


def open_standard_descriptors() -> None:
    """Lead standard input, output and error to nowhere where a caller has closed them (`>&-`).

    The next files that this process opens would take their places, and be written to.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115


def use_one_blas_thread() -> None:
    """Have numpy, once it is imported, compute in one thread, unless the environment already says otherwise."""
    for name, value in ONE_BLAS_THREAD.items():
        os.environ.setdefault(name, value)


def fix_hash_seed(module: str) -> None:
    """Start this command (`python -m module`) again with a fixed hash seed, unless it has one.

    Programs that iterate over sets of strings must come out the same in every process and every run.
    """
    if os.environ.get("PYTHONHASHSEED") == "0":
        return
    package = module.partition(".")[0]
    if foreign := foreign_on_path(package, sys.path if sys.flags.safe_path else sys.path[1:]):
        print(f"vnet: {foreign}", file=sys.stderr)
        sys.exit(2)
    interrupts.hold()  # until the process that starts can end without a traceback
    arguments = [sys.executable, "-P", "-m", module, *sys.argv[1:]]
    os.execve(sys.executable, arguments, {**os.environ, "PYTHONHASHSEED": "0"})
