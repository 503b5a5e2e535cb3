"""An evaluation as one page for a browser: tables, plots and pictures, with nothing to fetch from anywhere."""

from spackle.evaluation.report.page import make_report
from spackle.evaluation.report.source import Source

__all__ = ["Source", "make_report"]
