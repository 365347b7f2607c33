"""Self-contained HTML pages: one per sequence, one per dataset."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

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


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
