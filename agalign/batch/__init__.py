"""Runs over many captures: learning flights, workers, resuming and reports."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agalign.batch.output_folder import prepare_output
    from agalign.batch.report import CaptureReport, FlightReports
    from agalign.batch.run import Listener, RunOptions, run_flight
    from agalign.batch.workers import dask_executor

__all__ = ["CaptureReport", "FlightReports", "Listener", "RunOptions", "dask_executor", "prepare_output", "run_flight"]

_MODULES = {
    "CaptureReport": "report", "FlightReports": "report", "Listener": "run", "RunOptions": "run",
    "dask_executor": "workers", "prepare_output": "output_folder", "run_flight": "run",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import the module of a name at its first use (PEP 562): indices and locks need no torch."""
    if name not in _MODULES:
        raise AttributeError(f"module 'agalign.batch' has no attribute '{name}'")
    return getattr(import_module(f"agalign.batch.{_MODULES[name]}"), name)
