"""The environment of a process that runs programs, so that they compute the same in every process and every run.

Each entry point sets it for its own process, and whoever starts a process sets it there; importing a package of
vnet changes nothing. This module imports nothing heavy: BLAS reads its variables when numpy is imported.
"""

from __future__ import annotations

import contextlib
import os
import resource
import sys
from collections.abc import Collection
from pathlib import Path

from vnet.runtime import interrupts
from vnet.runtime.own_packages import foreign_on_path


def same_arithmetic(processor_flags: Collection[str]) -> dict[str, str]:
    """Return the variables with which numpy computes the same bits on every x86-64 processor that has AVX2.

    One thread of linear algebra: more would not be faster here. OpenBLAS otherwise takes the kernel made for the
    processor it finds, and numpy the widest vectors; sums are then rounded elsewhere, and runs part.

    Args:
        processor_flags: what the processor can do, in the words of Linux.
    """
    threads = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    if not {"avx2", "fma"} <= set(processor_flags):
        return threads  # a kernel for AVX2 would end the process
    return threads | {
        "OPENBLAS_CORETYPE": "Haswell",
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",  # names of numpy from 2.4 on
    }


def _processor_flags() -> list[str]:
    with contextlib.suppress(OSError), Path("/proc/cpuinfo").open(errors="replace") as lines:
        return next((line.partition(":")[2].split() for line in lines if line.startswith("flags")), [])
    return []


SAME_ARITHMETIC = same_arithmetic(_processor_flags())
"""The variables of this machine."""


def has_same_arithmetic() -> bool:
    """Return whether this process was started to compute as on other machines, as far as this one can."""
    return all(os.environ.get(name) == value for name, value in SAME_ARITHMETIC.items())


def arithmetic() -> str:
    """Return where numpy computes the same bits: on all processors with `AVX2`, or on `this processor`."""
    same = has_same_arithmetic() and "OPENBLAS_CORETYPE" in SAME_ARITHMETIC
    return "AVX2" if same and _numpy_obeys() else "this processor"


def _numpy_obeys() -> bool:
    """Return whether numpy knows the variables: from 2.4 on, and with OpenBLAS."""
    import numpy  # heavy

    blas = numpy.show_config(mode="dicts")["Build Dependencies"].get("blas", {})
    return numpy.lib.NumpyVersion(numpy.__version__) >= "2.4.0" and "openblas" in blas.get("name", "")


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


def too_little_address_space(needed_mb: int) -> str:
    """Return in one line that a limit (`ulimit -v`) leaves this process less than that; "" if it does not.

    Libraries that find no room for their threads end a process, or wait for ever, and say nothing.
    """
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= needed_mb * 1_000_000:
        return ""
    return f"ulimit -v: {limit // 1024} kB of address space: {needed_mb * 1_000_000 // 1024} kB are needed"


def use_same_arithmetic() -> None:
    """Have numpy, once imported, compute as on other machines, unless the environment says otherwise."""
    for name, value in SAME_ARITHMETIC.items():
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
