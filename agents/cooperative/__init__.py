"""The cooperative positioning program: decentralized cooperative map matching, one vehicle's part of it.

`agents.cooperative:main` is the program's entry.
"""

from agents.cooperative.program import main

__all__ = ["main"]
