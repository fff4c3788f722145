"""What dask loads in each process of a sweep on this machine: an interruption is for the driver alone."""

from __future__ import annotations

import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C, which a terminal sends to all, to the driver: it ends the processes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
