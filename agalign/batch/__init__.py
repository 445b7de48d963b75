"""Runs over many captures: learning flights, workers, resuming and reports."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from agalign.config import RunOptions as RunOptions

if TYPE_CHECKING:
    from agalign.batch.capture_report import CaptureReport as CaptureReport
    from agalign.batch.run import Listener as Listener
    from agalign.batch.run import run_flight as run_flight
    from agalign.batch.workers import dask_executor as dask_executor


def __getattr__(name: str) -> Any:
    """Import the module of a name at its first use (PEP 562): indices need no torch."""
    modules = {"dask_executor": "workers", "CaptureReport": "capture_report"}
    if name not in (*modules, "Listener", "run_flight"):
        raise AttributeError(f"module 'agalign.batch' has no attribute '{name}'")
    return getattr(import_module(f"agalign.batch.{modules.get(name, 'run')}"), name)
