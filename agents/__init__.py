"""agents: programs that run in a vehicle. They stand on vnet and never import the emulator."""

import os

# One BLAS thread, before anything imports numpy: more would not be faster here, and less reproducible.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
