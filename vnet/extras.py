"""Libraries that only an extra of the package installs, and the one line for a user who lacks one."""

from __future__ import annotations

from importlib.util import find_spec

from vnet.errors import VnetError

EXTRA_OF = {
    "asn1tools": "its",
    "cryptography": "tls",
    "cvxpy": "sdp",
    "distributed": "dask",
    "greenlet": "zenoh-sim",
    "gymnasium": "rl",
    "hypothesis": "hypothesis",
    "libsumo": "sumo",
    "matplotlib": "plots",
    "mcap": "export",
    "osmium": "maps",
    "osqp": "cooperative",
    "pettingzoo": "rl",
    "pycrate_asn1dir": "its",
    "pyproj": "maps",
    "rerun": "rerun",
    "rosbags": "ros2",
    "scipy": "scipy",
}
"""Extra of `vnet-emulator` that installs a library, by the name under which it is imported."""
ALSO_IN = {"scipy": {"cooperative", "maps"}}
"""Further extras that install a library."""


def is_installed(library: str) -> bool:
    """Return whether a library can be imported, without importing it."""
    return find_spec(library) is not None


def needs(*libraries: str) -> str:
    """Return what a user is told who lacks these libraries."""
    wanted = dict.fromkeys(EXTRA_OF[library] for library in libraries)
    covered = {EXTRA_OF[library] for library in libraries if wanted.keys() & ALSO_IN.get(library, set())}
    extras = ",".join(extra for extra in wanted if extra not in covered)
    listed = ", ".join(libraries[:-1]) + " and " * (len(libraries) > 1) + libraries[-1]
    return f"needs {listed}: pip install 'vnet-emulator[{extras}]'"


def require(subject: str, *libraries: str, error: type[VnetError] = VnetError) -> None:
    """Raise `error` in one line, which begins with what needs them, unless these libraries are installed."""
    if missing := [library for library in libraries if not is_installed(library)]:
        raise error(f"{subject} {needs(*missing)}")


def missed_by(failed: BaseException) -> str:
    """Return what a user is told about a failed import, if an extra installs what it lacks; else ""."""
    library = (failed.name or "").partition(".")[0] if isinstance(failed, ModuleNotFoundError) else ""
    return needs(library) if library in EXTRA_OF and not is_installed(library) else ""
