"""Documents about a run as a whole, from the sidecars below its output folder: the page and the summary."""

from agalign.products.report.pages import REPORT_FILE, SUMMARY_FILE, Pages, pages_exist, write_pages

__all__ = ["REPORT_FILE", "SUMMARY_FILE", "Pages", "pages_exist", "write_pages"]
