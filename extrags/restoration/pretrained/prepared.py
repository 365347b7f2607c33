"""What restorers with a pretrained model keep for a scene, saved and loaded alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from extrags.config.base import StageConfig
from extrags.errors import WeightsError
from extrags.restoration.description import DESCRIPTION, check_format, read_description, write_description
from extrags.restoration.pretrained.real_views import RealViews
from extrags.zarr_io import group_exists

__all__ = ["PreparedEnhancer", "load_prepared"]

REFERENCES = "references"


@dataclass(frozen=True, eq=False)
class PreparedEnhancer:
    """A pretrained model prepared for a scene; the model itself stays where it is.

    Args:
        settings: of the user.
        seed: of the noise, together with clip and window.
        views: training frames.
        model_digest: fingerprint of the model it was prepared with.
        record: for the provenance.
    """

    settings: StageConfig
    seed: int
    views: RealViews
    model_digest: str
    record: dict[str, Any]

    def save_common(self, path: Path, *, backend: str, format_number: int, **further: Any) -> None:
        """Write `restorer.json` and the real views.

        Args:
            path: a folder.
            backend: that loads the folder.
            format_number: raised when newer code cannot read the folder.
            further: more entries of the description.
        """
        self.views.save(path / REFERENCES)
        description = {
            "backend": backend,
            "format": format_number,
            "settings": self.settings.model_dump(mode="json"),
            "seed": self.seed,
            **further,
            "model_digest": self.model_digest,
            "record": self.record,
        }
        write_description(path, description)


def load_prepared(
    path: Path, *, format_number: int, files: Sequence[str] = ()
) -> tuple[dict[str, Any], RealViews]:
    """Description and real views that `PreparedEnhancer.save_common` wrote.

    Args:
        path: the folder.
        format_number: that this version reads.
        files: what else has to be in the folder.

    Raises:
        WeightsError: when a file is missing or damaged, or the format is another.
    """
    description = read_description(path / DESCRIPTION)
    missing = [name for name in files if not (path / name).exists()]
    if not group_exists(path / REFERENCES):
        missing.append(REFERENCES)
    if missing:
        raise WeightsError(f"{path / missing[0]}: not there; prepare the restorer first (stage enhance)")
    check_format(path / DESCRIPTION, description, format_number)
    return description, RealViews.load(path / REFERENCES)
