"""`python -m tests.golden [NAME ...]` makes the golden table again, or the named rows of it."""

import sys

from vnet.runtime.environment import use_same_arithmetic

use_same_arithmetic()  # before numpy is imported

from tests.golden.runs import main  # noqa: E402

main(sys.argv[1:])
