"""`python -m tests.golden [NAME ...]` makes the golden table again, or the named rows of it."""

import sys

from tests.golden.runs import main

main(sys.argv[1:])
