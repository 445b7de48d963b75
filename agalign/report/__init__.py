"""The report: OUT/index.html, one page made from the sidecars alone."""

from agalign.report.page import write_report

__all__ = ["write_report"]
