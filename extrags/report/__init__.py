"""Self-contained HTML pages: one per sequence, one per dataset."""

from __future__ import annotations

from extrags.report.build import build_report as build_report
from extrags.report.dataset import DatasetRow as DatasetRow
from extrags.report.dataset import build_dataset_report as build_dataset_report
from extrags.report.inputs import ReportInputs as ReportInputs

__all__ = ["DatasetRow", "ReportInputs", "build_dataset_report", "build_report"]
