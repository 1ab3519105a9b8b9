"""Tests of all packages, which mirror them."""

from vnet.runtime.environment import use_same_arithmetic

use_same_arithmetic()  # before numpy is imported: some tests compare results of commands with those of this process
