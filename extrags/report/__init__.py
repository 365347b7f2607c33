"""Self-contained HTML pages: one per sequence, one per dataset."""

from __future__ import annotations

from typing import TYPE_CHECKING

from extrags.lazy_names import lazy_names

if TYPE_CHECKING:
    from extrags.report.build import build_report
    from extrags.report.dataset import DatasetRow, build_dataset_report
    from extrags.report.inputs import ReportInputs

__all__ = ["DatasetRow", "ReportInputs", "build_dataset_report", "build_report"]

# Loaded on first use: commands that only word a figure as pages do need no torch.
_MODULES = {
    "DatasetRow": "dataset",
    "ReportInputs": "inputs",
    "build_dataset_report": "dataset",
    "build_report": "build",
}

__getattr__ = lazy_names(__name__, _MODULES)


def __dir__() -> list[str]:
    return sorted(__all__)
