"""Import of all that a run needs: in advance in this process, and in those that its workers start from."""

import gc
from importlib import import_module

from agalign.host.processes import leave_out_network_clients


def preload_libraries() -> None:
    """Import all that a run needs.

    The garbage collector is paused during the imports and later ignores their million objects: the imports take 0.4 s
    less, and workers do not copy the memory pages of these objects.
    """
    leave_out_network_clients()
    gc.disable()
    try:
        import_module("agalign.batch.run")
        gc.freeze()
    finally:
        gc.enable()
