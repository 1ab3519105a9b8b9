"""`python -m emulator`: the command `vnet`."""

from emulator.cli import main

if __name__ == "__main__":
    main()
