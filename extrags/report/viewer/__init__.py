"""The interactive scene of a page: its encoding, what is known of each Gaussian, its parts in the page."""

from __future__ import annotations

from extrags.report.viewer.content import ViewerContent as ViewerContent
from extrags.report.viewer.content import viewer_content as viewer_content
from extrags.report.viewer.encoding import decoded_scene as decoded_scene
from extrags.report.viewer.encoding import encoded_scene as encoded_scene

__all__ = ["ViewerContent", "decoded_scene", "encoded_scene", "viewer_content"]
