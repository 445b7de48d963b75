"""Many captures: discovered ones aligned on as many workers as there are, and what became of each."""

from agalign.batch.output_folder import prepare_output
from agalign.batch.report import CaptureReport
from agalign.batch.run import Listener, RunOptions, run_flight
from agalign.batch.workers import dask_executor

__all__ = ["CaptureReport", "Listener", "RunOptions", "dask_executor", "prepare_output", "run_flight"]
