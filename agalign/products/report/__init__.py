"""The report and the tables of a run, from the sidecars below its output folder."""

from agalign.products.report.pages import REPORT_FILE, SUMMARY_FILE, Pages, pages_exist, write_pages

__all__ = ["REPORT_FILE", "SUMMARY_FILE", "Pages", "pages_exist", "write_pages"]
